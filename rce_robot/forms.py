"""How a message looks at the robot's end: a JSON object (Converter) or its serialized bytes (Forwarder)."""

from __future__ import annotations

import itertools
import os
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from rce_robot.exceptions import UnreadableError
from rce_robot.outbox import Outgoing

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_robot.outbox import Buffer

_json = msgspec.json.Encoder().encode
_BINARY = (bytes, bytearray, memoryview)
_prefix = os.urandom(8).hex()
_numbers = itertools.count(1)


def fresh_id() -> str:
    """Return 32 hex characters that were not used before: a binary value's or a service call's id."""
    return f"{_prefix}{next(_numbers):016x}"


class Form(Protocol):
    """Reads what the robot sends at an interface and writes what it gets there."""

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:
        """Return the serialized message.

        Args:
            msg: ``msg`` of a data message.
            warn: Told of what was ignored.

        Raises:
            UnreadableError: It is no such message.
        """

    def write(self, tag: str, cls: str, msg_id: str, payload: Buffer) -> Outgoing:
        """Return the data message that carries a serialized message to the robot.

        Raises:
            UnreadableError: The payload is no such message.
        """


class ConverterLike(Protocol):
    """What :class:`ConverterForm` needs of a converter (:mod:`rce_robot.converters`)."""

    def decode(self, value: Any, /) -> tuple[bytes, Any]:
        """Return the serialized message and the fields that were ignored."""

    def encode(self, payload: Buffer, /) -> Any:
        """Return the message as an object; its values may be binary."""


class ForwarderForm:
    """Serialized messages travel as binary values and are never looked into."""

    def read(self, msg: Any, warn: Callable[[str], None]) -> Buffer:  # noqa: ARG002 - nothing is ignored here
        """Return the bytes as they came."""
        if not isinstance(msg, _BINARY):
            raise UnreadableError("a Forwarder takes a serialized message as binary value 'msg*'")
        return msg

    def write(self, tag: str, cls: str, msg_id: str, payload: Buffer) -> Outgoing:
        """Put the payload behind its id, uncopied."""
        id_ = fresh_id().encode()
        text = b'{"type":"DM","data":{"iTag":"%b","type":"%b","msgID":%b,"msg*":"%b"}}' % (
            tag.encode(),
            cls.encode(),
            _json(msg_id),
            id_,
        )
        return Outgoing(text, ((id_, payload),))
