"""The commands on the state: requests and events.

Commands are values: the modules that handle them define their meaning (``users``, ``task_sets``, ``robots``,
``containers``, ``wiring``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

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


class AddUser(Struct, frozen=True, kw_only=True):
    """Make a user; refused if the name exists."""

    user: User


class SetPassword(Struct, frozen=True, kw_only=True):
    """Change a user's password; ends their tokens."""

    name: str
    password: str
    """argon2 hash."""
    former: str = ""
    """Stored hash of the password that allows the change; refused if the password has changed since."""


class SetRole(Struct, frozen=True, kw_only=True):
    """Change a user's role."""

    name: str
    role: UserRole


class RemoveUser(Struct, frozen=True, kw_only=True):
    """Remove a user with all robots, containers and tokens.

    What exceeds the work of one command is left with the user: repeat it until the user is gone.
    """

    name: str


class AddToken(Struct, frozen=True, kw_only=True):
    """Keep a bearer token; forgets expired ones of the same user, and a login too many."""

    token: Token
    password: str = ""
    """Stored hash of the password that the login used; refused if the password has changed since."""
    replaces: bool = False
    """For a robot's token: whether it replaces the existing one."""


class NoteTokenUses(Struct, frozen=True, kw_only=True):
    """Tokens were used."""

    used: dict[str, float]
    """By digest, in seconds since 1970."""


class RevokeToken(Struct, frozen=True, kw_only=True):
    """Remove a bearer token of a user; ends the sessions that use it."""

    user: str
    id: str
    """As :attr:`rce_master.state.user_records.Token.id`."""


class RevokeRobotToken(Struct, frozen=True, kw_only=True):
    """Forget the token of a robot; ends the robot's session."""

    user: str
    robot: str


class RemoveToken(Struct, frozen=True, kw_only=True):
    """Forget a bearer token."""

    digest: str


class SetLimits(Struct, frozen=True, kw_only=True):
    """Change a user's limits."""

    user: str
    limits: dict[str, float | None]
    """By fields of :class:`rce_master.state.user_records.UserLimits`: 0: no limit, None: as for all."""


class RememberLogin(Struct, frozen=True, kw_only=True):
    """Keep the mark of a correct password."""

    login: KnownLogin


# Requests that are repeated


class Once(Struct, frozen=True, kw_only=True):
    """Do a command and keep the answer to its request, both or neither."""

    command: Command
    answer: KeptAnswer


class ForgetAnswers(Struct, frozen=True, kw_only=True):
    """Forget kept answers that are too old, a part of them if there are many."""

    now: float
    """Seconds since 1970."""


# Packages that users bring


class AddPackageKey(Struct, frozen=True, kw_only=True):
    """Trust a user's key."""

    key: PackageKey


class RemovePackageKey(Struct, frozen=True, kw_only=True):
    """Stop trusting a user's key."""

    user: str
    id: str
    """As :func:`rce.packages.signing.key_id` names it."""


class AddPackage(Struct, frozen=True, kw_only=True):
    """Store a version of a package; the sender of this command has verified it."""

    package: UserPackage


class RemovePackage(Struct, frozen=True, kw_only=True):
    """Remove a version of a package; refused while a node needs it."""

    user: str
    name: str
    version: str


# Volumes


class RemoveVolume(Struct, frozen=True, kw_only=True):
    """Remove a volume with its files; refused while a container has it."""

    user: str
    name: str


class VolumeRemoved(Struct, frozen=True, kw_only=True):
    """A task set has removed the files of a volume."""

    process: str
    volume: str
    """``user/name``."""


class SnapshotTaken(Struct, frozen=True, kw_only=True):
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
    since: float | None = None
    """When the phase began in which the volume's move was as the report came; None: it did not move."""
    error: str = ""


class SnapshotLost(Struct, frozen=True, kw_only=True):
    """The masters do not hold a snapshot of a volume that the state names, as after a backup was restored."""

    volume: str
    snapshot: str


class VolumeRestored(Struct, frozen=True, kw_only=True):
    """A task set has made the files of a volume's snapshot, or could not."""

    process: str
    volume: str
    placement: int
    error: str = ""


# States of nodes


class SaveState(Struct, frozen=True, kw_only=True):
    """Keep a snapshot of a node's state; its contents are kept already."""

    state: SavedState


class RemoveState(Struct, frozen=True, kw_only=True):
    """Remove the saved state of a node."""

    user: str
    container: str
    node: str


