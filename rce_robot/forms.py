"""The forms of messages at the robot's end: a JSON object (Converter) or serialized bytes (Forwarder)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from rce.protocol import encode_data
from rce.ros.types.fields import element_min_size
from rce_robot.exceptions import UnreadableError
from rce_robot.outgoing import Buffer, Outgoing, Rendered, Serialized

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.types import MessageType
    from rce_robot.converters import Converter

_encoder = msgspec.json.Encoder()
_json, _json_into = _encoder.encode, _encoder.encode_into
_BINARY = (bytes, bytearray, memoryview)


class Form(Protocol):
    """Reads the robot's messages at an interface and writes messages to it."""

    costly: bool
    """Whether :meth:`read` and :meth:`show` may take long enough to need another process."""
    readable: bool
    """Whether :meth:`read` accepts messages that are entirely JSON."""

    def is_heavy(self, payload: Buffer) -> bool:
        """Return whether :meth:`show` takes long enough for this payload to need another process."""

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:
        """Return the serialized message.

        Args:
            msg: ``msg`` of a data message.
            warn: Called for ignored fields.

        Raises:
            UnreadableError: It is not such a message.
        """

    def show(self, payload: Buffer) -> Any:
        """Return the form of a serialized message in ``msg``.

        Raises:
            UnreadableError: The payload is not such a message.
        """

    def pack(self, tag: str, message_type: str, msg_id: str, msg: Any) -> Rendered:
        """Return the data message that carries the result of :meth:`show`."""


class ForwarderForm:
    """Serialized messages travel as binary values and are not parsed."""

    costly = False
    readable = False

    def is_heavy(self, payload: Buffer) -> bool:  # noqa: ARG002 - it is not looked into
        """Return False."""
        return False

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:  # noqa: ARG002 - nothing is ignored here
        """Return the received bytes unchanged."""
        if not isinstance(msg, _BINARY):
            raise UnreadableError("a Forwarder takes a serialized message as binary value 'msg*'")
        return msg

    def show(self, payload: Buffer) -> Buffer:
        """Return the payload."""
        return payload

    def pack(self, tag: str, message_type: str, msg_id: str, msg: Buffer) -> Serialized:
        """Add names to the payload, which is not copied."""
        names = b'"iTag":"%b","type":"%b","msgID":%b' % (tag.encode(), message_type.encode(), _json(msg_id))
        return Serialized(names, msg)


class ConverterForm:
    """Messages travel as JSON objects; their binary values as binary frames."""

    readable = True

    def __init__(self, converter: Converter) -> None:
        self._converter = converter
        self.costly = converter.is_costly
        self._holds_bytes = _holds_bytes(converter.kind)
        self._is_plain = not (self.costly or self._holds_bytes)
        self._element_size = _element_size(converter.kind)

    def is_heavy(self, payload: Buffer) -> bool:
        """Estimate from the type and the payload's size how many values and how long texts it holds."""
        size = len(payload)
        if self.costly or size > _MAX_LIGHT:
            return True
        if self._element_size:
            return size > _MAX_LIGHT_ELEMENTS * self._element_size
        # A text beyond ASCII takes ten times as long; binary values take no time.
        return size > _ANY_CHARACTERS and not self._holds_bytes and not _is_ascii(payload)

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:
        """Serialize the object; unknown fields are ignored with a warning."""
        payload, ignored = self._converter.decode(msg)
        for field in ignored:
            warn(f"unknown field {field} was ignored")
        return payload

    def show(self, payload: Buffer) -> Any:
        """Make an object of the payload."""
        return self._converter.encode(payload)

    def pack(self, tag: str, message_type: str, msg_id: str, msg: Any) -> Outgoing:
        """Write the object as JSON."""
        if self._is_plain:  # without a search for binary values or a str in between
            names = (tag.encode(), message_type.encode(), _json(msg_id))
            packed = bytearray(b'{"type":"DM","data":{"iTag":"%b","type":"%b","msgID":%b,"msg":' % names)
            _json_into(msg, packed, -1)  # in place: avoids another copy of a large message
            packed += b"}}"
            return Outgoing(packed)
        text, *binaries = encode_data(tag, message_type, msg, msg_id)
        assert isinstance(text, str)
        return Outgoing(text.encode(), tuple((b"", frame) for frame in binaries if isinstance(frame, bytes)))


_MAX_LIGHT_ELEMENTS = 16384
_MAX_LIGHT = 12 << 20
_ANY_CHARACTERS = 1 << 20
_FIXED = 64
"""Bytes at the beginning that may be numbers, such as a text's length."""


_SLICE = 64 << 10
"""Bytes of a payload that are checked at a time, to avoid a large copy."""


def _is_ascii(payload: Buffer) -> bool:
    """Return whether all possible texts are ASCII."""
    view = memoryview(payload)
    return all(bytes(view[i : i + _SLICE]).isascii() for i in range(_FIXED, len(view), _SLICE))


def _element_size(kind: MessageType) -> int:
    """Return the fewest bytes that an element of its lists takes; 0 if it has no lists."""
    parts = (kind, *kind.dependencies)
    lists = (field for part in parts for field in part.fields if field.is_array and not field.is_bytes)
    return min((max(1, element_min_size(field)) for field in lists), default=0)


def _holds_bytes(kind: MessageType) -> bool:
    """Tell whether a message may hold byte arrays, which leave as binary values."""
    return any(field.is_bytes for part in (kind, *kind.dependencies) for field in part.fields)
