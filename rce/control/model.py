"""The desired state of an endpoint, from the master, and its status, from a task set.

An *endpoint* is a robot or a container. The master sends its :class:`EndpointSpec`, with a growing revision,
to the task set where it is placed: whole at first, then what changed (:class:`SpecPatch`). The task set
compares it with the actual state and reconciles the two. Applying the same spec twice changes nothing. The
status goes the other way in the same forms: :class:`EndpointStatus`, then :class:`StatusPatch`.
"""

from __future__ import annotations

from enum import Enum

from msgspec import Struct, field

from rce.model import InterfaceSpec, NodeSpec, ParameterSpec, Resources

PATCHES = "patches"
"""The feature of programs that take and send patches in place of whole specs and statuses."""


class LinkAddress(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The address of an endpoint for links. On the same machine the unix socket is used, else TCP."""

    machine: str = ""
    """Equal strings mean that the unix socket of one can be reached from the other."""
    unix: str = ""
    host: str = ""
    port: int = 0
    tls: bool = False
    """Whether links by TCP must be in TLS (:mod:`rce.link.encryption`)."""


class LinkSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One end of a link to a peer endpoint. Exactly one of the two ends has ``dial`` set.

    The link of an endpoint with itself is listed once, and neither end dials it.
    """

    id: str
    peer: str
    """The peer's endpoint id, ``user/tag``."""
    token: str
    """A secret that the master gave both ends; the dialing end authenticates with it."""
    dial: bool
    address: LinkAddress = LinkAddress()
    """Where to dial; empty while the peer is not up (yet)."""
    next: LinkAddress | None = None
    """Where to dial beside it: the copy of a peer that is being moved (:mod:`rce.link.takeover`)."""
    copy: bool = False
    """Whether this end belongs to such a copy: it is silent until this is no longer set."""
    epoch: int = 0
    """Of the dialing end: grows whenever its endpoint gets another place; 0 is unknown."""
    peer_epoch: int = 0
    """Of the accepting end: it takes no link of a place with a lower epoch, which the peer has left."""


class ConnectionSpec(Struct, frozen=True, kw_only=True):
    """A connection of a local interface with a peer's interface; its id is the channel number on the link."""

    id: int
    link: str
    interface: str
    peer_interface: str


class PackageSpec(Struct, frozen=True, kw_only=True):
    """A version of a package that a user brought to the engine; mounted read-only on the package path."""

    name: str
    version: str
    sha256: str
    """Of the archive, in hex; names its content everywhere."""
    signature: str
    """Ed25519, in hex, over what :mod:`rce.packages` says."""
    key: str
    """The public key that made the signature, in hex."""


class VolumePlacement(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Which files of a volume a container is to have: a machine may hold those of an earlier placement."""

    name: str
    number: int
    """Grows each time that the volume is placed on another machine."""
    is_new: bool = False
    """Whether this placement began without files; else the machine must hold those that were restored."""


class EndpointKind(Enum):
    """The kind of an endpoint."""

    ROBOT = "robot"
    CONTAINER = "container"


class EndpointSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The whole desired state of one endpoint."""

    id: str
    kind: EndpointKind
    revision: int
    interfaces: tuple[InterfaceSpec, ...] = ()
    links: tuple[LinkSpec, ...] = ()
    connections: tuple[ConnectionSpec, ...] = ()
    resources: Resources = Resources()
    nodes: tuple[NodeSpec, ...] = ()
    parameters: tuple[ParameterSpec, ...] = ()
    packages: tuple[PackageSpec, ...] = field(default=(), name="bundles")
    volumes: tuple[VolumePlacement, ...] = ()
    """Of those in :attr:`resources`; what a task set of an earlier release passes over."""


class EndpointContents(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The contents of an endpoint's spec beside interfaces, links and connections."""

    resources: Resources = Resources()
    nodes: tuple[NodeSpec, ...] = ()
    parameters: tuple[ParameterSpec, ...] = ()
    packages: tuple[PackageSpec, ...] = ()
    volumes: tuple[VolumePlacement, ...] = ()


class SpecPatch(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The changes in the spec of an endpoint. It applies only to the revision ``base``."""

    id: str
    base: int
    revision: int
    """Of the spec when the patch is applied."""
    interfaces: tuple[InterfaceSpec, ...] = ()
    """New, or changed; so are links and connections."""
    links: tuple[LinkSpec, ...] = ()
    connections: tuple[ConnectionSpec, ...] = ()
    removed_interfaces: tuple[str, ...] = ()
    """By tag."""
    removed_links: tuple[str, ...] = ()
    """By id."""
    removed_connections: tuple[int, ...] = ()
    """By id."""
    contents: EndpointContents | None = None
    """None: as before."""


class NodeState(Enum):
    """The state of a node in its life cycle."""

    WAITING = "waiting"
    """Not started (again) yet: nodes that it comes after are not ready, or it ended and pauses."""
    STARTING = "starting"
    """The process was started, and has not registered with the ROS core, or not got its state, yet."""
    RUNNING = "running"
    """Registered with the container's ROS core, and restored if its state is kept."""
    STUCK = "stuck"
    """Runs, but sends no heartbeat."""
    STOPPING = "stopping"
    """Ordered to end."""
    EXITED = "exited"
    """Ended with exit code 0."""
    FAILED = "failed"
    """Could not be started, or ended by a signal or with another exit code."""


class NodeStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The status of one node, as its container reports it."""

    tag: str
    state: NodeState
    pid: int = 0
    exit_code: int | None = None
    """As :attr:`subprocess.Popen.returncode`: negative for a signal."""
    restarts: int = 0
    """How often it was started again by itself."""
    detail: str = ""


class EndpointState(Enum):
    """The state of an endpoint in its life cycle, as its task set sees it."""

    STARTING = "starting"
    RUNNING = "running"
    """A container whose environment answers; a robot that is connected."""
    DEGRADED = "degraded"
    """A container with a node that failed, is stuck, pauses after a failure, or did not get its state."""
    ABSENT = "absent"
    """A robot whose connection dropped and that may still come back."""
    STOPPING = "stopping"
    FAILED = "failed"


class EndpointStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The whole status of one endpoint, as a task set reports it."""

    id: str
    revision: int
    """The newest spec revision that was applied."""
    state: EndpointState
    incarnation: str = ""
    """Changes whenever the endpoint is made again (a restarted container)."""
    detail: str = ""
    nodes: tuple[NodeStatus, ...] = ()
    interfaces: dict[str, bool] = {}
    """Interface tag to whether it is active (has an established connection)."""
    connections: tuple[int, ...] = ()
    """Ids of the established connections."""
    address: LinkAddress = LinkAddress()
    client: str = ""
    """From where and since when a robot is connected, as a text for its user; robots only."""
    number: int = 0
    """Counts the reports of this endpoint; a patch has the number after that of the status it fits."""


class StatusPatch(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The changes in the status of an endpoint. It applies only to the status with the number before it."""

    status: EndpointStatus
    """As it is now; but of interfaces only those that are new or changed, and of connections only those that
    were established since."""
    removed_interfaces: tuple[str, ...] = ()
    lost_connections: tuple[int, ...] = ()
    """No longer established, or removed."""


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


class NodeUsage(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The resources that a node uses, with all processes that it started."""

    cpu_s: float = 0.0
    memory: int = 0
    """Bytes, proportional share (PSS)."""
    processes: int = 0


class EndpointUsage(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The resources that an endpoint uses. All but the interfaces: containers only."""

    interfaces: dict[str, InterfaceUsage] = {}
    nodes: dict[str, NodeUsage] = {}
    cpu_s: float = 0.0
    """CPU seconds since start."""
    throttled_s: float = 0.0
    """Seconds in which it was held back by its CPU limit."""
    memory: int = 0
    """Bytes in use."""
    memory_peak: int = 0
    """Bytes, the most since the start; 0 if it is not measured."""
    memory_limit: int = 0
    """Bytes; 0 without a limit."""
    cpu_limit: float = 0.0
    """Cores; 0 without a limit."""
    oom_kills: int = 0
    """Processes that were killed because memory ran out."""
    io_read: int = 0
    """Bytes read from disks."""
    io_written: int = 0
    link_in: int = 0
    """Bytes that came in on its links."""
    link_out: int = 0
    processes: int = 0
