"""The messages between the manager and an environment (JSON lines on the control socket, tagged by ``t``).

Both run on one machine, and are of one release but for a manager that was upgraded while its containers ran:
later additions have a default, or are sent only to an environment whose ``features`` name them. Another
manager may replace one that died: the newest connection counts, and an environment first sends a
:class:`Report` on it.
"""

from __future__ import annotations

import msgspec
from msgspec import Struct, field

from rce.control import (
    EndpointSpec,
    EndpointStatus,
    InterfaceUsage,
    LinkAddress,
    SpecPatch,
    StatusPatch,
    TaggedReader,
)
from rce.control.execution import Command


class Boot(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The configuration of an environment at its start, as JSON in its first argument. Holds no secret.

    Its standard input is a listening unix socket for managers, its standard output one for peers' links.
    """

    id: str
    """Endpoint id, ``user/tag``."""
    mark: str
    """Names this incarnation of the container; see :data:`rce_container.environment.proc.MARK`."""
    machine: str
    """See :class:`rce.control.model.LinkAddress`."""
    home: str
    logs: str
    tls: bool = False
    """Whether links by TCP must be in TLS."""
    ros_port: int
    """Port of the container's ROS core on 127.0.0.1; 0 takes a free one."""
    isolated: bool
    """Whether the environment is process 1 of its own pid namespace."""
    address: str = "127.0.0.1"
    """Where the container's nodes are reached by others of its group; loopback if it has none."""
    rlimits: dict[int, int] = {}
    """The limits that each of its processes sets for itself, by the numbers of :mod:`resource`."""
    packages: tuple[str, ...] = ()
    user_packages: str = field(default="", name="bundles")
    """Folder in which the user's packages appear; see :mod:`rce_container.environment.user_packages`."""
    grace: float = 30.0
    """Seconds without a manager after which the environment ends itself."""
    interrupt_timeout: float = 15.0
    """Seconds that a node has to end after SIGINT, before it gets SIGTERM."""
    terminate_timeout: float = 2.0
    """Seconds that a node has to end after SIGTERM, before it gets SIGKILL."""


class _Message(Struct, kw_only=True, omit_defaults=True, tag_field="t"):
    """Base of all messages."""


# Manager to environment


class Apply(_Message):
    """The whole desired state of the container."""

    spec: EndpointSpec


class ApplyPatch(_Message):
    """A change of the container's desired state. Only to environments with the feature ``patches``."""

    patch: SpecPatch


class Shelved(_Message):
    """Packages that the user brought have arrived."""


class Handover(_Message):
    """Comes with a socket, on which the manager hands accepted links over (:mod:`rce.link.handover`)."""

    features: tuple[str, ...] = ()
    """The features of this manager that earlier releases do not have."""


class Dialed(_Message):
    """Answer to :class:`Dial`. Comes with the descriptor, unless there is an error."""

    request: int
    error: str = ""


class Cause(_Message):
    """Answer to :class:`Killed`."""

    request: int
    text: str = ""
    """As text; empty if no cause is known."""


class Poll(_Message):
    """Asks for :class:`Counters`."""


class Execute(_Message):
    """Run a command. Comes with a socket that keeps message boundaries (:mod:`rce.control.execution`)."""

    command: Command


class SaveState(_Message):
    """Make a snapshot of a node's state now. Answered by :class:`StateSaved`.

    Only to environments with the feature ``node-states``; so are the next two.
    """

    request: int
    node: str
    """Its tag."""


class OpenState(_Message):
    """Answer to :class:`StateWanted` and :class:`StateOffered`.

    Comes with a socket that carries the snapshot, if there is one: down its size in eight bytes and then the
    snapshot, or up the snapshot.
    """

    request: int
    empty: bool = False
    """There is no snapshot, and no socket."""


class StateDone(_Message):
    """Last answer to :class:`StateOffered`, or to :class:`StateWanted` if it fails."""

    request: int
    error: str = ""


class Stop(_Message):
    """Stop all nodes and end."""


# Environment to manager


class Report(_Message):
    """The whole status; sent on connection and after every change."""

    status: EndpointStatus
    """Without incarnation and address, which the manager knows; pids as the environment sees them."""
    features: tuple[str, ...] = ()
    """The features of this environment that earlier releases do not have."""


class ReportPatch(_Message):
    """A change of the status. Only to managers with the feature ``patches``."""

    patch: StatusPatch


class SpecWanted(_Message):
    """A patch did not fit the desired state here. Answered by :class:`Apply`."""


class Fault(_Message):
    """Something failed that the user must know of."""

    text: str


class Counters(_Message):
    """Answer to :class:`Poll`."""

    interfaces: dict[str, InterfaceUsage] = {}
    traffic: tuple[int, int] = (0, 0)
    """Bytes that came in and went out on all links, frame headers included."""


class Dial(_Message):
    """Asks for a connection to a peer that is out of reach from inside. Answered by :class:`Dialed`."""

    request: int
    address: LinkAddress


class Killed(_Message):
    """Asks why a process ended by SIGKILL. Answered by :class:`Cause`."""

    request: int


class StateWanted(_Message):
    """Asks for the newest snapshot of a node's state. Answered by :class:`OpenState`.

    Only to managers with the feature ``node-states``; so are the next two.
    """

    request: int
    node: str
    """Its tag."""


class StateOffered(_Message):
    """Asks to keep a snapshot. Answered by :class:`OpenState`, then :class:`StateDone`."""

    request: int
    """Grows; a snapshot with a smaller number is older."""
    node: str
    """Its tag."""
    size: int
    """Bytes."""


class StateSaved(_Message):
    """Answer to :class:`SaveState`."""

    request: int
    error: str = ""
    """Why the state is not saved; empty if the snapshot is acknowledged."""


ToEnvironment = (
    Apply
    | ApplyPatch
    | Shelved
    | Handover
    | Dialed
    | Cause
    | Poll
    | Execute
    | SaveState
    | OpenState
    | StateDone
    | Stop
)
ToManager = (
    Report
    | ReportPatch
    | SpecWanted
    | Fault
    | Counters
    | Dial
    | Killed
    | StateWanted
    | StateOffered
    | StateSaved
)

encode = msgspec.json.Encoder().encode
"""Write a message as JSON; holds no newline."""
decode_boot = msgspec.json.Decoder(Boot).decode
decode_to_environment = TaggedReader[ToEnvironment](ToEnvironment).read
"""Read a message that came from a manager."""
decode_to_manager = TaggedReader[ToManager](ToManager).read
"""Read a message that came from an environment."""
