"""Errors of links.

::

    LinkError
    +-- ProtocolError             the peer broke the rules of the frames; the connection is dropped
    +-- LinkRefusedError          the accepting end refused the dialing end
        +-- FormerPlaceError      the dialing end is where its endpoint was before
    +-- LinkLostError             the connection of a link ended
    +-- InterfaceError            an interface cannot be made or started as its spec says
    +-- CallError                 a service call got no answer
        +-- NotConnectedError     no peer is connected
        +-- PeerFaultError        the peer answered with a fault
        +-- PeerLostError         the peer went away before it answered
        +-- CallTimeoutError      no answer in time
        +-- OverloadedError       too many calls wait already, here or at the peer
        +-- MessageTooLargeError  the message is larger than a link carries
"""

from __future__ import annotations


class LinkError(Exception):
    """Base of all errors of this package."""


class ProtocolError(LinkError):
    """The peer broke the rules of the frames."""


class LinkRefusedError(LinkError):
    """The accepting end refused the dialing end; the text is its reason."""


class FormerPlaceError(LinkRefusedError):
    """The dialing end is where its endpoint was before."""


class LinkLostError(LinkError):
    """The connection of a link ended."""


class InterfaceError(LinkError):
    """An interface cannot be made or started as its spec says.

    The text is for the user, who is told the interface's tag before it.
    """


class CallError(LinkError):
    """A service call got no answer."""


class NotConnectedError(CallError):
    """No peer is connected."""

    def __str__(self) -> str:
        return super().__str__() or "not connected"


class PeerFaultError(CallError):
    """The peer answered with a fault.

    Attributes:
        text: What the peer said.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text


class PeerLostError(CallError):
    """The peer went away before it answered."""


class CallTimeoutError(CallError):
    """No answer came in time."""


class OverloadedError(CallError):
    """Too many calls wait already, here or at the peer."""


class MessageTooLargeError(CallError):
    """The message is larger than a link carries.

    Attributes:
        size: Of the message, in bytes.
        limit: What the link carries, in bytes.
    """

    def __init__(self, size: int, limit: int) -> None:
        super().__init__(size, limit)
        self.size = size
        self.limit = limit

    def __str__(self) -> str:
        return f"message of {self.size} bytes is larger than the limit of {self.limit} bytes"
