"""What the REST API takes and gives."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rce_master.http.model import Body, Model

ROLES = "^(viewer|user|operator|admin)$"
Amount = int | float | str
"""An amount as :mod:`rce.model.quantities` reads it."""


class Error(Model):
    """Why something was not done."""

    error: str


# In


class LoginIn(Body):
    """Who wants a token."""

    userID: str  # noqa: N815 - its name everywhere in the protocol
    password: Annotated[str, Field(repr=False)]
    """The password itself, not its hash."""
    label: Annotated[str, Field(max_length=128)] = ""
    lifetime: Annotated[float, Field(ge=0)] = 0.0
    """Seconds for which the token is to be good, at most as long as the master gives; 0: so long."""


class RobotTokenIn(Body):
    """A robot that is to have a token of its own."""

    robot: Annotated[str, Field(max_length=256)]
    label: Annotated[str, Field(max_length=128)] = ""
    days: Annotated[float, Field(ge=0, le=36500)] = 0.0
    """For how long it is good; 0: until it is revoked."""
    replace: bool = False
    """Take the place of the token that the robot has."""


class ScopedTokenIn(Body):
    """A token for a program that may do one thing."""

    scope: Annotated[str, Field(pattern="^metrics$")]
    label: Annotated[str, Field(max_length=128)] = ""
    days: Annotated[float, Field(ge=0, le=36500)] = 0.0
    """For how long it is good; 0: until it is revoked."""


class UserIn(Body):
    """A user to make."""

    name: str
    password: Annotated[str, Field(repr=False, min_length=1)]
    role: Annotated[str, Field(pattern=ROLES)] = "user"


class RoleIn(Body):
    """What a user may do from now on."""

    role: Annotated[str, Field(pattern=ROLES)]


class AuditIn(Body):
    """An action of a user at a station."""

    action: Annotated[str, Field(pattern="^[a-z_]{1,64}$")]
    subject: Annotated[str, Field(max_length=300)] = ""
    detail: Annotated[str, Field(max_length=300)] = ""
    address: Annotated[str, Field(max_length=64)] = ""
    """Where it came from."""
    outcome: Annotated[str, Field(pattern="^(done|refused)$")] = "done"


class PasswordIn(Body):
    """A new password."""

    password: Annotated[str, Field(repr=False, min_length=1)]
    old_password: Annotated[str, Field(repr=False)] = ""
    """The password until now; needed to change one's own."""


class LimitsIn(Body):
    """What a user may have from now on; left out: as before. 0: no limit; ``default``: as all users."""

    containers: Amount | None = None
    slots: Amount | None = None
    cpu: Amount | None = None
    """Cores."""
    memory: Amount | None = None
    """MB, or a text such as ``8G``."""
    packages: Amount | None = None
    """Versions."""
    disk: Amount | None = None
    """Of the packages' files; MB, or a text such as ``2G``."""


# Out


class TokenOut(Model):
    """A bearer token; it cannot be read again later."""

    token: str
    userID: str  # noqa: N815 - its name everywhere in the protocol
    role: str
    expires: float
    """Seconds since 1970; 0: never."""
    id: str = ""
    """By which it is listed and revoked; no secret."""
    scope: str = ""
    """What it is good for: all that the user may do (empty), ``robot:ID`` or ``metrics``."""


class TokenListed(Model):
    """A token, without the text that it is used by."""

    id: str
    user: str
    label: str
    scope: str
    """What it is good for: all that the user may do (empty), ``robot:ID`` or ``metrics``."""
    robot: str
    """The only robot that it is good for; else empty."""
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
    via: str
    """What passed it on: a robot or a station; else empty."""
    times: int
    """How often, for refusals that repeat."""


class AuditOut(Model):
    """Records of the audit log."""

    records: list[AuditRecord]


class TokensOut(Model):
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
    """How much of something a user may have, and has. Memory and disk in bytes."""

    limit: float
    """0: no limit."""
    used: float
    source: str
    """``user``: set for this one; ``all``: for all users; ``machines``: a share of what the machines have."""


class UserLimitsOut(UserOut):
    """A user with what they may have."""

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
    """0 if it is not counted."""
    limits: str
    networks: list[str]
    runtimes: list[str]
    promised_slots: int
    """What its containers were promised: of slots, cores and bytes."""
    promised_cores: float
    promised_memory: int
    draining: bool
    staying: list[StayingOut]
    """Of a draining machine: the containers that it still has."""


class UsersOut(Model):
    """Users."""

    users: list[UserOut]


class RobotsOut(Model):
    """Robots."""

    robots: list[RobotOut]


class MachinesOut(Model):
    """Task sets and their machines."""

    machines: list[MachineOut]


class LogOut(Model):
    """A piece of a log."""

    text: str
    offset: int
    """Where the next read continues."""
    incarnation: str = Field(default="", alias="life")
    """The container's incarnation of which this is the log; reads of the same log name it."""
    ended: float | None = None
    """When that incarnation ended, in seconds since 1970; null if it continues."""
    reason: str = ""
    """Why it ended."""
