"""A data message whose ``msg`` is binary as a whole, in one frame; for peers with that feature. Pure.

::

    offset  size
         0     1  0x01, with which no id of a binary frame begins
         1     2  n, the length of the header; unsigned, big-endian
         3     n  header: the ``data`` of the message without ``msg``, a JSON object in UTF-8
     3 + n        the serialized message, up to the end of the frame
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET, Struct, UnsetType, field

from rce.model.written import MessageTypeName, Name
from rce.protocol.exceptions import AssemblyError, MessageError
from rce.protocol.limits import DEFAULT_LIMITS
from rce.protocol.messages import NO_ID, DataMessage, MessageId, SourceName
from rce.protocol.reading import parse_json

if TYPE_CHECKING:
    from rce.protocol.assembler import Binary

MARK = 0x01
"""First byte of such a frame."""
MAX_HEADER = 4096
"""Longest header in bytes; the longest names need 3 kB."""
MAX_PAYLOAD = DEFAULT_LIMITS.max_binary - 2 * MAX_HEADER
"""Longest serialized message that is sent so; a longer one goes in a binary frame of its own."""

_PREFIX = struct.Struct("!BH")
_MAX_KNOWN = 64
"""Headers that are remembered."""
_LONGEST_KNOWN = 512

_encode = msgspec.json.Encoder().encode


class _Header(Struct):
    i_tag: Name = field(name="iTag")
    message_type: MessageTypeName = field(name="type")
    msg_id: MessageId = field(name="msgID", default=NO_ID)
    latch: SourceName = ""
    msg: UnsetType = UNSET
    binary: UnsetType = field(name="msg*", default=UNSET)
    """Neither may be there: the message comes after the header."""


_decode = msgspec.json.Decoder(_Header).decode
_DECODE_FAULTS = (msgspec.MsgspecError, UnicodeError, RecursionError)


def prefix(header: bytes) -> bytes:
    """Return the bytes before the serialized message.

    Args:
        header: ``data`` without ``msg`` as JSON, at most :data:`MAX_HEADER` bytes.
    """
    return _PREFIX.pack(MARK, len(header)) + header


def encode_single(i_tag: str, message_type: str, msg: Binary, msg_id: str = NO_ID, latch: str = "") -> bytes:
    """Write a data message as one frame; arguments as in :func:`rce.protocol.codec.encode_data`."""
    data = {"iTag": i_tag, "type": message_type, "msgID": msg_id}
    if latch:
        data["latch"] = latch
    return b"".join((prefix(_encode(data)), msg))


class SingleReader:
    """Reads such frames of one peer. The headers of a topic's messages are all the same, and read once."""

    def __init__(self) -> None:
        self._known: dict[bytes, _Header] = {}

    def read(self, frame: Binary) -> DataMessage | dict[str, Any]:
        """Read a frame that begins with :data:`MARK`.

        Args:
            frame: Its bytes; kept, not copied.

        Returns:
            The message; or, if its header is unusual or wrong, its ``data`` as if it had come as JSON, for
            :func:`rce.protocol.reading.message_from_json` to read or to find its faults.

        Raises:
            ProtocolError: It has no header.
        """
        start = _PREFIX.size
        if len(frame) < start:
            raise AssemblyError(
                f"a binary frame that begins with the byte 1 is at least {start} bytes long, not {len(frame)}"
            )
        size = _PREFIX.unpack_from(frame)[1]
        if size > MAX_HEADER:
            raise AssemblyError(f"a header of {size} bytes is longer than the limit of {MAX_HEADER}")
        text = bytes(frame[start : start + size])
        if len(text) < size:
            raise AssemblyError(f"a binary frame of {len(frame)} bytes has no room for its header of {size}")
        payload = memoryview(frame)[start + size :]
        header = self._known.get(text) or self._learn(text)
        if header is None:
            return _read_data(text, payload)
        return DataMessage(header.i_tag, header.message_type, payload, header.msg_id, header.latch)

    def _learn(self, text: bytes) -> _Header | None:
        try:
            header = _decode(text)
        except _DECODE_FAULTS:
            return None
        if header.msg_id == NO_ID and len(text) <= _LONGEST_KNOWN:
            if len(self._known) >= _MAX_KNOWN:
                del self._known[next(iter(self._known))]
            self._known[text] = header
        return header


def _read_data(text: bytes, payload: memoryview) -> dict[str, Any]:
    data = parse_json(text)
    if not isinstance(data, dict):
        raise MessageError("data", "must be an object; it is the header of a message in one frame")
    for key in ("msg", "msg*"):
        if key in data:
            raise MessageError(f"data.{key}", "leave it out; in one frame the message comes after its header")
    return {**data, "msg": payload}
