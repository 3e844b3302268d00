"""The commands on the state: requests and events.

Commands are values: the modules that handle them define their meaning (``users``, ``task_sets``, ``robots``,
``containers``, ``wiring``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from rce.model import InterfaceSpec, NodeSpec, ParameterValue, ResourceChanges, Resources

if TYPE_CHECKING:
    from rce.control import EndpointStatus, Hello, StatusPatch
    from rce_master.state.user_records import (
        KeptAnswer,
        KnownLogin,
        PackageKey,
        Token,
        User,
        UserPackage,
        UserRole,
    )
    from rce_master.state.volume_records import SavedState


_NOTHING_REQUESTED = Resources()

# Users


@dataclass(frozen=True, slots=True, kw_only=True)
class AddUser:
    """Make a user; refused if the name exists."""

    user: User


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPassword:
    """Change a user's password; ends their tokens."""

    name: str
    password: str
    """argon2 hash."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetRole:
    """Change a user's role."""

    name: str
    role: UserRole


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveUser:
    """Remove a user with all robots, containers and tokens.

    What exceeds the work of one command is left with the user: repeat it until the user is gone.
    """

    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AddToken:
    """Keep a bearer token; forgets expired ones of the same user, and a login too many."""

    token: Token
    password: str = ""
    """Stored hash of the password that the login used; refused if the password has changed since."""
    replaces: bool = False
    """For a robot's token: whether it replaces the existing one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoteTokenUses:
    """Tokens were used."""

    used: dict[str, float]
    """By digest, in seconds since 1970."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RevokeToken:
    """Remove a bearer token of a user; ends the sessions that use it."""

    user: str
    id: str
    """As :attr:`rce_master.state.user_records.Token.id`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RevokeRobotToken:
    """Forget the token of a robot; ends the robot's session."""

    user: str
    robot: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveToken:
    """Forget a bearer token."""

    digest: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SetLimits:
    """Change a user's limits."""

    user: str
    limits: dict[str, float | None]
    """By fields of :class:`rce_master.state.user_records.UserLimits`: 0: no limit, None: as for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RememberLogin:
    """Keep the mark of a correct password."""

    login: KnownLogin


# Requests that are repeated


@dataclass(frozen=True, slots=True, kw_only=True)
class Once:
    """Do a command and keep the answer to its request, both or neither."""

    command: Command
    answer: KeptAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class ForgetAnswers:
    """Forget kept answers that are too old, a part of them if there are many."""

    now: float
    """Seconds since 1970."""


# Packages that users bring


@dataclass(frozen=True, slots=True, kw_only=True)
class AddPackageKey:
    """Trust a user's key."""

    key: PackageKey


@dataclass(frozen=True, slots=True, kw_only=True)
class RemovePackageKey:
    """Stop trusting a user's key."""

    user: str
    id: str
    """As :func:`rce.packages.signing.key_id` names it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AddPackage:
    """Store a version of a package; the sender of this command has verified it."""

    package: UserPackage


@dataclass(frozen=True, slots=True, kw_only=True)
class RemovePackage:
    """Remove a version of a package; refused while a node needs it."""

    user: str
    name: str
    version: str


# Volumes


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveVolume:
    """Remove a volume with its files; refused while a container has it."""

    user: str
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeRemoved:
    """A task set has removed the files of a volume."""

    process: str
    volume: str
    """``user/name``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotTaken:
    """A task set took a snapshot of a volume; the sender of this command has seen that masters hold it."""

    process: str
    volume: str
    """``user/name``."""
    placement: int
    is_last: bool
    """Whether its container has ended."""
    snapshot: str = ""
    """SHA-256 of the manifest, in hex; empty if there is an error."""
    size: int = 0
    """Bytes."""
    taken: float = 0.0
    """Seconds since 1970."""
    error: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotLost:
    """The masters do not hold a snapshot of a volume that the state names, as after a backup was restored."""

    volume: str
    snapshot: str


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeRestored:
    """A task set has made the files of a volume's snapshot, or could not."""

    process: str
    volume: str
    placement: int
    error: str = ""


# States of nodes


@dataclass(frozen=True, slots=True, kw_only=True)
class SaveState:
    """Keep a snapshot of a node's state; its contents are kept already."""

    state: SavedState


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveState:
    """Remove the saved state of a node."""

    user: str
    container: str
    node: str


