"""The engine's settings: one YAML file for ``rce up`` and for each program.

The shipped ``configs/engine.yaml`` holds every setting with its default and a comment. Times are in seconds,
sizes in bytes. An empty file, or none, means all defaults.
"""

from __future__ import annotations

import ipaddress
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError

from rce.config.documents import parse, read_file
from rce.config.exceptions import ConfigError, Fault
from rce.config.folders import default_state_dir
from rce.config.validation import Strict, faults_of
from rce.protocol.quantities import read_cores, read_memory

LOOPBACK = "127.0.0.1"
ANYWHERE = "0.0.0.0"  # noqa: S104 - an engine serves other machines unless in development mode


class Runtime(Enum):
    """How containers are kept apart."""

    AUTO = "auto"
    """The strongest that this machine can do."""
    NAMESPACE = "namespace"
    PODMAN = "podman"
    """All containers are of images."""
    PROCESS = "process"


def _check_host(text: str) -> str:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        if not text or not text.replace("-", "").replace(".", "").replace("_", "").isalnum():
            raise ValueError("must be a host name or an IP address") from None
    return text


def _as_path(value: Any) -> Any:
    if isinstance(value, str) and value:
        return Path(value).expanduser()
    if value is None or isinstance(value, Path):
        return value
    raise ValueError("must be the path of a file or folder")


def _as_runtime(value: Any) -> Any:
    try:
        return Runtime(value)
    except ValueError:
        raise ValueError(f"must be one of {', '.join(item.value for item in Runtime)}") from None


def _as_cores(value: Any) -> Any:
    return read_cores(value)


def _as_bytes(value: Any) -> Any:
    return read_memory(value)


def _check_network(text: str) -> str:
    try:
        ipaddress.ip_network(text, strict=False)
    except ValueError:
        raise ValueError("must be an IP address or a network such as 10.0.0.0/8") from None
    return text


Address = Annotated[str, AfterValidator(_check_network)]
"""An IP address or network."""
Host = Annotated[str, AfterValidator(_check_host)]
Port = Annotated[int, Field(ge=0, le=65535)]
"""A TCP port; 0 takes a free one."""
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Folder = Annotated[Path, BeforeValidator(_as_path)]


class MasterSettings(Strict):
    """The Master Task Set."""

    bind: Host = ANYWHERE
    http_port: Port = 9000
    """Clients, REST API."""
    control_port: Port = 8080
    """Task sets."""
    robot_grace: Seconds = 60.0
    """How long a robot that is away keeps its interfaces and connections."""
    container_grace: Seconds = 30.0
    """How long a container task set may be away until its containers are placed elsewhere."""
    token_lifetime: Seconds = 30 * 86400.0
    """How long an API token is valid."""
    trusted_proxies: tuple[Address, ...] = Field(default=(), strict=False)
    """Addresses or networks of proxies whose ``X-Forwarded-For`` is believed."""
    max_slots: int = Field(default=0, ge=0)
    """Slots that the containers of one user may take together; 0 for no limit. Administrators have none."""
    max_cpu: Annotated[float, BeforeValidator(_as_cores)] = 0.0
    """Cores that the containers of one user may ask for together."""
    max_memory: Annotated[int, BeforeValidator(_as_bytes)] = 0
    """Bytes that the containers of one user may ask for together; written in MB or as a text (``8G``)."""


class RobotSettings(Strict):
    """The Robot Task Set."""

    count: int = Field(default=1, ge=1, le=64)
    """How many processes ``rce up`` starts; each further one takes the next ports."""
    bind: Host = ANYWHERE
    ws_port: Port = 9010
    """Robots' WebSockets."""
    link_port: Port = 10030
    """Links from other machines."""
    public_host: Host | None = None
    """The name by which clients reach this machine; its address towards the master if none."""
    public_url: str = Field(default="", pattern=r"^(wss?://.+)?$")
    """The whole URL that clients are sent to, where a proxy stands in front."""
    origins: tuple[str, ...] = Field(default=(), strict=False)
    """Origins whose web pages may connect; ``*`` is any."""
    trusted_proxies: tuple[Address, ...] = Field(default=(), strict=False)
    """Addresses or networks of proxies whose ``X-Forwarded-For`` is believed."""
    user_memory: Annotated[int, BeforeValidator(_as_bytes), Field(ge=1 << 20)] = 512 << 20
    """Bytes of messages that may wait for all robots of a user; written as other memory."""
    memory: Annotated[int, BeforeValidator(_as_bytes)] = 0
    """The same for all users; 0 is half of the machine's memory."""
    strangers: int = Field(default=256, ge=1)
    """Connections from one address that have not logged in yet."""


