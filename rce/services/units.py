"""Writes systemd units of the engine's programs. Pure: texts from settings.

A unit forbids everything that its program does not need. `rce-container` makes namespaces, mounts and cgroups
for its containers, so its unit forbids little; systemd delegates its cgroup's subtree to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

SYSTEM_STATE = Path("/var/lib/rce")


class Role(StrEnum):
    """The role of a service."""

    ENGINE = "engine"
    """All programs, by ``rce up``."""
    MASTER = "master"
    ROBOT = "robot"
    CONTAINER = "container"
    ETCD = "etcd"
    """A member of etcd, which keeps the state of several masters; configured by ``rce cluster``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """A service that is to be installed.

    Attributes:
        role: The programs that it runs.
        program: Path of the program.
        arguments: Its command line, without the program.
        system: A unit of the machine; else one of a user.
        user: The user that it runs as; empty for root, or the user whose unit it is.
        secret: File with the engine's secret; None: the program finds it itself.
        state: Folder that it may write; None for none.
        certificates: Files of TLS that it reads, all in one folder; empty without TLS.
        hide_homes: Hide home folders: it needs nothing in them.
    """

    role: Role
    program: Path
    arguments: tuple[str, ...] = ()
    system: bool = True
    user: str = ""
    secret: Path | None = None
    state: Path | None = None
    certificates: tuple[Path, ...] = ()
    hide_homes: bool = True

    @property
    def name(self) -> str:
        """Name of the unit's file."""
        return f"rce-{self.role}.service"


_TITLES = {
    Role.ENGINE: "RCE, a cloud robotics engine: all programs",
    Role.MASTER: "RCE master: clients, users, desired state",
    Role.ROBOT: "RCE robot endpoint: robots' connections",
    Role.CONTAINER: "RCE container task set: makes containers",
    Role.ETCD: "RCE etcd: keeps the state of the masters",
}

_NO_RIGHTS = """\
NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
PrivateTmp=yes
PrivateDevices=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
UMask=0077
"""

_OF_CONTAINERS = """\
# Containers are made with namespaces, mounts and cgroups of their own: nothing of that may be taken away.
Delegate=yes
TasksMax=infinity
OOMPolicy=continue
ProtectKernelModules=yes
"""


def unit(service: Service) -> str:
    """Return the text of a service's unit."""
    # The file itself, and not a credential of systemd: that is copied once, and the secret may change.
    secret = () if service.secret is None else ("--secret-file", str(service.secret))
    command = " ".join(map(quoted, (str(service.program), *service.arguments, *secret)))
    wanted_by = "multi-user.target" if service.system else "default.target"
    parts = [
        f"# Made by `rce install-service {service.role}`.\n",
        f"[Unit]\nDescription={_TITLES[service.role]}\n",
        "Wants=network-online.target\nAfter=network-online.target\n" if service.system else "",
        # At the end of the machine, the master hands over before its etcd stops.
        f"After=rce-{Role.ETCD}.service\n" if service.role is Role.MASTER else "",
        f"\n[Service]\nType=exec\nExecStart={command}\n",
        _reload(command) if service.role is Role.CONTAINER else "",
        "Environment=PYTHONUNBUFFERED=1\nRestart=always\nRestartSec=2\nTimeoutStopSec=60\nKillMode=mixed\n",
        f"SyslogIdentifier=rce-{service.role}\n",
        "LimitNOFILE=524288\n" if service.system else "",
        *_place(service),
        f"\n[Install]\nWantedBy={wanted_by}\n",
    ]
    return "".join(parts)


def _reload(command: str) -> str:
    """Return the lines for restarting the program in its own process, while its containers keep running."""
    return f"ExecReload={command} --check\nExecReload=/bin/kill -USR1 $MAINPID\n"


def quoted(text: str) -> str:
    """Write a word of a command line as systemd reads it back."""
    if any(ord(character) < ord(" ") for character in text):
        raise ValueError(f"{text!r} has a control character, which a unit cannot hold")
    escaped = text.replace("%", "%%").replace("$", "$$").replace("\\", "\\\\").replace('"', '\\"')
    plain = escaped == text and text and not set(text) & set(" ';#")
    return text if plain else f'"{escaped}"'


def _place(service: Service) -> list[str]:
    """Return the lines on the unit's user and on the folders that it may access."""
    lines = [f"User={service.user}\n"] if service.user else []
    holds_containers = service.role in (Role.CONTAINER, Role.ENGINE)
    if service.system:
        run = f"rce-{service.role}"
        lines.append(
            f"RuntimeDirectory={run}\nRuntimeDirectoryMode=0700\nEnvironment=XDG_RUNTIME_DIR=/run/{run}\n"
        )
        if service.state is not None and service.state.is_relative_to(SYSTEM_STATE):
            folder = service.state.relative_to(SYSTEM_STATE.parent)
            lines.append(f"StateDirectory={folder}\nStateDirectoryMode=0700\n")
        elif service.state is not None and not holds_containers:
            lines.append(f"ReadWritePaths={quoted(str(service.state))}\n")
    if holds_containers:
        lines.append(_OF_CONTAINERS if service.system else "Delegate=yes\n")
    elif service.system:
        lines.append(_NO_RIGHTS + ("ProtectHome=yes\n" if service.hide_homes else ""))
    return lines
