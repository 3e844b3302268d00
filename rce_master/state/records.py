"""The records of robots, containers and task sets. All are immutable: a change replaces a record.

Persistent records go to the store; the others (what is observed now) are made again after a restart. Other
records are in ``user_records``, ``volume_records`` and ``wiring_records``.
"""

from __future__ import annotations

from typing import TypeAlias

from msgspec import Struct
from msgspec.structs import replace

from rce.control import EndpointKind, EndpointStatus, LinkAddress, MachineInfo, TaskSetKind
from rce.lifecycle import remember
from rce.model import NodeSpec, ParameterValue, Resources
from rce_master.state.lifecycle import (
    CONTAINER_LIFE,
    ROBOT_LIFE,
    ContainerEvent,
    ContainerPhase,
    RobotEvent,
    RobotSession,
)


class _Endpoint(Struct, frozen=True, kw_only=True):
    """The base of robots and containers."""

    id: str
    """``user/tag``."""
    revision: int = 0
    task_set: str = ""
    """Process name of the task set that is responsible; empty: none."""
    epoch: int = 0
    """Grows with each task set that becomes responsible: what still dials from former ones says less."""
    size: int = 0
    """Bytes of its contents, as :func:`rce_master.state.endpoints.size_of` counts them."""

    @property
    def user(self) -> str:
        """The user it belongs to."""
        return self.id.partition("/")[0]

    @property
    def tag(self) -> str:
        """Its name among the user's robots and containers."""
        return self.id.partition("/")[2]


class Robot(_Endpoint, frozen=True, kw_only=True, tag=True):
    """A robot that logged in and is kept until its grace time is over."""

    credential: str = ""
    """Digest of the token that it last logged in by; empty: by its user's password."""

    @property
    def kind(self) -> EndpointKind:
        """What an endpoint this is."""
        return EndpointKind.ROBOT


class Container(_Endpoint, frozen=True, kw_only=True, tag=True):
    """A desired container."""

    resources: Resources = Resources()
    made: Resources | None = None
    """What it was asked for with at first, if it was resized since."""
    number: int = 0
    """Grows from container to container: the order in which they were asked for."""
    born: int = 0
    """The newest revision when it was asked for: what was told of less is a former one of the same name."""
    nodes: dict[str, NodeSpec] = {}
    """By tag."""
    parameters: dict[str, ParameterValue] = {}
    """By name."""
    address: LinkAddress = LinkAddress()
    """Where it last accepted links; kept so that a restarted master desires what it desired before."""

    @property
    def kind(self) -> EndpointKind:
        """What an endpoint this is."""
        return EndpointKind.CONTAINER


Endpoint: TypeAlias = Robot | Container


class TaskSet(Struct, frozen=True, kw_only=True):
    """A task set that is connected, or was recently."""

    process: str
    kind: TaskSetKind
    machine: MachineInfo
    url: str = ""
    address: LinkAddress = LinkAddress()
    bearer: bool = False
    """Whether its robots may show their credential in the header ``Authorization``."""
    snapshots: bool = False
    """Whether it saves and restores volumes."""


class Drain(Struct, frozen=True, kw_only=True):
    """A task set that is drained; kept until the operator cancels the drain, or a robot task set is gone."""

    process: str
    """Its name."""


class Counter(Struct, frozen=True, kw_only=True):
    """A number that only increases: its values are never reused."""

    name: str
    value: int


class RobotLive(Struct, frozen=True, kw_only=True):
    """What is observed of a robot."""

    id: str
    session: RobotSession
    since: float
    """When the session became so; seconds of the clock that commands are applied with."""
    status: EndpointStatus | None = None
    recent: tuple[RobotEvent, ...] = ()
    """What happened to it last."""

    def after(self, event: RobotEvent, now: float) -> RobotLive:
        """Return this record after an event.

        Raises:
            TransitionError: The event cannot happen now.
        """
        session = ROBOT_LIFE.advance(self.session, event, self.id, self.recent)
        return replace(self, session=session, since=now, recent=remember(self.recent, event))


class ContainerLive(Struct, frozen=True, kw_only=True):
    """What is observed of a container."""

    id: str
    phase: ContainerPhase
    since: float
    """When the phase became so; seconds of the clock that commands are applied with."""
    status: EndpointStatus | None = None
    told: bool = False
    """Whether its user was told that there is nowhere to place it."""
    stays: str = ""
    """Why it waits for a machine, as its user was told, or is still at one that is draining, as operators
    were."""
    rest_until: float = 0.0
    """When a move of it that failed may be tried again."""
    recent: tuple[ContainerEvent, ...] = ()
    """What happened to it last."""

    def after(self, event: ContainerEvent, now: float) -> ContainerLive:
        """Return this record after an event.

        Raises:
            TransitionError: The event cannot happen now.
        """
        phase = CONTAINER_LIFE.advance(self.phase, event, self.id, self.recent)
        return replace(self, phase=phase, since=now, recent=remember(self.recent, event))


class Move(Struct, frozen=True, kw_only=True):
    """A container that is being handed over from the machine where it is to another."""

    id: str
    to: str
    """Process name of the task set that was told to make its copy."""
    since: float
    epoch: int = 0
    """The container's when the copy has taken over."""
    status: EndpointStatus | None = None
    """What is reported of the copy."""
    linking_since: float | None = None
    """When its nodes were up, and it was told to make its links; None: not yet."""
    connections: frozenset[int] = frozenset()
    """Those that it reports as established."""


class Departure(Struct, frozen=True, kw_only=True):
    """A container that was handed over, at its former machine, where it gives its last answers."""

    id: str
    process: str
    """Of the former task set."""
    since: float
    number: int
    """Of the last report from there."""
    connections: frozenset[int]
    """Those that are still established there."""


Live: TypeAlias = RobotLive | ContainerLive


class Presence(Struct, frozen=True, kw_only=True):
    """Whether a task set is connected."""

    process: str
    connected: bool
    since: float
    leaving: bool = False
    """Whether it went away, and some of its robots may still count as connected."""


class Lockout(Struct, frozen=True, kw_only=True):
    """A user some of whose robots may still have sessions that are to end."""

    user: str


class Tombstone(Struct, frozen=True, kw_only=True):
    """A container that a task set was told to drop and has not reported gone.

    Until it is gone, the same container is not placed at that task set again.
    """

    process: str
    id: str

    @property
    def key(self) -> str:
        """Its key."""
        return tombstone_key(self.process, self.id)


def tombstone_key(process: str, endpoint: str) -> str:
    """Tell the key of a tombstone."""
    return f"{process} {endpoint}"
