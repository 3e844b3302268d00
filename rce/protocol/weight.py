"""Estimates the cost of parsing a JSON text, by scans in C that make no objects; and the memory of values.

A text is *light* if parsing and converting it takes a few milliseconds at most. Other texts are parsed
outside the event loop. The estimate counts bytes, also those inside strings: a text that counts as light is
light; one that counts as heavy may turn out to be light.
"""

from __future__ import annotations

import codecs
import json
import re
from sys import getsizeof
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec import Struct

from rce.protocol.calls import text_id
from rce.protocol.exceptions import MessageError
from rce.protocol.messages import NO_ID

if TYPE_CHECKING:
    from collections.abc import Iterator

_SHORT = 8 << 10
"""Bytes up to which every text is light."""
_SLICE = 64 << 10
"""Bytes that are counted at a time."""
_CHECKED = 256 << 10
"""Bytes that are checked to be UTF-8 at a time."""
_FEW = 64
"""Characters that ``find`` looks for: where they are few, it is thirty times as fast as ``count``."""
_MAX_OPENERS = 2048
_MAX_COMMAS = 16384
_MAX_ESCAPES = 16384
_ANY_CHARACTERS = 1 << 20
"""Bytes up to which a light text may hold characters beyond ASCII and any number of escapes."""
_MAX_LIGHT = 12 << 20

_EDGE = 4096
"""Bytes at each end of a large message that hold its small values, before or after its one large value."""
_TAG = re.compile(rb'"iTag"\s*:\s*"([^"\\]{1,256})"')
_MESSAGE_TYPE = re.compile(rb'"type"\s*:\s*"([^"\\]{1,256}/[^"\\]{1,256})"')
_MSG_ID = re.compile(rb'"msgID"\s*:\s*("(?:[^"\\]|\\.){1,1536}"|-?[0-9][0-9.eE+-]{0,255})')
_LATCH = re.compile(rb'"latch"\s*:\s*"([^"\\]{1,64})"')
_MSG = re.compile(rb'"msg\*?"\s*:')
_STRING = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+"', re.DOTALL)


class Address(NamedTuple):
    """The address of a data message, as found in its text without parsing."""

    i_tag: str
    message_type: str = ""
    """Empty if it was not found."""
    msg_id: str = NO_ID
    latch: str = ""
    """See :attr:`rce.protocol.messages.DataMessage.latch`; it must come before ``msg``."""


def is_light(text: bytes) -> bool:
    """Return whether a text can be parsed and converted within a few milliseconds."""
    size = len(text)
    if size <= _SHORT:
        return True
    return (
        size <= _MAX_LIGHT
        and _has_at_most(text, b",", _MAX_COMMAS)
        and _has_at_most(text, b"[", _MAX_OPENERS)
        and _has_at_most(text, b"{", _MAX_OPENERS)
        and (size <= _ANY_CHARACTERS or (text.isascii() and _has_at_most(text, b"\\", _MAX_ESCAPES)))
    )


def utf8_in_steps(text: bytes) -> Iterator[bool]:
    """Check in steps of about a millisecond that a text is UTF-8.

    Yields:
        Whether it is as far as it was looked at; nothing after the first False.
    """
    decoder = codecs.getincrementaldecoder("utf-8")()
    for start in range(0, len(text), _CHECKED):
        end = start + _CHECKED
        try:
            decoder.decode(text[start:end], final=end >= len(text))
        except UnicodeDecodeError:
            yield False
            return
        yield True


def check_elements(text: bytes, *, max_elements: int, max_values: int) -> None:
    """Check how much a text holds, before it is parsed.

    Args:
        text: JSON in UTF-8.
        max_elements: How many objects, lists and members of objects it may hold together.
        max_values: How many values in all.

    Raises:
        MessageError: It holds more.
    """
    elements, values = _count(text)
    if elements > max_elements or values > max_values:
        elements, values = _count(_STRING.sub(b'""', text))  # braces and commas inside strings do not count
    if elements > max_elements:
        raise MessageError(
            "",
            f"a message of {elements} objects, lists and members is over the limit of {max_elements}; "
            "send large data as binary values or through a Forwarder",
        )
    if values > max_values:
        raise MessageError(
            "",
            f"a message of {values} values is over the limit of {max_values}; "
            "send large data as binary values or through a Forwarder",
        )


def memory_of(value: object) -> int:
    """Return about how many bytes of memory a parsed message takes, which may be twenty times its text.

    Args:
        value: Parsed JSON, which may hold binary values; or a request, or a binary value.
    """
    size = 0
    level: list[Any] = [value]
    while level:
        size += sum(map(getsizeof, level))
        inner: list[Any] = []
        for item in level:
            kind = type(item)
            if kind is str or kind is int or kind is float:
                continue
            if kind is dict:
                inner += item.keys()
                inner += item.values()
            elif kind is list or kind is tuple:
                inner += item
            elif kind is memoryview:
                size += item.nbytes
            elif isinstance(item, Struct):
                inner += [getattr(item, name) for name in item.__struct_fields__]
        level = inner
    return size


def find_address(text: bytes) -> Address | None:
    """Find the address of a large data message without parsing it.

    All values of a data message but ``msg`` are short, so they stand near the beginning or near the end of
    the text, whatever the order of its keys.

    Returns:
        The probable address, to be compared when the text is parsed. ``None``: it was not found there.
    """
    head, tail = text[:_EDGE], text[-_EDGE:]
    msg = _MSG.search(head)
    head = head[: msg.start()] if msg is not None else head
    tag, message_type = _find(_TAG, head, tail), _find(_MESSAGE_TYPE, head, tail)
    latch = _find(_LATCH, head, b"")
    return Address(tag, message_type, _read_id(_find(_MSG_ID, head, tail)), latch) if tag else None


def _read_id(found: str) -> str:
    """Return the id of a ``msgID`` as JSON writes it; :data:`NO_ID`: it is not a string or an integer."""
    try:
        id_ = text_id(json.loads(found)) if found else NO_ID
    except (ValueError, RecursionError):
        return NO_ID
    return id_ if isinstance(id_, str) else NO_ID


def _find(pattern: re.Pattern[bytes], head: bytes, tail: bytes) -> str:
    """Return the first value in ``head``, else the last in ``tail``, else nothing."""
    found = pattern.search(head) or next(reversed(list(pattern.finditer(tail))), None)
    return "" if found is None else found[1].decode(errors="replace")


def _has_at_most(text: bytes, character: bytes, most: int) -> bool:
    """Count a character, up to a limit."""
    count, place = 0, text.find(character)
    while place >= 0 and count < _FEW:
        count += 1
        place = text.find(character, place + 1)
    while place >= 0:
        end = place + _SLICE
        count += text.count(character, place, end)
        if count > most:
            return False
        place = text.find(character, end)
    return count <= most


def _count(text: bytes) -> tuple[int, int]:
    """Return how many objects, lists and members, and how many values, a text without strings has."""
    openers = text.count(b"[") + text.count(b"{")
    return openers + text.count(b":"), openers + text.count(b",") + 1
