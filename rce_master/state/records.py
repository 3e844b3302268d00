"""The records of the state. All are immutable: a change replaces a record.

Persistent records go to the store; the others (what is observed now) are made again after a restart.
"""

from __future__ import annotations

from enum import Enum
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
    VolumeMovePhase,
)


class UserRole(Enum):
    """What a user may do."""

    VIEWER = "viewer"
    """Sees the objects of all users, and cannot change any."""
    USER = "user"
    """Their own robots and containers."""
    OPERATOR = "operator"
    """The same; also sees the objects of all users, and controls every fleet at its station."""
    ADMIN = "admin"
    """All objects of all users."""

    @property
    def sees_all(self) -> bool:
        """Whether the role sees the objects of all users."""
        return self is not UserRole.USER

    @property
    def changes(self) -> bool:
        """Whether the role may change anything."""
        return self is not UserRole.VIEWER


class User(Struct, frozen=True, kw_only=True):
    """A user who may log in."""

    name: str
    role: UserRole
    password: str
    """argon2 over the SHA-256 hex of the password."""
    created: float
    """Seconds since 1970."""


TOKEN_ID_LENGTH = 12
ROBOT_SCOPE = "robot:"
METRICS_SCOPE = "metrics"
FLEET_SCOPE = "fleet"
"""Of a program that uses operator stations, with its user's role there."""


class Token(Struct, frozen=True, kw_only=True):
    """A bearer token; only its digest is kept."""

    digest: str
    """SHA-256 hex of the token."""
    user: str
    label: str
    created: float
    expires: float
    """Seconds since 1970; 0: never."""
    used: float = 0.0
    """When it was last used, to the minute; 0: never."""
    scope: str = ""
    """Its scope: all permissions of its user (empty), or one of ``robot:ID``, ``metrics`` and ``fleet``."""

    @property
    def id(self) -> str:
        """What people call it by; it is not secret."""
        return self.digest[:TOKEN_ID_LENGTH]

    @property
    def robot(self) -> str:
        """The only robot ID that it is good for; empty: it is for other things."""
        return self.scope.removeprefix(ROBOT_SCOPE) if self.scope.startswith(ROBOT_SCOPE) else ""

    def is_expired(self, now: float) -> bool:
        """Return whether it has expired."""
        return bool(self.expires) and self.expires <= now


class UserLimits(Struct, frozen=True, kw_only=True):
    """What one user may have, where that is not as for all. None: as for all; 0: no limit."""

    user: str
    containers: float | None = None
    slots: float | None = None
    cpu: float | None = None
    """Cores."""
    memory: float | None = None
    """Bytes."""
    packages: float | None = None
    disk: float | None = None
    """Bytes of the packages' files and of the volumes."""


class KnownLogin(Struct, frozen=True, kw_only=True):
    """A password that was right once, so that it need not be hashed again."""

    user: str
    mark: str
    """Keyed hash, in hex, over user, stored password and what the client sent."""


class PackageKey(Struct, frozen=True, kw_only=True):
    """A public key by which a user signs packages."""

    user: str
    key: str
    """In hex."""
    label: str = ""
    created: float
    """Seconds since 1970."""

    @property
    def id(self) -> str:
        """Its key in the table."""
        return package_key_key(self.user, self.key)


def package_key_key(user: str, key: str) -> str:
    """Tell the key, in the table, of a user's public key."""
    return f"{user}/{key}"


class UserPackage(Struct, frozen=True, kw_only=True):
    """A version of a package that a user brought. It never changes."""

    user: str
    name: str
    version: str
    sha256: str
    """Of the archive, in hex."""
    digest: str
    """SHA-256, in hex, of what the archive unpacks to."""
    signature: str
    key: str
    """The public key that made the signature, in hex."""
    packed: int
    """Bytes of the archive."""
    size: int
    """Bytes of all files."""
    files: int
    created: float
    """Seconds since 1970."""
    description: str = ""
    executables: tuple[str, ...] = ()
    """What nodes can name."""
    requirements: bool = False
    """Whether it has a ``requirements.txt``."""

    @property
    def id(self) -> str:
        """``user/name@version``."""
        return user_package_key(self.user, self.name, self.version)


def user_package_key(user: str, name: str, version: str) -> str:
    """Tell the key of a package."""
    return f"{user}/{name}@{version}"


