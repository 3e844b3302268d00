"""A message to the robot as it goes over the WebSocket. Pure."""

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
    """Return 32 hex characters that were not used before: a binary value's or a service call's id."""
    return f"{_prefix}{next(_numbers):016x}"


@dataclass(frozen=True, slots=True)
class Outgoing:
    """One message: a JSON text and the binary frames it names."""

    text: Buffer
    """UTF-8."""
    binaries: tuple[tuple[bytes, Buffer], ...] = ()
    """Payloads of binary frames, each in two parts, so that an id can go before bytes that nobody copies."""

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
    """One message that is binary as a whole: one frame for clients that asked for it, two for others."""

    names: bytes
    """What ``data`` holds beside ``msg``, as JSON without braces."""
    payload: Buffer

    @property
    def size(self) -> int:
        """Payload bytes of its frames, about."""
        return len(self.names) + len(self.payload)

    @property
    def is_long(self) -> bool:
        """Whether it is too long for one frame."""
        return len(self.payload) > MAX_PAYLOAD

    @property
    def prefix(self) -> bytes:
        """What stands before the payload in one frame."""
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
    """A latched message on its way to a client that knows of sources."""

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
"""How every data message begins that is made here."""


def _latch(source: str) -> bytes:
    return b'"latch":"%b",' % source.encode()