# Task sets


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSetArrived:
    """A task set connected."""

    hello: Hello


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSetLeft:
    """A task set's channel ended."""

    process: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReported:
    """A task set reported an endpoint."""

    process: str
    status: EndpointStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusPatched:
    """A task set reported what changed of an endpoint."""

    process: str
    patch: StatusPatch


@dataclass(frozen=True, slots=True, kw_only=True)
class SpecRequested:
    """A task set asked for the whole spec of an endpoint, because a patch did not fit its revision."""

    process: str
    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EndpointGone:
    """A task set ended an endpoint."""

    process: str
    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultReported:
    """A task set reported a fault."""

    id: str
    text: str
    robot: str = ""
    """Endpoint id of the robot to notify; empty: all robots of the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotLogin:
    """An authenticated robot wants to connect at a task set."""

    process: str
    id: str
    credential: str = ""
    """Digest of the token that it used; empty: its user's password. Refused if it was revoked."""
    password: str = ""
    """Stored hash of the password that it used; refused if the password has changed since."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotLeft:
    """A robot's connection ended."""

    process: str
    id: str
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetDraining:
    """An operator starts or cancels the drain of a machine."""

    machine: str
    """Its name, or that of a task set."""
    draining: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveContainer:
    """An operator has a container handed over to another machine."""

    user: str
    """The container's."""
    tag: str
    machine: str
    """Its name, or that of its container task set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Continue:
    """Do more of the work that a command left over (:attr:`rce_master.state.changes.Changes.unfinished`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """Time passed: grace times end, waiting containers are placed."""


# Requests of users. ``user`` owns the endpoints; tags are the user's.


@dataclass(frozen=True, slots=True, kw_only=True)
class CreateContainer:
    """``CC``."""

    user: str
    tag: str
    resources: Resources = _NOTHING_REQUESTED
    wait: bool = False
    """Whether to wait for room if no machine has room now; else the request is refused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResizeContainer:
    """``RC``."""

    user: str
    tag: str
    changes: ResourceChanges


@dataclass(frozen=True, slots=True, kw_only=True)
class DestroyContainer:
    """``DC``."""

    user: str
    tag: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AddNode:
    """Start a node in a container."""

    user: str
    container: str
    node: NodeSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveNode:
    """Stop a node."""

    user: str
    container: str
    tag: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SetParameter:
    """Set a parameter of a container; replaces an existing value."""

    user: str
    container: str
    name: str
    value: ParameterValue


@dataclass(frozen=True, slots=True, kw_only=True)
class DeleteParameter:
    """Delete a parameter of a container."""

    user: str
    container: str
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AddInterface:
    """Make an interface of a robot or a container."""

    user: str
    endpoint: str
    interface: InterfaceSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveInterface:
    """Remove an interface with its connections."""

    user: str
    endpoint: str
    tag: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Connect:
    """Connect two interfaces, each written ``ENDPOINT/INTERFACE``."""

    user: str
    tag_a: str
    tag_b: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Disconnect:
    """Disconnect two interfaces, each written ``ENDPOINT/INTERFACE``."""

    user: str
    tag_a: str
    tag_b: str


Request: TypeAlias = (
    CreateContainer
    | ResizeContainer
    | DestroyContainer
    | AddNode
    | RemoveNode
    | SetParameter
    | DeleteParameter
    | AddInterface
    | RemoveInterface
    | Connect
    | Disconnect
)
"""What users ask for."""

Command: TypeAlias = (
    AddUser
    | SetPassword
    | SetRole
    | RemoveUser
    | AddToken
    | RemoveToken
    | NoteTokenUses
    | RevokeToken
    | RevokeRobotToken
    | RememberLogin
    | SetLimits
    | Once
    | ForgetAnswers
    | AddPackageKey
    | RemovePackageKey
    | AddPackage
    | RemovePackage
    | RemoveVolume
    | VolumeRemoved
    | SnapshotTaken
    | SnapshotLost
    | VolumeRestored
    | SaveState
    | RemoveState
    | TaskSetArrived
    | TaskSetLeft
    | StatusReported
    | StatusPatched
    | SpecRequested
    | EndpointGone
    | FaultReported
    | RobotLogin
    | RobotLeft
    | SetDraining
    | MoveContainer
    | Continue
    | Tick
    | Request
)
