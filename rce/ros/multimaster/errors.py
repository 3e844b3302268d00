"""What can go wrong between masters.

::

    RosError
    +-- MultimasterError
        +-- MalformedHeartbeat   a datagram that is not a heartbeat of a known version
        +-- MalformedState       a master's description that cannot be read
        +-- NoSuchInterface      an interface or address to discover on that is not there
        +-- NoDiscovery          no discovery runs at a master
        +-- NothingToRelay       the type of a topic or service cannot be learned: nobody offers it
        +-- LinkBroken           the other end of a relay link breaks its protocol or refuses
"""

from __future__ import annotations

from rce.ros.errors import RosError


class MultimasterError(RosError):
    """Base of all errors of :mod:`rce.ros.multimaster`."""


class MalformedHeartbeat(MultimasterError):  # noqa: N818
    """A datagram is not a heartbeat of a known version."""


class MalformedState(MultimasterError):  # noqa: N818
    """A master's description cannot be read."""


class NoSuchInterface(MultimasterError):  # noqa: N818
    """There is no such network interface or address on this machine."""


class NoDiscovery(MultimasterError):  # noqa: N818
    """No discovery runs at a master."""


class NothingToRelay(MultimasterError):  # noqa: N818
    """The type of a topic or service cannot be learned."""


class LinkBroken(MultimasterError):  # noqa: N818
    """The other end of a relay link breaks the protocol or refuses this one."""