class UserVolume(Struct, frozen=True, kw_only=True):
    """A folder of a user's on a container machine, which outlives the containers that write to it."""

    user: str
    name: str
    size: int
    """Bytes that it may hold."""
    process: str = ""
    """Of the container task set on whose machine it is; empty until its first container is placed."""
    placement: int = 0
    """Grows each time that it gets another machine: of the folders on several machines, the one of the newest
    placement counts."""
    is_restored: bool = False
    """Whether this placement began with the files of a snapshot."""
    former: tuple[str, ...] = ()
    """Task sets with folders of earlier placements, which are kept until its container is up at this one."""
    is_returned: bool = False
    """Whether this placement is at a machine of an earlier one, because its container failed at the last."""
    snapshots: int = 0
    """Seconds between two snapshots, as its newest container asked for; 0: none."""
    snapshot: str = ""
    """SHA-256 of the manifest of the newest snapshot, which the masters hold; empty: there is none."""
    kept: int = 0
    """Bytes of that snapshot."""
    taken: float = 0.0
    """When it was taken; seconds since 1970."""
    fault: str = ""
    """Why there was no snapshot when one was due; empty: there was."""

    @property
    def id(self) -> str:
        """``user/name``."""
        return user_volume_key(self.user, self.name)


def user_volume_key(user: str, name: str) -> str:
    """Tell the key of a volume."""
    return f"{user}/{name}"


class VolumeMove(Struct, frozen=True, kw_only=True):
    """A container that moves with its volumes to another machine; it runs nowhere meanwhile."""

    id: str
    """Of the container. Its task set is still the former one; empty if that was lost."""
    to: str
    """Process name of the task set that gets it; empty while it rests."""
    phase: VolumeMovePhase
    done: tuple[str, ...] = ()
    """Names of the volumes that this phase is done with."""
    since: float = 0.0
    """When this phase began; seconds of the clock that commands are applied with, set anew by each master."""


class VolumeRemoval(Struct, frozen=True, kw_only=True):
    """A volume whose files a task set still has to remove; kept until it says that they are gone."""

    process: str
    volume: str
    """``user/name``."""

    @property
    def id(self) -> str:
        """Its key."""
        return volume_removal_key(self.process, self.volume)


def volume_removal_key(process: str, volume: str) -> str:
    """Tell the key of the removal of a volume."""
    return f"{process} {volume}"


class SavedState(Struct, frozen=True, kw_only=True):
    """The newest snapshot of a node's state; the contents are kept under their hash."""

    container: str
    """``user/tag``."""
    node: str
    """Its tag."""
    process: str
    """Of the task set where it was taken."""
    incarnation: str
    """Of the container of which it was taken."""
    number: int
    """Grows from snapshot to snapshot of an incarnation."""
    size: int
    """Bytes."""
    sha256: str
    """In hex."""
    taken: float
    """When it came; seconds since 1970."""

    @property
    def id(self) -> str:
        """``user/container/node``."""
        return saved_state_key(self.container, self.node)

    @property
    def user(self) -> str:
        """The user it belongs to."""
        return self.container.partition("/")[0]


def saved_state_key(container: str, node: str) -> str:
    """Tell the key of the saved state of a node."""
    return f"{container}/{node}"


class _Endpoint(Struct, frozen=True, kw_only=True):
    """The base of robots and containers."""

    id: str
    """``user/tag``."""
    revision: int = 0
    task_set: str = ""
    """Process name of the task set that is responsible; empty: none."""
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


class KeptAnswer(Struct, frozen=True, kw_only=True):
    """The answer to a request with an ``Idempotency-Key``; a repeat of the request gets it again."""

    user: str
    """Who made the request."""
    digest: str
    """SHA-256, in hex, of the key."""
    created: float
    """Seconds since 1970."""
    status: int
    mark: str
    """Tells by which secret of the engine the other fields were made."""
    request: str
    """Keyed hash, in hex, of the request."""
    body: bytes = b""
    """Encrypted; empty: the answer has none."""

    @property
    def id(self) -> str:
        """Its key in the table."""
        return kept_answer_key(self.user, self.digest)


def kept_answer_key(user: str, digest: str) -> str:
    """Tell the key, in the table, of the answer to a user's request."""
    return f"{user}/{digest}"


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
