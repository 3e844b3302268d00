"""The messages on the control channel (JSON text frames, tagged by ``t``).

A task set dials the master and sends :class:`Hello`. The master answers :class:`Welcome` and
:class:`Sync` with the whole desired state of the task set; later it sends single :class:`Put`,
:class:`PatchSpec` and :class:`Drop`. Reports work the same way: the whole state in ``Hello``, then
:class:`Status` and :class:`PatchStatus`. A receiver whose state does not fit a patch asks for the whole.
Messages with a ``request`` number are answered by the reply with the same number.

Programs of two releases that follow each other talk to one another: the master takes task sets of this
version and of the one before. What is added later is either a field with a default, which the other side
passes over, or a message that is sent only to a peer whose ``features`` name it. A message that is not known
is passed over too.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import msgspec
from msgspec import Struct, field

from rce.control.execution import Command
from rce.control.logs import LogQuery
from rce.control.model import (
    EndpointSpec,
    EndpointStatus,
    EndpointUsage,
    LinkAddress,
    SpecPatch,
    StatusPatch,
)
from rce.control.tags import TaggedReader
from rce.model import Request

CONTROL_VERSION = 2
ACCEPTED_VERSIONS = (1, CONTROL_VERSION)
"""Of task sets: a new master works with those that are not upgraded yet."""


TYPED_REQUESTS = "typed-requests"
"""A feature of masters: they take :attr:`ClientRequest.content`."""


VOLUMES = "volumes"
"""A feature of container task sets: they take :class:`RemoveVolume`."""


SNAPSHOTS = "snapshots"
"""A feature. Container task sets: they take :class:`SaveVolume` and :class:`RestoreVolume`. Masters: they
take snapshots (:mod:`rce.control.snapshots`)."""


NODE_STATES = "node-states"
"""A feature of masters, container task sets and their environments: they keep snapshots of nodes' states
(:mod:`rce.control.node_states`)."""


class VolumeLimit(Enum):
    """How a machine keeps volumes within their size."""

    IMAGE = "image"
    """Each is a file system of its size: a write beyond it fails with ENOSPC."""
    WATCHED = "watched"
    """They are folders that are measured; a container whose volume is too large is ended."""


class TaskSetKind(Enum):
    """Which kind of task set dials."""

    ROBOT = "robot"
    CONTAINER = "container"


class MachineInfo(Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field=None):
    """The machine a task set runs on."""

    name: str
    cores: int = 0
    memory: int = 0
    """Bytes."""
    runtime: str = ""
    """The runtime in use; container task sets only."""
    labels: tuple[str, ...] = ()
    slots: int = 0
    """How many slots its containers may take in all; 0 if it is not counted."""
    limits: str = ""
    """How limits are enforced: ``cgroup2``, ``cgroup1``, ``rlimit``; container task sets only."""
    networks: tuple[str, ...] = ("none",)
    """The values of :class:`rce.model.specs.Network` that containers can have here."""
    runtimes: tuple[str, ...] = ()
    """All runtimes that work here."""
    draining: bool = False
    """It takes no new containers: its operator said so where it runs."""
    requirements: bool = False
    """Whether it installs what packages that users bring ask for in their ``requirements.txt``."""
    volumes: str = ""
    """How the size of volumes is enforced, a :class:`VolumeLimit`; empty: containers cannot have any."""
    detail: str = ""
    """Text on what is missing on this machine."""


class _Message(Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="t"):
    """Base of all control messages."""


# Task set to master


class Hello(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """First message of a task set."""

    version: int
    kind: TaskSetKind
    process: str
    """Names the task set; one of containers keeps it over a restart, to find its containers again."""
    machine: MachineInfo
    url: str = ""
    """Robot task sets: the WebSocket URL that clients are sent to."""
    address: LinkAddress = LinkAddress()
    """Robot task sets: where links to any of its robots are accepted."""
    endpoints: tuple[EndpointStatus, ...] = ()
    """The current status of every endpoint."""
    bearer: bool = False
    """Robot task sets: whether robots may show their credential in the header ``Authorization``."""
    features: tuple[str, ...] = ()
    """What this task set can do that one of an earlier release could not, such as
    :data:`rce.control.execution.FEATURE`."""
    term: int = 0
    """The newest term of leadership that it has seen; 0: none."""


class Status(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """An endpoint changed."""

    status: EndpointStatus


class PatchStatus(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """The changes of an endpoint. Only to masters with the feature :data:`rce.control.model.PATCHES`."""

    patch: StatusPatch


class SpecWanted(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A patch did not fit what is desired here. Answered by :class:`Put`, if the endpoint is placed here."""

    id: str


