"""What can be wrong with what a peer sent.

::

    ProtocolError
    +-- MessageError      a text frame is not a message, or a message holds something wrong
    +-- AssemblyError     a binary frame, or a reference to one, is wrong
    +-- HandshakeError    an HTTP request or a WebSocket handshake is refused
"""

from __future__ import annotations


class ProtocolError(Exception):
    """Base of all faults of the client protocol. ``str()`` is fit to be sent to the peer."""


class MessageError(ProtocolError):
    """A message is refused.

    Attributes:
        place: Where in the message, such as ``data.addNodes[2].pkg``; empty for the message as a whole.
        problem: What is wrong there.
    """

    def __init__(self, place: str, problem: str) -> None:
        super().__init__(place, problem)
        self.place = place
        self.problem = problem

    def __str__(self) -> str:
        return f"{self.place}: {self.problem}" if self.place else self.problem


class AssemblyError(ProtocolError):
    """A binary frame or a reference to one is refused."""


class HandshakeError(ProtocolError):
    """An HTTP request or a WebSocket handshake is refused.

    Attributes:
        status: HTTP status to answer.
        reason: Plain text body to answer.
    """

    def __init__(self, status: int, reason: str) -> None:
        # It may quote bytes of the request that are not text, which could not be sent back.
        reason = reason.encode("utf-8", "backslashreplace").decode()
        super().__init__(status, reason)
        self.status = status
        self.reason = reason

    def __str__(self) -> str:
        return self.reason
