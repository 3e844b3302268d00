"""The WebSocket form of messages to the robot. Pure."""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from rce.protocol.single import MAX_PAYLOAD, prefix

if TYPE_CHECKING:
    from rce_robot.doors.base import Queued

Buffer = bytes | bytearray | memoryview

_prefix = os.urandom(8).hex()
_numbers = itertools.count(1)


def fresh_id() -> str:
    """Return a new id of 32 hex characters, for a binary value or a service call."""
    return f"{_prefix}{next(_numbers):016x}"


@dataclass(frozen=True, slots=True)
class Outgoing:
    """One message: a JSON text and the binary frames it names."""

    text: Buffer
    """UTF-8."""
    binaries: tuple[tuple[bytes, Buffer], ...] = ()
    """Payloads of binary frames, each in two parts: an id, and bytes that are not copied."""

    @property
    def size(self) -> int:
        """Payload bytes of all its frames."""
        return len(self.text) + sum(len(head) + len(body) for head, body in self.binaries)

    def render(self) -> Outgoing:
        """Return itself; it is ready."""
        return self

    def latched(self, source: str) -> Outgoing:
        """Return the message with the name of the source that latched it."""
        text = bytes(self.text)
        if not text.startswith(_DATA_HEAD):
            raise ValueError(f"a data message does not begin with {_DATA_HEAD.decode()}")
        return Outgoing(b"".join((_DATA_HEAD, _latch(source), text[len(_DATA_HEAD) :])), self.binaries)


@dataclass(frozen=True, slots=True)
class Serialized:
    """One entirely binary message: one frame for clients that support it, two for others."""

    names: bytes
    """The fields of ``data`` other than ``msg``, as JSON without braces."""
    payload: Buffer

    @property
    def size(self) -> int:
        """Approximate payload bytes of its frames."""
        return len(self.names) + len(self.payload)

    @property
    def is_long(self) -> bool:
        """Whether it is too long for one frame."""
        return len(self.payload) > MAX_PAYLOAD

    @property
    def prefix(self) -> bytes:
        """The bytes before the payload in one frame."""
        return prefix(b"{%b}" % self.names)

    def split(self) -> Outgoing:
        """Return the message in two frames."""
        id_ = fresh_id().encode()
        return Outgoing(b'%b%b,"msg*":"%b"}}' % (_DATA_HEAD, self.names, id_), ((id_, self.payload),))

    def latched(self, source: str) -> Serialized:
        """Return the message with the name of the source that latched it."""
        return Serialized(_latch(source) + self.names, self.payload)


Rendered: TypeAlias = Outgoing | Serialized
"""A message that is ready to be sent."""


class LatchedDelivery:
    """A latched message for a client that supports sources."""

    __slots__ = ("_message", "_source", "size")

    def __init__(self, message: Queued, source: str) -> None:
        self._message = message
        self._source = source
        self.size = message.size

    def render(self) -> Rendered | None:
        """Add the name of the source to the message."""
        rendered = self._message.render()
        return None if rendered is None else rendered.latched(self._source)


_DATA_HEAD = b'{"type":"DM","data":{'
"""The beginning of all data messages of this module."""


def _latch(source: str) -> bytes:
    return b'"latch":"%b",' % source.encode()