# Task sets


class TaskSetArrived(Struct, frozen=True, kw_only=True):
    """A task set connected."""

    hello: Hello
    robots_follow: bool = False
    """Whether :class:`RobotsFound` commands come right behind with what it says of its robots."""


class RobotsFound(Struct, frozen=True, kw_only=True):
    """A task set that connected has these robots."""

    process: str
    statuses: tuple[EndpointStatus, ...]


class TaskSetLeft(Struct, frozen=True, kw_only=True):
    """A task set's channel ended."""

    process: str


class StatusReported(Struct, frozen=True, kw_only=True):
    """A task set reported an endpoint."""

    process: str
    status: EndpointStatus


class StatusPatched(Struct, frozen=True, kw_only=True):
    """A task set reported what changed of an endpoint."""

    process: str
    patch: StatusPatch


class SpecRequested(Struct, frozen=True, kw_only=True):
    """A task set asked for the whole spec of an endpoint, because a patch did not fit its revision."""

    process: str
    id: str


class EndpointGone(Struct, frozen=True, kw_only=True):
    """A task set ended an endpoint."""

    process: str
    id: str


class FaultReported(Struct, frozen=True, kw_only=True):
    """A task set reported a fault."""

    id: str
    text: str
    robot: str = ""
    """Endpoint id of the robot to notify; empty: all robots of the user."""


class RobotLogin(Struct, frozen=True, kw_only=True):
    """An authenticated robot wants to connect at a task set."""

    process: str
    id: str
    credential: str = ""
    """Digest of the token that it used; empty: its user's password. Refused if it was revoked."""
    password: str = ""
    """Stored hash of the password that it used; refused if the password has changed since."""


class RobotLeft(Struct, frozen=True, kw_only=True):
    """A robot's connection ended."""

    process: str
    id: str
    reason: str = ""


class SetDraining(Struct, frozen=True, kw_only=True):
    """An operator starts or cancels the drain of a machine."""

    machine: str
    """Its name, or that of a task set."""
    draining: bool


class MoveContainer(Struct, frozen=True, kw_only=True):
    """An operator has a container handed over to another machine."""

    user: str
    """The container's."""
    tag: str
    machine: str
    """Its name, or that of its container task set."""


class Continue(Struct, frozen=True, kw_only=True):
    """Do more of the work that a command left over (:attr:`rce_master.state.changes.Changes.unfinished`)."""


class Tick(Struct, frozen=True, kw_only=True):
    """Time passed: grace times end, waiting containers are placed."""


# Requests of users. ``user`` owns the endpoints; tags are the user's.


class CreateContainer(Struct, frozen=True, kw_only=True):
    """``CC``."""

    user: str
    tag: str
    resources: Resources = _NOTHING_REQUESTED
    wait: bool = False
    """Whether to wait for room if no machine has room now; else the request is refused."""


class ResizeContainer(Struct, frozen=True, kw_only=True):
    """``RC``."""

    user: str
    tag: str
    changes: ResourceChanges


class DestroyContainer(Struct, frozen=True, kw_only=True):
    """``DC``."""

    user: str
    tag: str


class AddNode(Struct, frozen=True, kw_only=True):
    """Start a node in a container."""

    user: str
    container: str
    node: NodeSpec


class RemoveNode(Struct, frozen=True, kw_only=True):
    """Stop a node."""

    user: str
    container: str
    tag: str


class SetParameter(Struct, frozen=True, kw_only=True):
    """Set a parameter of a container; replaces an existing value."""

    user: str
    container: str
    name: str
    value: ParameterValue


class DeleteParameter(Struct, frozen=True, kw_only=True):
    """Delete a parameter of a container."""

    user: str
    container: str
    name: str


class AddInterface(Struct, frozen=True, kw_only=True):
    """Make an interface of a robot or a container."""

    user: str
    endpoint: str
    interface: InterfaceSpec


class RemoveInterface(Struct, frozen=True, kw_only=True):
    """Remove an interface with its connections."""

    user: str
    endpoint: str
    tag: str


class Connect(Struct, frozen=True, kw_only=True):
    """Connect two interfaces, each written ``ENDPOINT/INTERFACE``."""

    user: str
    tag_a: str
    tag_b: str


class Disconnect(Struct, frozen=True, kw_only=True):
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
    | RobotsFound
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
