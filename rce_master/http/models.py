"""What the REST API takes and gives."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Scalar = bool | int | float | str
Value = Scalar | list[Scalar]


class _In(BaseModel):
    """Base of what is sent to the API; an unknown key is a mistake."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Error(BaseModel):
    """Why something was not done."""

    error: str


# In


class LoginIn(_In):
    """Who wants a token."""

    userID: str  # noqa: N815 - its name everywhere in the protocol
    password: Annotated[str, Field(repr=False)]
    """The password itself, not its hash."""
    label: Annotated[str, Field(max_length=128)] = ""


class UserIn(_In):
    """A user to make."""

    name: str
    password: Annotated[str, Field(repr=False, min_length=1)]
    role: Annotated[str, Field(pattern="^(user|admin)$")] = "user"


class PasswordIn(_In):
    """A new password."""

    password: Annotated[str, Field(repr=False, min_length=1)]


class ContainerIn(_In):
    """A container to make. Zero or empty means: no wish."""

    tag: str
    group: str = ""
    group_ip: str = ""
    size: int = 1
    cpu: Annotated[float, Field(strict=False)] = 0.0
    """Cores."""
    memory: int = 0
    """Bytes."""
    bandwidth: int = 0
    """Bytes per second."""
    special_features: list[str] = []
    """Labels that the machine must have."""


class NodeIn(_In):
    """A node to start."""

    tag: str
    pkg: str
    exe: str
    args: str = ""
    name: str = ""
    namespace: str = ""


class ParameterIn(_In):
    """A parameter to set."""

    name: str
    value: Value


class InterfaceIn(_In):
    """An interface to make."""

    tag: str
    type: str
    cls: str
    addr: str = ""


class ConnectionIn(_In):
    """Two interfaces to join, each ``ENDPOINT/INTERFACE``."""

    tag_a: str
    tag_b: str


# Out


class TokenOut(BaseModel):
    """A bearer token; it cannot be read again later."""

    token: str
    userID: str  # noqa: N815 - its name everywhere in the protocol
    role: str
    expires: float
    """Seconds since 1970."""


class UserOut(BaseModel):
    """A user."""

    name: str
    role: str
    created: float
    robots: int
    containers: int


class RobotOut(BaseModel):
    """A robot that is connected, or absent within its grace time."""

    id: str
    user: str
    tag: str
    state: str
    """``connected`` or ``absent``."""
    task_set: str
    revision: int
    interfaces: int


class ContainerOut(BaseModel):
    """A container."""

    id: str
    user: str
    tag: str
    state: str
    """``requested``, ``placed``, ``starting``, ``running``, ``failed``, ``stopping`` or ``lost``."""
    detail: str
    task_set: str
    machine: str
    revision: int
    incarnation: str
    nodes: int
    interfaces: int
    cpu_s: float
    """CPU seconds since its start."""
    memory: int
    """Resident bytes."""


class NodeOut(BaseModel):
    """A node."""

    user: str
    container: str
    tag: str
    pkg: str
    exe: str
    args: str
    name: str
    namespace: str
    state: str
    """``starting``, ``running``, ``stopping``, ``exited``, ``failed``; ``unknown`` until reported."""
    pid: int
    exit_code: int | None
    detail: str


class ParameterOut(BaseModel):
    """A parameter."""

    user: str
    container: str
    name: str
    value: Value


class InterfaceOut(BaseModel):
    """An interface."""

    user: str
    endpoint: str
    tag: str
    type: str
    cls: str
    addr: str
    active: bool
    """Whether it has an established connection."""
    messages_in: int
    messages_out: int
    bytes_in: int
    bytes_out: int
    dropped: int


class ConnectionOut(BaseModel):
    """A connection."""

    id: int
    user: str
    tag_a: str
    tag_b: str
    established: bool
    """Whether both ends report it as open."""


class MachineOut(BaseModel):
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


class UsersOut(BaseModel):
    """Users."""

    users: list[UserOut]


class RobotsOut(BaseModel):
    """Robots."""

    robots: list[RobotOut]


class ContainersOut(BaseModel):
    """Containers."""

    containers: list[ContainerOut]


class NodesOut(BaseModel):
    """Nodes."""

    nodes: list[NodeOut]


class ParametersOut(BaseModel):
    """Parameters."""

    parameters: list[ParameterOut]


class InterfacesOut(BaseModel):
    """Interfaces."""

    interfaces: list[InterfaceOut]


class ConnectionsOut(BaseModel):
    """Connections."""

    connections: list[ConnectionOut]


class MachinesOut(BaseModel):
    """Task sets and their machines."""

    machines: list[MachineOut]


class LogOut(BaseModel):
    """A piece of a log."""

    text: str
    offset: int
    """Where the next read goes on."""
    life: str = ""
    """The container's life of which this is the log; reads of the same log name it."""
    ended: float | None = None
    """When that life ended, in seconds since 1970; null if it goes on."""
    reason: str = ""
    """Why it ended."""