class Gone(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A dropped endpoint and everything that belonged to it was removed."""

    id: str
    revision: int


class Fault(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A failure that the endpoint's user must know of; becomes an ``ER`` and an event."""

    id: str
    text: str
    robot: str = ""
    """Endpoint id of the robot to tell; all robots of the user if empty."""


class Usage(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Periodic counters of a task set."""

    cpu_s: float
    memory: int
    endpoints: dict[str, EndpointUsage]
    held: int = 0
    """Bytes of messages that wait or are incomplete."""
    shed: int = 0
    """How often a user held too much, and lost the oldest of it."""
    turned_away: int = 0
    """Connections that were closed because too many had not authenticated."""
    volumes: dict[str, int] = {}
    """Bytes that volumes hold, by ``user/name``, as far as they were measured."""


class VolumeRemoved(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to :class:`RemoveVolume`: the files are gone."""

    volume: str


class VolumeSaved(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A snapshot of a volume was sent to the master; or, as the answer to :class:`SaveVolume`, it was not."""

    volume: str
    placement: int
    """The number of the placement whose files these are."""
    snapshot: str = ""
    """SHA-256 of its manifest, in hex; empty if there is an error."""
    is_last: bool = False
    """Whether it is the answer to :class:`SaveVolume`: its container has ended."""
    error: str = ""
    """Why there is none."""


class VolumeRestored(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to :class:`RestoreVolume`."""

    volume: str
    placement: int
    error: str = ""
    """Why it was not restored; empty if it was."""


class StateSaved(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to :class:`SaveState`."""

    request: int
    error: str = ""
    """Why the state is not saved; empty if the snapshot is acknowledged."""


class Login(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A robot wants to connect. Answered by :class:`LoginReply`."""

    request: int
    user: str
    robot: str
    password: str
    """SHA-256 of the password, in hex, as the client sent it; empty: there is a token."""
    address: str = ""
    """Where the robot connects from, as :func:`rce.guard.lobby.address_of` writes it."""
    token: str = ""
    """The robot's own token."""

    def __repr__(self) -> str:
        return f"Login(request={self.request}, user={self.user!r}, robot={self.robot!r})"


class Left(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A robot's connection ended."""

    id: str
    reason: str


class ClientRequest(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A client's CC, DC, CN or CX. Answered by :class:`ClientReply`."""

    request: int
    id: str
    """Endpoint id of the robot that asks."""
    type: str
    data: Any
    """As the client sent it, for masters of the release before; else None."""
    content: Request | None = None
    """The request; for masters whose ``features`` name :data:`TYPED_REQUESTS`."""
    repeated: bool = False
    """Whether it was sent before, and may have been done; a master of an earlier release passes over this."""


class LogChunk(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to :class:`ReadLog`."""

    request: int
    offset: int
    """Where the next read continues."""
    text: str = ""
    error: str = ""
    incarnation: str = field(default="", name="life")
    """The container's incarnation of which this is the log."""
    ended: float = 0.0
    """When that incarnation ended, in seconds since the epoch; 0 if it has not."""
    reason: str = ""
    """Why it ended."""


# Master to task set


class Welcome(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """The master took the task set."""

    version: int
    master: str
    features: tuple[str, ...] = ()
    """What this master can do that one of an earlier release could not."""
    term: int = 0
    """The term of leadership in which everything on this connection is said; 0: there are no other masters. A
    task set that has seen a greater one does not take it."""


class Refused(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """The master does not take the task set; the channel is closed after it."""

    reason: str


class Sync(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """The whole desired state of this task set; it removes everything else."""

    endpoints: tuple[EndpointSpec, ...]


class Put(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """The desired state of one endpoint. A revision older than the applied one is ignored."""

    endpoint: EndpointSpec


class PatchSpec(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """The changes of one endpoint's desired state.

    Only to task sets with the feature :data:`rce.control.model.PATCHES`.
    """

    patch: SpecPatch


class StatusWanted(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """A patch did not fit what was reported. Answered by :class:`Status`, if the endpoint is there."""

    id: str


class Drop(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """One endpoint is not desired here any more. Answered by :class:`Gone`.

    Ignored for a robot whose login is newer: :class:`LoginReply` may overtake it in the task set.
    """

    id: str
    revision: int
    reason: str = ""
    elsewhere: bool = False
    """Whether it continues at another task set: a robot connects again, nodes' states are saved first."""


class Notify(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Send an ``ER`` to a robot, or to all connected robots of a user if ``id`` holds no slash."""

    id: str
    text: str


class Probe(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Check whether a robot is still connected: it logs in elsewhere. If not, the answer is :class:`Left`."""

    id: str


class LoginReply(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to :class:`Login`: the robot's desired state if it may come in, else when it may try again."""

    request: int
    endpoint: EndpointSpec | None = None
    status: int = 200
    """HTTP status for the handshake: 200, 401, 409 (already connected), 429, 503."""
    reason: str = ""
    retry_after: float = 0.0  # seconds; 0: not said


class RequestFault(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Why a part of a request was refused, as data; the text is in :class:`ClientReply`."""

    code: str = ""
    """A :class:`rce.model.FaultCode`, or one of a later release; empty if there is none."""
    ids: dict[str, str] = {}
    """What it is about: ``container``, ``node``, ``parameter``, ``endpoint``, ``interface``, ``a``, ``b``."""


class ClientReply(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to :class:`ClientRequest`: the texts of the ``ER`` messages to send, empty if all was done."""

    request: int
    errors: tuple[str, ...] = ()
    faults: tuple[RequestFault, ...] = ()
    """The same as data, one for each of ``errors``; empty from masters of the release before."""


class ReadLog(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Read a node's log. Answered by :class:`LogChunk`."""

    request: int
    id: str
    node: str
    """Node tag; empty for the environment's own log."""
    offset: int = 0
    """Negative: that many bytes before the end."""
    limit: int = 65536
    query: LogQuery = field(default=LogQuery(), name="wish")


class RemoveVolume(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Remove a volume that no container has; sent again after each ``Sync`` until it is answered.

    Only to task sets with the feature :data:`VOLUMES`.
    """

    volume: str
    """``user/name``."""


class SaveVolume(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Send a snapshot of a volume whose container has ended.

    Sent again after each ``Sync`` until it is answered, as is :class:`RestoreVolume`.

    Only to task sets with the feature :data:`SNAPSHOTS`; so is :class:`RestoreVolume`.
    """

    volume: str
    """``user/name``."""
    placement: int


class RestoreVolume(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Make a volume's files of a snapshot, in place of all others.

    It may be repeated, without effect then. A volume that a container has is not replaced.
    """

    volume: str
    placement: int
    """The number that the files belong to from then on."""
    snapshot: str
    """SHA-256 of its manifest, in hex."""
    size: int
    """Bytes that the volume may hold."""


class SaveState(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Save the state of a node now, because its container moves. Answered by :class:`StateSaved`.

    Only to task sets with the feature :data:`NODE_STATES`.
    """

    request: int
    id: str
    """Endpoint id of the container."""
    node: str
    """Its tag."""


class Execute(_Message, frozen=True, kw_only=True, omit_defaults=True):
    """Run a command in a container, and dial for it (:mod:`rce.control.execution`)."""

    id: str
    """Endpoint id of the container."""
    run: str
    """Names the run, 32 hexadecimal digits."""
    command: Command


ToMaster = (
    Hello
    | Status
    | PatchStatus
    | SpecWanted
    | Gone
    | Fault
    | Usage
    | VolumeRemoved
    | VolumeSaved
    | VolumeRestored
    | StateSaved
    | Login
    | Left
    | ClientRequest
    | LogChunk
)
ToTaskSet = (
    Welcome
    | Refused
    | Sync
    | Put
    | PatchSpec
    | StatusWanted
    | Drop
    | Notify
    | Probe
    | LoginReply
    | ClientReply
    | ReadLog
    | RemoveVolume
    | SaveVolume
    | RestoreVolume
    | SaveState
    | Execute
)

_encoder = msgspec.json.Encoder()


def encode(message: ToMaster | ToTaskSet) -> str:
    """Write a message as a text frame."""
    return _encoder.encode(message).decode()


decode_to_master = TaggedReader[ToMaster](ToMaster).read
"""Read a message that came from a task set."""
decode_to_task_set = TaggedReader[ToTaskSet](ToTaskSet).read
"""Read a message that came from the master."""
