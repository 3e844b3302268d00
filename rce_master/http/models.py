"""What the REST API takes and gives."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rce_master.http.model import Body, Model, Page

ROLES = "^(viewer|user|operator|admin)$"
Amount = int | float | str
"""An amount as :mod:`rce.model.quantities` reads it."""


class Error(Model):
    """Why something was not done."""

    error: str


# In


class LoginIn(Body):
    """A login: the user, and the token to make."""

    userID: str  # noqa: N815 - its name everywhere in the protocol
    password: Annotated[str, Field(repr=False)]
    """The password itself, not its hash."""
    label: Annotated[str, Field(max_length=128)] = ""
    lifetime: Annotated[float, Field(ge=0)] = 0.0
    """Seconds until the token expires; 0, or more than the master allows: the longest time that it allows."""


class RobotTokenIn(Body):
    """A token to make, for one robot."""

    robot: Annotated[str, Field(max_length=256)]
    label: Annotated[str, Field(max_length=128)] = ""
    days: Annotated[float, Field(ge=0, le=36500)] = 0.0
    """Days until it expires; 0: it is valid until it is revoked."""
    replace: bool = False
    """Replace the token that the robot has."""


class ScopedTokenIn(Body):
    """A token to make, for a program that may do one thing only."""

    scope: Annotated[str, Field(pattern="^(metrics|fleet)$")]
    label: Annotated[str, Field(max_length=128)] = ""
    days: Annotated[float, Field(ge=0, le=36500)] = 0.0
    """Days until it expires; 0: it is valid until it is revoked."""


class UserIn(Body):
    """A user to create."""

    name: str
    password: Annotated[str, Field(repr=False, min_length=1)]
    role: Annotated[str, Field(pattern=ROLES)] = "user"


class RoleIn(Body):
    """The new role of a user."""

    role: Annotated[str, Field(pattern=ROLES)]


class MoveIn(Body):
    """Where a container is handed over to."""

    machine: Annotated[str, Field(min_length=1, max_length=300)]
    """Name of the machine, or of its container task set."""


class AuditIn(Body):
    """An action of a user at a station."""

    action: Annotated[str, Field(pattern="^[a-z_]{1,64}$")]
    subject: Annotated[str, Field(max_length=300)] = ""
    detail: Annotated[str, Field(max_length=300)] = ""
    address: Annotated[str, Field(max_length=64)] = ""
    """The address of the client, which is recorded as told."""
    outcome: Annotated[str, Field(pattern="^(done|refused)$")] = "done"


class PasswordIn(Body):
    """A new password."""

    password: Annotated[str, Field(repr=False, min_length=1)]
    old_password: Annotated[str, Field(repr=False)] = ""
    """The present password; required to change your own."""


class LimitsIn(Body):
    """New limits of a user. A limit left out stays; 0: no limit; ``default``: the limit of all users."""

    containers: Amount | None = None
    slots: Amount | None = None
    cpu: Amount | None = None
    """Cores."""
    memory: Amount | None = None
    """MB, or a text such as ``8G``."""
    packages: Amount | None = None
    """Number of versions."""
    disk: Amount | None = None
    """Size of packages and volumes: MB, or a text such as ``2G``."""


# Out


class TokenOut(Model):
    """A bearer token; it cannot be read again later."""

    token: str
    userID: str  # noqa: N815 - its name everywhere in the protocol
    role: str
    expires: float
    """Seconds since 1970; 0: never."""
    id: str = ""
    """Names it in lists, and to revoke it; not secret."""
    scope: str = ""
    """What it permits: everything that the user may do (empty), ``robot:ID`` or ``metrics``."""


class TokenListed(Model):
    """A token, without its secret text."""

    id: str
    user: str
    label: str
    scope: str
    """What it permits: everything that the user may do (empty), ``robot:ID`` or ``metrics``."""
    robot: str
    """The only robot that may use it; empty if any may."""
    created: float
    """Seconds since 1970."""
    expires: float
    """Seconds since 1970; 0: never."""
    used: float
    """When it was last used, in seconds since 1970; 0: never."""
    current: bool
    """Whether this request carries it."""


class AuditRecord(Model):
    """An action, or a refused one."""

    id: int
    time: float
    """Seconds since 1970."""
    user: str
    """The user; empty if unknown."""
    action: str
    subject: str
    outcome: str
    """``done`` or ``refused``."""
    detail: str
    address: str
    """The address from which the master got it."""
    via: str
    """The robot that passed the action on; ``station``: the user, or a station in their name, told it, and
    only the user was checked. Empty: the master did it itself."""
    client: str
    """The address of the station's client, as the station told it: not checked."""
    times: int
    """Number of times, for repeated refusals."""


