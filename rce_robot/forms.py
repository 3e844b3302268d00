"""How a message looks at the robot's end: a JSON object (Converter) or its serialized bytes (Forwarder)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from rce.protocol.codec import encode_data
from rce.ros.types.fields import element_min_size
from rce_robot.exceptions import UnreadableError
from rce_robot.outgoing import Outgoing, Serialized

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.types import MessageType
    from rce_robot.converters import Converter
    from rce_robot.outgoing import Buffer, Rendered

_encoder = msgspec.json.Encoder()
_json, _json_into = _encoder.encode, _encoder.encode_into
_BINARY = (bytes, bytearray, memoryview)


class Form(Protocol):
    """Reads what the robot sends at an interface and writes what it gets there."""

    costly: bool
    """Whether :meth:`read` and :meth:`show` may take so long that they belong in another process."""
    readable: bool
    """Whether there is a message that :meth:`read` takes and that is JSON as a whole."""

    def is_heavy(self, payload: Buffer) -> bool:
        """Tell whether :meth:`show` takes so long for this payload that it belongs in another process."""

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:
        """Return the serialized message.

        Args:
            msg: ``msg`` of a data message.
            warn: Told of what was ignored.

        Raises:
            UnreadableError: It is not such a message.
        """

    def show(self, payload: Buffer) -> Any:
        """Return what stands for a serialized message in ``msg``.

        Raises:
            UnreadableError: The payload is not such a message.
        """

    def pack(self, tag: str, message_type: str, msg_id: str, msg: Any) -> Rendered:
        """Return the data message that carries what :meth:`show` returned."""


class ForwarderForm:
    """Serialized messages travel as binary values and are never looked into."""

    costly = False
    readable = False

    def is_heavy(self, payload: Buffer) -> bool:  # noqa: ARG002 - it is not looked into
        """Return False."""
        return False

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:  # noqa: ARG002 - nothing is ignored here
        """Return the bytes as they came."""
        if not isinstance(msg, _BINARY):
            raise UnreadableError("a Forwarder takes a serialized message as binary value 'msg*'")
        return msg

    def show(self, payload: Buffer) -> Buffer:
        """Return the payload."""
        return payload

    def pack(self, tag: str, message_type: str, msg_id: str, msg: Buffer) -> Serialized:
        """Put names beside the payload, which is not copied."""
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
        """Tell by the type and the payload's size how many values it may hold, and how long its texts are."""
        size = len(payload)
        if self.costly or size > _MAX_LIGHT:
            return True
        if self._element_size:
            return size > _MAX_LIGHT_ELEMENTS * self._element_size
        # A text beyond ASCII takes ten times as long; what leaves as binary values takes no time.
        return size > _ANY_CHARACTERS and not self._holds_bytes and not _is_ascii(payload)

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:
        """Serialize the object; fields that the message does not have are ignored with a warning."""
        payload, ignored = self._converter.decode(msg)
        for field in ignored:
            warn(f"unknown field {field} was ignored")
        return payload

    def show(self, payload: Buffer) -> Any:
        """Make an object of the payload."""
        return self._converter.encode(payload)

    def pack(self, tag: str, message_type: str, msg_id: str, msg: Any) -> Outgoing:
        """Write the object as JSON."""
        if self._is_plain:  # no search for binary values, and no way through a str
            names = (tag.encode(), message_type.encode(), _json(msg_id))
            packed = bytearray(b'{"type":"DM","data":{"iTag":"%b","type":"%b","msgID":%b,"msg":' % names)
            _json_into(msg, packed, -1)  # in place: a large message is not copied once more
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
"""Bytes of a payload that are looked at at a time: no large copy is made."""


def _is_ascii(payload: Buffer) -> bool:
    """Tell whether all that may be text is plain."""
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
