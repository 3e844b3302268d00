"""The engine's settings: one YAML file for ``rce up`` and for each program.

Every setting is declared once: its type, its default, its sentence and its option; here, in
:mod:`rce.config.master_settings` and :mod:`rce.config.task_set_settings`. ``configs/engine.yaml`` and the
reference pages are made from these sections (``make reference``). Times are in seconds, sizes in bytes.
"""

from __future__ import annotations

import contextlib
import ipaddress
from enum import Enum
from pathlib import Path
from typing import Annotated

from msgspec import Meta, field

from rce.config.fields import Hosts, Memory, Section, Setting, choice
from rce.config.folders import MASTER_FOLDER, default_state_dir, master_folder
from rce.config.master_settings import ANYWHERE, MasterSettings
from rce.config.store_address import SqliteAddress, read_store_address
from rce.config.task_set_settings import ContainerSettings, RobotSettings, Runtime
from rce.masters import split_addresses, split_port

__all__ = [
    "ANYWHERE",
    "LOOPBACK",
    "PROGRAM_SECTIONS",
    "ContainerSettings",
    "EngineSettings",
    "LogLevel",
    "MasterSettings",
    "RobotSettings",
    "Runtime",
    "TlsSettings",
]

LOOPBACK = "127.0.0.1"
PROGRAM_SECTIONS = ("core", "demo", "discovery", "relay", "sync", "ui")
"""Sections whose settings are the options of ``rce core`` and so on (:mod:`rce.cli.program_files`)."""


class LogLevel(Enum):
    """How much a program writes to its log."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


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
    """Settings that all programs share."""

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
        Hosts,
        Setting(
            "Where robot and container task sets find the master; several, used in turn, by commas or as a"
            " list; with their control ports, or with `control_port` of the section `master`. The key"
            " `masters` means the same.",
            option="",
            alias="masters",
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
        """The folder of the master's state; with etcd, of what remains on its machine."""
        address = read_store_address(self.master.store)
        if isinstance(address, SqliteAddress) and address.folder is not None:
            return master_folder(address.folder)
        if self.master.state_dir is not None:
            return master_folder(self.master.state_dir)
        return self.state_dir / MASTER_FOLDER

    @property
    def container_state(self) -> Path:
        """The folder of a container task set's state."""
        return self.container.state_dir or self.state_dir / "container"

    @property
    def certificates(self) -> Path:
        """The folder with the authority and its certificates."""
        return self.tls.certificates or self.state_dir / "certificates"

    @property
    def control_url(self) -> str:
        """The URL at which task sets dial the master, the first of several."""
        first = (*split_addresses(self.master_host), LOOPBACK)[0]
        host, port = split_port(first, self.master.control_port)
        scheme = "wss" if self.tls.enabled else "ws"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"

    @property
    def near_host(self) -> str:
        """Where programs on this machine reach the master: loopback, unless it listens elsewhere only."""
        host = self.master.bind or LOOPBACK
        with contextlib.suppress(ValueError):
            if ipaddress.ip_address(host).is_unspecified:
                return LOOPBACK
        return host

    @property
    def http_url(self) -> str:
        """The URL of the master for clients on this machine."""
        host = self.near_host
        scheme = "https" if self.tls.enabled or self.tls.cert else "http"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.master.http_port}/"
