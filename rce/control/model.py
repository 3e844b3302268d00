"""What the master desires of an endpoint and what a task set reports of it.

An *endpoint* is a robot or a container. The master keeps one :class:`EndpointSpec` for each and sends it
whole, with a growing revision, to the task set where the endpoint is placed; the task set compares it with
what is there and makes up the difference. Applying the same spec twice changes nothing.
"""

from __future__ import annotations

from enum import Enum

from msgspec import Struct

ParameterValue = bool | int | float | str | list[bool | int | float | str]
"""A parameter's value on the wire."""


class InterfaceSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An interface of an endpoint."""

    tag: str
    type: str
    """An interface type such as ``PublisherInterface`` (see :class:`rce.protocol.names.InterfaceType`)."""
    cls: str
    """Message or service class, ``package/Type``."""
    addr: str = ""
    """ROS name of the topic or service; container ends only."""


class NodeSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A node of a container."""

    tag: str
    pkg: str
    exe: str
    args: str = ""
    """Split as a POSIX shell splits, never given to one. May hold ``$(find PKG)`` and ``$(env VAR)``."""
    name: str = ""
    namespace: str = ""


class ParameterSpec(Struct, frozen=True, kw_only=True):
    """A parameter of a container's ROS parameter server."""

    name: str
    value: ParameterValue


class Resources(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a container asks for. Zero or empty means: no wish."""

    group: str = ""
    group_ip: str = ""
    size: int = 1
    cpu: float = 0.0
    """Cores."""
    memory: int = 0
    """Bytes."""
    bandwidth: int = 0
    """Bytes per second on the container's links."""
    special_features: tuple[str, ...] = ()


class LinkAddress(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where an endpoint accepts links. On the same machine the unix socket is used, else TCP."""

    machine: str = ""
    """Equal strings mean that the unix socket of one can be reached from the other."""
    unix: str = ""
    host: str = ""
    port: int = 0


class LinkSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One end of a link to a peer endpoint. Exactly one of the two ends has ``dial`` set."""

    id: str
    peer: str
    """The peer's endpoint id, ``user/tag``."""
    token: str
    """A secret that the master gave both ends; the dialing end proves with it who it is."""
    dial: bool
    address: LinkAddress = LinkAddress()
    """Where to dial; empty while the peer is not up (yet)."""


class ConnectionSpec(Struct, frozen=True, kw_only=True):
    """A connection of a local interface with a peer's interface; its id is the channel number on the link."""

    id: int
    link: str
    interface: str
    peer_interface: str


class EndpointKind(Enum):
    """What an endpoint is."""

    ROBOT = "robot"
    CONTAINER = "container"


class EndpointSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All that the master desires of one endpoint."""

    id: str
    kind: EndpointKind
    revision: int
    interfaces: tuple[InterfaceSpec, ...] = ()
    links: tuple[LinkSpec, ...] = ()
    connections: tuple[ConnectionSpec, ...] = ()
    resources: Resources = Resources()
    nodes: tuple[NodeSpec, ...] = ()
    parameters: tuple[ParameterSpec, ...] = ()


class NodeState(Enum):
    """Where a node is in its life."""

    STARTING = "starting"
    """The process was started and has not registered with the container's ROS core yet."""
    RUNNING = "running"
    STOPPING = "stopping"
    EXITED = "exited"
    """Ended by itself with exit code 0."""
    FAILED = "failed"
    """Could not be started, or ended by a signal or with another exit code."""


class NodeStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a container reports of one node."""

    tag: str
    state: NodeState
    pid: int = 0
    exit_code: int | None = None
    """As :attr:`subprocess.Popen.returncode`: negative for a signal."""
    detail: str = ""


class EndpointState(Enum):
    """Where an endpoint is in its life, as its task set sees it."""

    STARTING = "starting"
    RUNNING = "running"
    """A container whose environment answers; a robot that is connected."""
    ABSENT = "absent"
    """A robot whose connection dropped and that may still come back."""
    STOPPING = "stopping"
    FAILED = "failed"


class EndpointStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All that a task set reports of one endpoint; sent whole whenever something in it changed."""

    id: str
    revision: int
    """The newest spec revision that was applied."""
    state: EndpointState
    incarnation: str = ""
    """Changes whenever the endpoint is made anew (a restarted container)."""
    detail: str = ""
    nodes: tuple[NodeStatus, ...] = ()
    interfaces: dict[str, bool] = {}
    """Interface tag to whether it is active (has an established connection)."""
    connections: tuple[int, ...] = ()
    """Ids of the established connections."""
    address: LinkAddress = LinkAddress()


class InterfaceUsage(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Counters of one interface since its endpoint was made."""

    messages_in: int = 0
    """From peers."""
    messages_out: int = 0
    """To peers."""
    bytes_in: int = 0
    bytes_out: int = 0
    dropped: int = 0
    """Messages that a full queue threw away."""


class EndpointUsage(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What an endpoint consumes."""

    interfaces: dict[str, InterfaceUsage] = {}
    cpu_s: float = 0.0
    """CPU seconds since start; containers only."""
    memory: int = 0
    """Resident bytes; containers only."""
    processes: int = 0