class ContainerSettings(Strict):
    """The Container Task Set."""

    bind: Host = ANYWHERE
    link_port: Port = 10031
    """Links from other machines."""
    runtime: Annotated[Runtime, BeforeValidator(_as_runtime)] = Runtime.AUTO
    package_path: tuple[Folder, ...] = Field(default=(), strict=False)
    """Folders with ROS packages, first match wins; the shipped examples come last."""
    grace: Seconds = 30.0
    """How long containers wait for a manager that was killed until they end themselves."""
    labels: tuple[str, ...] = Field(default=(), strict=False)
    """What this machine has; containers ask for it as special features."""
    images: tuple[str, ...] = Field(default=(), strict=False)
    """Folders with root file systems that containers may have; the first is that of ``runtime: podman``."""
    slots: int = Field(default=0, ge=0)
    """What this machine offers in all; 0: one for each 64 MB of its memory."""
    slot_memory: Annotated[int, BeforeValidator(_as_bytes), Field(ge=32 << 20)] = 512 << 20
    """Bytes of a container for each of its slots; written as other memory."""
    slot_processes: int = Field(default=256, ge=16)
    """Processes and threads of a container for each of its slots."""
    home_size: Annotated[int, BeforeValidator(_as_bytes), Field(ge=1 << 20)] = 256 << 20
    """Bytes of a container's home, which is in memory."""
    first_uid: int = Field(default=700_000, ge=1)
    """As root: the first of the users that containers run as; they must belong to nobody else."""
    uids: int = Field(default=10_000, ge=1)
    """How many such users there are."""
    log_days: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    """How long the logs of containers that ended are kept."""
    log_space: Annotated[int, BeforeValidator(_as_bytes)] = 1 << 30
    """Bytes that they may take in all."""
    bundle_space: Annotated[int, BeforeValidator(_as_bytes)] = 4 << 30
    """Bytes that packages of users may take on the machine."""
    allow_requirements: bool = False
    """Whether what users' packages ask for in a ``requirements.txt`` is installed."""
    pip_args: str = ""
    """More arguments for pip, such as another index."""


class EngineSettings(Strict):
    """Everything."""

    dev: bool = False
    """Development mode: loopback only, user testUser with password testUser, a shared secret of its own."""
    state_dir: Folder = Field(default_factory=default_state_dir)
    secret_file: Folder | None = None
    master_host: Host = LOOPBACK
    """Where robot and container task sets find the master."""
    master: MasterSettings = MasterSettings()
    robot: RobotSettings = RobotSettings()
    container: ContainerSettings = ContainerSettings()

    def for_development(self) -> EngineSettings:
        """Return the same in development mode: every program binds loopback only."""
        return self.model_copy(
            update={
                "dev": True,
                "master_host": LOOPBACK,
                "master": self.master.model_copy(update={"bind": LOOPBACK}),
                "robot": self.robot.model_copy(update={"bind": LOOPBACK, "public_host": LOOPBACK}),
                "container": self.container.model_copy(update={"bind": LOOPBACK}),
            }
        )

    @property
    def control_url(self) -> str:
        """Where task sets dial the master."""
        host = f"[{self.master_host}]" if ":" in self.master_host else self.master_host
        return f"ws://{host}:{self.master.control_port}"


def load_settings(path: Path | None = None) -> EngineSettings:
    """Read the engine's settings.

    Args:
        path: A YAML (or JSON) file; all defaults if None.

    Raises:
        ConfigError: It cannot be read, or something is wrong in it; every fault is listed.
    """
    if path is None:
        return EngineSettings()
    data = parse(read_file(path), str(path))
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise ConfigError(
            str(path), [Fault("", "must be a mapping with the keys master, robot, container, ...")]
        )
    # A section whose settings are all commented out reads as null.
    sections = {key: {} if value is None else value for key, value in data.items()}
    try:
        settings = EngineSettings.model_validate(sections)
    except ValidationError as error:
        raise ConfigError(str(path), faults_of(error, EngineSettings)) from error
    return settings.for_development() if settings.dev else settings
