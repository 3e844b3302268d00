"""Errors in messages of a peer.

::

    ProtocolError
    +-- MessageError      a text frame is not a message, or a message has a fault
    +-- AssemblyError     a binary frame, or a reference to one, is wrong
    +-- HandshakeError    an HTTP request or a WebSocket handshake is refused
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.model import FaultCode, FieldFault

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self


class ProtocolError(Exception):
    """Base of all faults of the client protocol. ``str()`` is fit to be sent to the peer."""


class MessageError(ProtocolError):
    """A message is refused.

    Args:
        place: The key that is wrong; empty for the message as a whole.
        problem: The fault.
        code: The kind of the fault.

    Attributes:
        faults: The faults; never empty.
    """

    def __init__(self, place: str, problem: str, code: FaultCode = FaultCode.INVALID) -> None:
        self.faults: tuple[FieldFault, ...] = (FieldFault((place,) if place else (), code, problem),)
        super().__init__(place, problem)

    @classmethod
    def of(cls, faults: Sequence[FieldFault]) -> Self:
        """Make the error from faults."""
        error = cls("", "; ".join(map(str, faults)))
        error.faults = tuple(faults)
        return error

    def __str__(self) -> str:
        return "; ".join(map(str, self.faults))


class AssemblyError(ProtocolError):
    """A binary frame or a reference to one is refused."""


class HandshakeError(ProtocolError):
    """An HTTP request or a WebSocket handshake is refused.

    Attributes:
        status: HTTP status to answer.
        reason: Plain text body to answer.
        retry_after: Seconds until the next attempt; 0: not said.
    """

    def __init__(self, status: int, reason: str, retry_after: float = 0.0) -> None:
        # It may quote bytes of the request that are not text and cannot be sent back.
        reason = reason.encode("utf-8", "backslashreplace").decode()
        super().__init__(status, reason)
        self.status = status
        self.reason = reason
        self.retry_after = retry_after

    def __str__(self) -> str:
        return self.reason
