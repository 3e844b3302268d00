"""The engine's settings: one YAML file for ``rce up`` and for each program.

Every setting stands here once: its type, its default, its sentence and its option. ``configs/engine.yaml``
and the reference pages are made from these sections (``make reference``). Times are in seconds, sizes in
bytes.
"""

from __future__ import annotations

import contextlib
import ipaddress
from enum import Enum
from pathlib import Path
from typing import Annotated

from msgspec import Meta, field

from rce.config.fields import Cores, Finite, Host, Memory, Networks, Port, Seconds, Section, Setting, choice
from rce.config.folders import default_state_dir

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


class LogLevel(Enum):
    """What a program tells in its log."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class MasterSettings(Section, frozen=True, kw_only=True):
    """The Master Task Set, `rce-master`."""

    bind: Annotated[Host, Setting("Address to listen on.")] = ANYWHERE
    http_port: Annotated[Port, Setting("Port of clients, REST API and metrics.", up="http-port")] = 9000
    control_port: Annotated[Port, Setting("Port of task sets.", up="control-port")] = 8080
    state_dir: Annotated[
        Path | None,
        Setting("Folder of users and desired state.", unset="folder `master` in the engine's state folder"),
    ] = None
    origins: Annotated[
        tuple[str, ...],
        Setting("Origins whose web pages may use the server.", option="allow-origin"),
    ] = ()
    public_names: Annotated[
        tuple[str, ...],
        Setting(
            "Names by which the server may be asked for, beside its addresses, host name and `localhost`.",
            option="public-name",
        ),
    ] = ()
    robot_grace: Annotated[
        Seconds, Setting("How long a robot that is away keeps its interfaces and connections.")
    ] = 60.0
    container_grace: Annotated[
        Seconds,
        Setting("How long a container task set may be away until its containers are placed elsewhere."),
    ] = 30.0
    token_lifetime: Annotated[Seconds, Setting("How long an API token is valid.")] = 30 * 86400.0
    trusted_proxies: Annotated[
        Networks,
        Setting(
            "Addresses or networks of proxies whose `X-Forwarded-For` is believed.", option="trusted-proxy"
        ),
    ] = ()
    requests_per_second: Annotated[
        float,
        Meta(ge=0),
        Setting(
            "Requests of one user each second over REST, and as many over WebSockets; 0: no limit. No limit "
            "of one user applies to administrators, but those of packages."
        ),
    ] = 100.0
    request_burst: Annotated[
        int, Meta(ge=1), Setting("Requests of one user that may come at once, after a rest.")
    ] = 2000
    max_streams: Annotated[
        int, Meta(ge=0), Setting("Streams of events and usage of one user at a time; 0: no limit.")
    ] = 64
    max_log_reads: Annotated[int, Meta(ge=1), Setting("Reads of logs of one user at a time.")] = 4
    user_share: Annotated[
        float,
        Meta(ge=0, le=1),
        Setting(
            "Share of the slots, cores and memory of all machines that the containers of one user may take "
            "together; 0: no limit."
        ),
    ] = 0.75
    max_containers: Annotated[int, Meta(ge=0), Setting("Containers of one user; 0: no limit.")] = 200
    max_packages: Annotated[
        int, Meta(ge=0), Setting("Versions of packages that one user may keep; 0: no limit.")
    ] = 200
    max_disk: Annotated[Memory, Setting("What the files of one user's packages may take; 0: no limit.")] = (
        4 << 30
    )
    max_slots: Annotated[
        int,
        Meta(ge=0),
        Setting("Slots that the containers of one user may take together; 0: no limit."),
    ] = 0
    max_cpu: Annotated[
        Cores, Setting("Cores that the containers of one user may ask for together; 0: no limit.")
    ] = 0.0
    max_memory: Annotated[
        Memory, Setting("Memory that the containers of one user may ask for together; 0: no limit.")
    ] = 0


class RobotSettings(Section, frozen=True, kw_only=True):
    """The Robot Task Set, `rce-robot`."""

    count: Annotated[
        int,
        Meta(ge=1, le=64),
        Setting(
            "Robot processes of `rce up`; each further one takes the next ports.", option="", up="robots"
        ),
    ] = 1
    bind: Annotated[Host, Setting("Address to listen on.")] = ANYWHERE
    ws_port: Annotated[Port, Setting("Port of robots' WebSockets.", up="ws-port")] = 9010
    link_port: Annotated[
        Port | None,
        Setting(
            "Port of links from other machines.",
            up="robot-link-port",
            unset="10030, or a free one where that is taken",
        ),
    ] = None
    public_host: Annotated[
        Host,
        Setting(
            "Name or address by which clients and other machines reach this one.",
            up="public-host",
            unset="its address towards the master",
            example="cloud.example.org",
        ),
    ] = ""
    public_url: Annotated[
        str,
        Meta(pattern=r"^(wss?://.+)?$"),
        Setting(
            "URL that clients are sent to, where a proxy stands in front.",
            up="public-url",
            unset="made of `public_host` and `ws_port`",
            example="wss://cloud.example.org/",
        ),
    ] = ""
    origins: Annotated[
        tuple[str, ...], Setting("Origins whose web pages may connect; `*` is any.", option="origin")
    ] = ()
    trusted_proxies: Annotated[
        Networks,
        Setting(
            "Addresses or networks of proxies whose `X-Forwarded-For` is believed.", option="trusted-proxy"
        ),
    ] = ()
    user_memory: Annotated[
        Memory,
        Meta(ge=1 << 20),
        Setting("Messages that may wait for all robots of a user; beyond it the oldest are dropped."),
    ] = 512 << 20
    memory: Annotated[Memory, Setting("The same for all users; 0: half of the machine's memory.")] = 0
    strangers: Annotated[
        int, Meta(ge=1), Setting("Connections from one address that have not logged in yet.")
    ] = 256


class ContainerSettings(Section, frozen=True, kw_only=True):
    """The Container Task Set, `rce-container`."""

    bind: Annotated[Host, Setting("Address to accept links on.", unset="all")] = ""
    link_port: Annotated[
        Port | None,
        Setting(
            "Port of links from other machines.",
            up="container-link-port",
            unset="10030, or a free one where that is taken; 10031 with `rce up`",
        ),
    ] = None
    name: Annotated[str, Setting("Name of this task set.", unset="made up once, then kept")] = ""
    state_dir: Annotated[
        Path | None,
        Setting(
            "Folder of containers' logs and homes, and of packages.",
            unset="folder `container` in the engine's state folder",
        ),
    ] = None
    runtime: Annotated[
        Runtime,
        choice(Runtime),
        Setting("How containers are isolated; `process` does not isolate them.", up="runtime"),
    ] = Runtime.AUTO
    package_path: Annotated[
        tuple[Path, ...],
        Setting(
            "Folders with ROS packages, the first match wins; the shipped examples come last.",
            up="package-path",
        ),
    ] = ()
    grace: Annotated[
        Finite,
        Meta(ge=0.1),
        Setting("How long containers wait for a manager that was killed until they end themselves."),
    ] = 30.0
    labels: Annotated[
        tuple[str, ...],
        Setting("What this machine has; containers ask for it as `specialFeatures`.", option="label"),
    ] = ()
    images: Annotated[
        tuple[str, ...],
        Setting(
            "Root file systems that containers may have, beside podman's images; the first one, image or"
            " folder, is that of all containers of `runtime: podman`.",
            option="image",
        ),
    ] = ()
    slots: Annotated[
        int,
        Meta(ge=0),
        Setting("Slots that this machine offers in all; 0: one for each 64 MB of its memory."),
    ] = 0
    slot_memory: Annotated[
        Memory, Meta(ge=32 << 20), Setting("Memory of a container for each of its slots.")
    ] = 512 << 20
    slot_processes: Annotated[
        int, Meta(ge=16), Setting("Processes and threads of a container for each of its slots.")
    ] = 256
    home_size: Annotated[
        Memory, Meta(ge=1 << 20), Setting("Size of a container's home, which is in memory.")
    ] = 256 << 20
    first_uid: Annotated[
        int,
        Meta(ge=1),
        Setting("As root: the first of the user IDs that containers run as; nobody else may have them."),
    ] = 700_000
    uids: Annotated[int, Meta(ge=1), Setting("How many such user IDs there are.")] = 10_000
    log_days: Annotated[
        Finite, Meta(ge=0), Setting("Days for which the logs of containers that ended are kept.")
    ] = 3.0
    log_space: Annotated[Memory, Setting("What those logs may take on the disk; the oldest go first.")] = (
        1 << 30
    )
    bundle_space: Annotated[Memory, Setting("What users' packages may take on the disk.")] = 4 << 30
    allow_requirements: Annotated[
        bool, Setting("Install what users' packages ask for in a `requirements.txt`.")
    ] = False
    pip_args: Annotated[
        str, Setting("More arguments for pip, such as `--index-url URL`; split as a shell does.")
    ] = ""


class TlsSettings(Section, frozen=True, kw_only=True):
    """TLS, for every program."""

    enabled: Annotated[
        bool,
        Setting(
            "Use TLS for every connection, with certificates of the engine's own authority.",
            option="tls",
            up="tls",
        ),
    ] = False
    certificates: Annotated[
        Path | None,
        Setting(
            "Folder with `authority.pem`, `NAME.pem` and `NAME.key`.",
            up="certificates",
            unset="folder `certificates` in the engine's state folder",
        ),
    ] = None
    name: Annotated[
        str,
        Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,62}$"),
        Setting("The certificate of that folder that this machine's programs use.", option="certificate"),
    ] = "engine"
    cert: Annotated[
        Path | None,
        Setting(
            "Show clients and robots this certificate in its place, such as one of a public authority.",
            option="tls-cert",
            up="tls-cert",
            unset="the one of `name`",
        ),
    ] = None
    key: Annotated[
        Path | None,
        Setting("The key of that certificate.", option="tls-key", up="tls-key", unset="in the same file"),
    ] = None


class EngineSettings(Section, frozen=True, kw_only=True):
    """What all programs share."""

    dev: Annotated[
        bool,
        Setting("Development mode: loopback only, user testUser with password testUser.", up="dev"),
    ] = False
    state_dir: Annotated[
        Path,
        Setting(
            "Folder in which everything is kept.",
            option="",
            up="state-dir",
            unset="the user's state folder, such as ~/.local/state/rce",
            example="/var/lib/rce",
        ),
    ] = field(default_factory=default_state_dir)
    secret_file: Annotated[
        Path | None,
        Setting(
            "File with the secret that the engine's programs share (`rce secret new`).",
            up="secret-file",
            unset="`RCE_SECRET`, or the file that `RCE_SECRET_FILE` names, or ~/.config/rce/secret",
            example="/etc/rce/secret",
        ),
    ] = None
    master_host: Annotated[
        Host,
        Setting(
            "Where robot and container task sets find the master.",
            option="",
            unset="the argument MASTER_IP; 127.0.0.1 with `rce up`",
            example="10.0.0.1",
        ),
    ] = ""
    machine: Annotated[str, Setting("Name of this machine.", unset="its host name")] = ""
    log_level: Annotated[
        LogLevel, choice(LogLevel), Setting("What the programs tell in their logs.", up="log-level")
    ] = LogLevel.INFO
    log_dir: Annotated[
        Path | None,
        Setting(
            "Folder for the programs' logs, `PROGRAM.log`, which are rotated.",
            up="log-dir",
            unset="standard error",
            example="/var/log/rce",
        ),
    ] = None
    log_size: Annotated[
        Memory, Meta(ge=1 << 10), Setting("Size at which a log in `log_dir` is put aside as `.1`.")
    ] = 10 << 20
    log_count: Annotated[
        int, Meta(ge=1, le=1000), Setting("How many logs that were put aside are kept of each program.")
    ] = 5
    master: MasterSettings = MasterSettings()
    robot: RobotSettings = RobotSettings()
    container: ContainerSettings = ContainerSettings()
    tls: TlsSettings = TlsSettings()

    @property
    def master_state(self) -> Path:
        """Where the master keeps its state."""
        return self.master.state_dir or self.state_dir / "master"

    @property
    def container_state(self) -> Path:
        """Where a container task set keeps its state."""
        return self.container.state_dir or self.state_dir / "container"

    @property
    def certificates(self) -> Path:
        """The folder with the authority and what it issued."""
        return self.tls.certificates or self.state_dir / "certificates"

    @property
    def control_url(self) -> str:
        """Where task sets dial the master."""
        host = self.master_host or LOOPBACK
        scheme = "wss" if self.tls.enabled else "ws"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.master.control_port}"

    @property
    def http_url(self) -> str:
        """Where clients on this machine find the master."""
        host = self.master.bind or LOOPBACK
        with contextlib.suppress(ValueError):
            if ipaddress.ip_address(host).is_unspecified:
                host = LOOPBACK
        scheme = "https" if self.tls.enabled or self.tls.cert else "http"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.master.http_port}/"
