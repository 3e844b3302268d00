"""Writes messages as frames: a text frame, then a binary frame for each binary value in it.

A binary frame is made as one ``bytes`` by a single ``join``. Passing the id and the payload as two fragments
to a WebSocket library would save that copy, but cost a second frame header, a second write and a drain, and
some clients do not join fragments. Copying 10 MB takes a small part of the time that sending it takes.
"""

from __future__ import annotations

import itertools
import operator
import os
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from rce.protocol.messages import (
    NO_ID,
    ClientMessage,
    DataMessage,
    ErrorReport,
    InterfaceStatus,
    LatchedSources,
    type_of,
)
from rce.protocol.reports import write_report
from rce.protocol.requests import write_request
from rce.protocol.single import MAX_PAYLOAD, encode_single

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce.protocol.assembler import Binary

Frame: TypeAlias = str | bytes
"""A frame as WebSocket libraries take it: ``str`` is sent as text, ``bytes`` as binary."""

_BINARY = (bytes, memoryview, bytearray)
_SCALARS = (float, int, str, bool)

_encode = msgspec.json.Encoder().encode


def _ids() -> Iterator[str]:
    """Yield ids that are unique among processes: 64 random bits and a count."""
    prefix = os.urandom(8).hex()
    return (f"{prefix}{number:016x}" for number in itertools.count(1))


_fresh_ids = _ids()
os.register_at_fork(after_in_child=lambda: globals().update(_fresh_ids=_ids()))


def encode(message: ClientMessage) -> list[Frame]:
    """Write a message.

    Raises:
        TypeError: It holds a value that JSON cannot express.
    """
    if isinstance(message, DataMessage):
        return encode_data(message.i_tag, message.message_type, message.msg, message.msg_id, message.latch)
    if isinstance(message, ErrorReport):
        return [_encode(write_report(message)).decode()]
    if isinstance(message, LatchedSources | InterfaceStatus):
        return encode_message(type_of(message), msgspec.to_builtins(message))
    return encode_message(type_of(message), write_request(message))


def encode_data(
    i_tag: str, message_type: str, msg: Any, msg_id: str = NO_ID, latch: str = "", *, single: bool = False
) -> list[Frame]:
    """Write a data message.

    Args:
        i_tag: Interface tag; a name, so it needs no escapes.
        message_type: Message or service type.
        msg: The message as a JSON object that may hold binary values, or as binary as a whole.
        msg_id: Echoed in the answer to a service request.
        latch: The source whose latched message it is; only for peers with that feature.
        single: Write a message that is binary as a whole as one frame; only for peers with that feature.

    Raises:
        TypeError: ``msg`` holds a value that JSON cannot express.
    """
    if isinstance(msg, _BINARY):
        if single and len(msg) <= MAX_PAYLOAD:
            return [encode_single(i_tag, message_type, msg, msg_id, latch)]
        id_ = next(_fresh_ids)
        data = {"iTag": i_tag, "type": message_type, "msgID": msg_id, **_latch(latch), "msg*": id_}
        return [_encode({"type": "DM", "data": data}).decode(), b"".join((id_.encode(), msg))]
    return encode_message(
        "DM", {"iTag": i_tag, "type": message_type, "msgID": msg_id, **_latch(latch), "msg": msg}
    )


def _latch(source: str) -> dict[str, str]:
    return {"latch": source} if source else {}


def encode_message(type_: str, data: Any) -> list[Frame]:
    """Write any message.

    Args:
        type_: The value of ``type``.
        data: The value of ``data``. Binary values in objects, and lists of binary values there, leave as
            binary frames, anywhere in it. A list that starts with a number, a string or a boolean is taken
            for a list of such and not searched. NaN and infinities become ``null``, because JSON has no
            word for them.

    Raises:
        TypeError: It holds a value that JSON cannot express, or a list of which only a part is binary.
    """
    binaries: list[Frame] = []
    data = _extract(data, binaries)
    return [_encode({"type": type_, "data": data}).decode(), *binaries]


def _extract(value: Any, binaries: list[Frame]) -> Any:
    """Return ``value`` with ids for binary values; parts without binary values are not copied."""
    if isinstance(value, dict):
        return _extract_object(value, binaries)
    if isinstance(value, list | tuple) and value and not isinstance(value[0], _SCALARS):
        made = [_extract(item, binaries) for item in value]
        return value if all(map(operator.is_, made, value)) else made
    if isinstance(value, _BINARY):
        raise TypeError(
            "a binary value must be a value of an object, or all values of a list there must be binary"
        )
    return value


def _extract_object(value: dict[str, Any], binaries: list[Frame]) -> dict[str, Any]:
    changed: dict[str, tuple[str, Any]] = {}
    for key, inner in value.items():
        if isinstance(inner, _SCALARS):
            continue
        if isinstance(inner, _BINARY):
            changed[key] = (f"{key}*", _detach(inner, binaries))
        elif isinstance(inner, list | tuple) and inner and all(isinstance(item, _BINARY) for item in inner):
            changed[key] = (f"{key}*", [_detach(item, binaries) for item in inner])
        else:
            made = _extract(inner, binaries)
            if made is not inner:
                changed[key] = (key, made)
    if not changed:
        return value
    return dict(changed.get(key, (key, inner)) for key, inner in value.items())


def _detach(data: Binary, binaries: list[Frame]) -> str:
    id_ = next(_fresh_ids)
    binaries.append(b"".join((id_.encode(), data)))
    return id_
