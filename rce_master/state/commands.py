"""Everything that can be asked of the state or happen to it.

Commands are values: what they mean is in the module that handles them (``users``, ``task_sets``, ``robots``,
``containers``, ``wiring``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from rce.model.specs import Resources

if TYPE_CHECKING:
    from rce.control.messages import Hello
    from rce.control.model import EndpointStatus, StatusPatch
    from rce.model.specs import InterfaceSpec, NodeSpec, ParameterValue, ResourceChanges
    from rce_master.state.records import KnownLogin, PackageKey, Token, User, UserPackage, UserRole


_NOTHING_REQUESTED = Resources()

# Users


@dataclass(frozen=True, slots=True, kw_only=True)
class AddUser:
    """Make a user; refused if there is one of the name."""

    user: User


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPassword:
    """Change a user's password; ends their tokens."""

    name: str
    password: str
    """argon2 hash."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetRole:
    """Change what a user may do."""

    name: str
    role: UserRole


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveUser:
    """Remove a user with all robots, containers and tokens."""

    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AddToken:
    """Keep a bearer token; forgets expired ones of the same user, and a login too many."""

    token: Token
    password: str = ""
    """Stored hash of the password that was shown for it; refused if the user has another one by now."""
    replaces: bool = False
    """Of a robot's token: whether it takes the place of the one that is there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoteTokenUses:
    """Tokens were used."""

    used: dict[str, float]
    """By digest, in seconds since 1970."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RevokeToken:
    """Forget a bearer token of a user; ends what was opened by it."""

    user: str
    id: str
    """As :attr:`rce_master.state.records.Token.id`."""


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
    """Change what a user may have."""

    user: str
    limits: dict[str, float | None]
    """By fields of :class:`rce_master.state.records.UserLimits`: how much, 0: no limit, None: as for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RememberLogin:
    """Keep the mark of a password that was right."""

    login: KnownLogin


# Packages that users bring


@dataclass(frozen=True, slots=True, kw_only=True)
class AddPackageKey:
    """Trust a user's key."""

    key: PackageKey


@dataclass(frozen=True, slots=True, kw_only=True)
class RemovePackageKey:
    """Trust a user's key no more."""

    user: str
    id: str
    """As :func:`rce.packages.signing.key_id` names it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AddPackage:
    """Take a version of a package; whoever sends this has verified it."""

    package: UserPackage


@dataclass(frozen=True, slots=True, kw_only=True)
class RemovePackage:
    """Remove a version of a package; refused while a node needs it."""

    user: str
    name: str
    version: str


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
    """A task set asked for the whole spec of an endpoint, because a patch did not fit what it has."""

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
    """Endpoint id of the robot to tell; all of the user if empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotLogin:
    """A robot that proved who it is wants to connect at a task set."""

    process: str
    id: str
    credential: str = ""
    """Digest of the token that it came with; empty: its user's password. Refused if it was revoked."""
    password: str = ""
    """Stored hash of the password that it came with; refused if the user has another one by now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotLeft:
    """A robot's connection ended."""

    process: str
    id: str
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetDraining:
    """An operator wants a machine to be emptied, or not any more."""

    machine: str
    """Its name, or that of its container task set."""
    draining: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """Time passed: grace times end, waiting containers are placed."""


# What users ask for. ``user`` is who owns the endpoints; tags are the user's.


@dataclass(frozen=True, slots=True, kw_only=True)
class CreateContainer:
    """``CC``."""

    user: str
    tag: str
    resources: Resources = _NOTHING_REQUESTED
    wait: bool = False
    """Whether to wait for room if no machine has any now; else that is refused."""


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
    """Set a parameter of a container; a value that is there is replaced."""

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
    """Join two interfaces, each written ``ENDPOINT/INTERFACE``."""

    user: str
    tag_a: str
    tag_b: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Disconnect:
    """Part two interfaces, each written ``ENDPOINT/INTERFACE``."""

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
    | AddPackageKey
    | RemovePackageKey
    | AddPackage
    | RemovePackage
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
    | Tick
    | Request
)