class AuditOut(Model):
    """Records of the audit log."""

    records: list[AuditRecord]
    missing: list[str]
    """Why records of other masters may be missing, one text for each of those; empty if none are."""


class TokensOut(Page):
    """Tokens."""

    tokens: list[TokenListed]


class UserOut(Model):
    """A user."""

    name: str
    role: str
    created: float
    robots: int
    containers: int


class LimitOut(Model):
    """A limit of a user, and how much of it is used. Memory and disk are in bytes."""

    limit: float
    """0: no limit."""
    used: float
    source: str
    """``user``: of this user; ``role``: of all of this role; ``all``: of all users; ``machines``: a share of
    the machines' resources."""


class UserLimitsOut(UserOut):
    """A user with their limits."""

    limits: dict[str, LimitOut]
    """``containers``, ``slots``, ``cpu``, ``memory``, ``packages``, ``disk``."""


class RobotOut(Model):
    """A robot that is connected, or absent within its grace time."""

    id: str
    user: str
    tag: str
    state: str
    """``connected`` or ``absent``."""
    task_set: str
    revision: int
    interfaces: int


class StayingOut(Model):
    """A container that a draining machine still has."""

    container: str
    """``user/tag``."""
    why: str


class MachineOut(Model):
    """A task set and the machine it runs on."""

    process: str
    kind: str
    machine: str
    connected: bool
    endpoints: int
    cores: int
    memory: int
    """Bytes of the machine."""
    runtime: str
    labels: list[str]
    detail: str
    url: str
    cpu_s: float
    """CPU seconds of the task set since its start."""
    memory_used: int
    """Resident bytes of the task set."""
    slots: int
    """0 if slots are not counted."""
    limits: str
    networks: list[str]
    runtimes: list[str]
    promised_slots: int
    """Slots, cores and bytes that are reserved for its containers."""
    promised_cores: float
    promised_memory: int
    draining: bool
    staying: list[StayingOut]
    """While the machine is drained: the containers that it still has."""


class UsersOut(Page):
    """Users."""

    users: list[UserOut]


class RobotsOut(Page):
    """Robots."""

    robots: list[RobotOut]


class MachinesOut(Page):
    """Task sets and their machines."""

    machines: list[MachineOut]


class MasterOut(Model):
    """One of several masters."""

    name: str
    """``MACHINE:PORT``."""
    url: str
    """Where the others reach it."""
    role: str
    """``leader``, ``standby``, or ``away``: it does not answer."""
    drained: bool
    """Whether it leads only if no other one does."""


class MastersOut(Model):
    """Masters, the leading one first; none if the engine has one master with a store of its own."""

    masters: list[MasterOut]


class DrainOut(Model):
    """What is drained, or is not any more."""

    machines: list[MachineOut]
    masters: list[MasterOut]


class EventOut(Model):
    """An event."""

    id: int
    """Increases by one; by more across a restart."""
    time: float
    """Seconds since 1970."""
    kind: str
    """Such as ``robot_connected`` or ``node_failed``."""
    user: str
    """The owner; empty: for administrators only."""
    subject: str
    """The object of the event, such as ``user/container/node``."""
    text: str


class EventsOut(Page):
    """Events, oldest first."""

    events: list[EventOut]
    newest: int
    """Id of the newest event; where ``next`` is null, a later request continues there."""


class LogOut(Model):
    """A piece of a log."""

    text: str
    offset: int
    """Where the next read continues."""
    incarnation: str = Field(default="", alias="life")
    """The incarnation of the container that wrote this log; name it to read the same log again."""
    ended: float | None = None
    """When that incarnation ended, in seconds since 1970; null while it runs."""
    reason: str = ""
    """Why it ended."""
