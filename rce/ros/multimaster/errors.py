"""Errors of multimaster.

::

    RosError
    +-- MultimasterError
        +-- MalformedHeartbeatError  a datagram that is not a heartbeat of a known version
        +-- MalformedStateError      a master's description that cannot be read
        +-- NoSuchInterfaceError     an interface or address to discover on that is not there
        +-- NoDiscoveryError         no discovery runs at a master
        +-- NothingToRelayError      the type of a topic or service cannot be learned: no node offers it
        +-- LinkFullError            too much waits to be sent on a relay link
        +-- LinkBrokenError          the other end of a relay link breaks its protocol or refuses
            +-- SecondLinkError      both sides have dialed each other, and the other link is kept
"""

from __future__ import annotations

from rce.ros.errors import RosError


class MultimasterError(RosError):
    """Base of all errors of :mod:`rce.ros.multimaster`."""


class MalformedHeartbeatError(MultimasterError):
    """A datagram is not a heartbeat of a known version."""


class MalformedStateError(MultimasterError):
    """A master's description cannot be read."""


class NoSuchInterfaceError(MultimasterError):
    """The network interface or address does not exist on this machine."""


class NoDiscoveryError(MultimasterError):
    """No discovery runs at a master."""


class NothingToRelayError(MultimasterError):
    """The type of a topic or service cannot be learned."""


class LinkFullError(MultimasterError):
    """A call or an answer was not sent over a relay link, because too much waits to be sent.

    Attributes:
        waiting: Bytes that wait.
        size: Bytes of what was not sent.
    """

    def __init__(self, waiting: int, size: int) -> None:
        super().__init__(waiting, size)
        self.waiting = waiting
        self.size = size

    def __str__(self) -> str:
        return (
            f"the relay's connection is too slow: {self.waiting} bytes wait to be sent,"
            f" {self.size} more do not fit"
        )


class LinkBrokenError(MultimasterError):
    """The other end of a relay link breaks the protocol or refuses this one."""


class SecondLinkError(LinkBrokenError):
    """Both sides of a relay have dialed each other; their other link is kept.

    Attributes:
        name: The other side.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name

    def __str__(self) -> str:
        return f"{self.name} and this side have dialed each other; the other of the two links is kept"
