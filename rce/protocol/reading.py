"""Reads typed messages from JSON text, with errors that name the place.

Data messages, which are nearly all the traffic, take a fast path through msgspec's typed decoder. All other
messages, and wrong ones, take the slow path, which gives better error texts.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Annotated, Any, AnyStr, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType, field

from rce.model.spelling import fault_of, short
from rce.model.written import MessageTypeName, Name
from rce.protocol.calls import text_id
from rce.protocol.exceptions import MessageError
from rce.protocol.limits import DEFAULT_LIMITS
from rce.protocol.messages import (
    NO_ID,
    REQUEST_TYPES,
    TYPES,
    ClientMessage,
    DataMessage,
    MessageId,
    SourceName,
)
from rce.protocol.reports import read_report
from rce.protocol.requests import kind_of, read_request

if TYPE_CHECKING:
    from collections.abc import Collection

T = TypeVar("T")


class _DataFrame(Struct):
    type: Literal["DM"]
    data: DataMessage


class SerializedData(Struct):
    """The text frame of a serialized data message."""

    i_tag: Name = field(name="iTag")
    message_type: MessageTypeName = field(name="type")
    binary: Annotated[str, Meta(pattern=r"^[0-9A-Fa-f]{32}\Z")] = field(name="msg*")
    """The id of the binary frame."""
    msg_id: MessageId = field(name="msgID", default=NO_ID)
    latch: SourceName = ""
    msg: UnsetType = UNSET
    """Must not be given beside ``msg*``."""


class _SerializedFrame(Struct):
    type: Literal["DM"]
    data: SerializedData


_decode_data_frame = msgspec.json.Decoder(_DataFrame).decode
_decode_serialized_frame = msgspec.json.Decoder(_SerializedFrame).decode
_decode_any = msgspec.json.Decoder().decode

_DECODE_FAULTS = (msgspec.MsgspecError, UnicodeError, RecursionError)

_SHORT = 4096
_ESCAPED_SURROGATE = re.compile(rb"\\u[dD]")


def decode(text: str | bytes, *, max_depth: int = DEFAULT_LIMITS.max_depth) -> ClientMessage:
    """Read a text frame that refers to no binary frames.

    Args:
        text: The JSON text, or its UTF-8.
        max_depth: Deepest nesting that is accepted.

    Returns:
        The message. A ``CN`` or ``CX`` of which some items are wrong holds the good ones, and a text for each
        of the others in ``faults``.

    Raises:
        MessageError: It is not a message.
    """
    shallow = is_shallow(text, max_depth)
    if shallow:
        message = decode_data(text)
        if message is not None:
            return message
    value = parse_json(text)
    if not shallow:
        check_depth(value, max_depth)
    return message_from_json(value)


def decode_data(text: str | bytes) -> DataMessage | None:
    """Read a data message on the fast path. ``None``: another type, or wrong; the slow path finds out."""
    try:
        return _decode_data_frame(text).data
    except _DECODE_FAULTS:
        return None


def decode_serialized(text: str | bytes) -> SerializedData | None:
    """Read a data message that is one binary value on the fast path. ``None``: take the slow path."""
    stars = text.count('*"') if isinstance(text, str) else text.count(b'*"')
    escaped = "\\" in text if isinstance(text, str) else b"\\" in text
    if stars != 1 or escaped:
        return None
    try:
        return _decode_serialized_frame(text).data
    except _DECODE_FAULTS:
        return None


def is_shallow(text: str | bytes, max_depth: int) -> bool:
    """Return whether ``text`` cannot be nested too deep, at the cost of two scans in C."""
    if isinstance(text, str):
        return _openers(text, "{", max_depth) + _openers(text, "[", max_depth) <= max_depth
    return _openers(text, b"{", max_depth) + _openers(text, b"[", max_depth) <= max_depth


def _openers(text: AnyStr, brace: AnyStr, enough: int) -> int:
    """Count braces; on a long text ``find`` is ten times as fast as ``count``, and stops at ``enough``."""
    if len(text) <= _SHORT:
        return text.count(brace)
    count, place = 0, text.find(brace)
    while place >= 0 and count <= enough:
        count += 1
        place = text.find(brace, place + 1)
    return count


def check_depth(value: Any, max_depth: int) -> None:
    """Check the nesting of a JSON value, level by level and so without recursion.

    Raises:
        MessageError: It is nested deeper than ``max_depth``.
    """
    level = [value] if type(value) in (dict, list) else []
    depth = 0
    while level:
        depth += 1
        if depth > max_depth:
            raise MessageError("", f"nested deeper than {max_depth} levels")
        level = [
            inner
            for outer in level
            for inner in (outer.values() if type(outer) is dict else outer)
            if type(inner) is dict or type(inner) is list
        ]


def check_request_size(value: Any, size: int, limit: int) -> None:
    """Check the size of a message other than a data message.

    Raises:
        MessageError: Its text is longer than ``limit``.
    """
    kind = value.get("type") if isinstance(value, dict) else None
    if kind != "DM":
        raise MessageError(
            "", f"{short(kind)}: a request of {size} bytes is longer than the limit of {limit}"
        )


def parse_json(text: str | bytes) -> Any:
    """Read JSON; ``NaN`` and ``Infinity``, which Python's own writer emits, are understood too.

    Raises:
        MessageError: It is not JSON.
    """
    try:
        return _decode_any(text)
    except RecursionError as error:
        raise MessageError("", "nested deeper than any message may be") from error
    except _DECODE_FAULTS as error:
        if not _may_hold_nan(text):
            raise MessageError("", f"not valid JSON: {error}") from error
    try:
        value = json.loads(text)
        if _ESCAPED_SURROGATE.search(text.encode(errors="replace") if isinstance(text, str) else text):
            json.dumps(value, ensure_ascii=False).encode()  # Python's decoder accepts lone surrogates
    except (ValueError, RecursionError) as error:
        raise MessageError("", f"not valid JSON: {error}") from error
    return value


def _may_hold_nan(text: str | bytes) -> bool:
    if isinstance(text, str):
        return "NaN" in text or "Infinity" in text
    return b"NaN" in text or b"Infinity" in text


def kind_and_data(value: Any, accept: Collection[str]) -> tuple[str, Any]:
    """Return the type and the ``data`` of a parsed message.

    Args:
        value: The JSON value.
        accept: The types that the peer may send.

    Raises:
        MessageError: It is not a message, or one of another type.
    """
    if not isinstance(value, dict):
        raise MessageError("", f"a message must be an object, not {kind_of(value)}")
    kind = value.get("type")
    if not isinstance(kind, str) or kind not in accept:
        known = ", ".join(sorted(accept))
        problem = "is missing" if "type" not in value else f"unknown message type {short(kind)}"
        raise MessageError("type", f"{problem}; use one of {known}")
    if "data" not in value:
        raise MessageError("data", "is missing")
    return kind, value["data"]


def message_from_json(value: Any, accept: Collection[str] = TYPES) -> ClientMessage:
    """Make a message of a parsed text frame whose binary values are in place.

    Args:
        value: The JSON value.
        accept: The types that the peer may send.

    Raises:
        MessageError: It is not a message, or one of another type.
    """
    kind, data = kind_and_data(value, accept)
    if kind in REQUEST_TYPES:
        return read_request(kind, data)
    if kind == "ER":
        return read_report(_convert(data, str, "data"), value.get("fault"))
    if kind == "DM" and isinstance(data, dict) and "msgID" in data:
        data = {**data, "msgID": text_id(data["msgID"])}
    return _convert(data, TYPES[kind], "data")


def _convert(value: Any, cls: type[T], place: str) -> T:
    """Convert with msgspec; turn its error into one with this project's text and place."""
    try:
        return msgspec.convert(value, cls)
    except msgspec.ValidationError as error:
        raise MessageError.of([fault_of(str(error), value).below(place)]) from error
