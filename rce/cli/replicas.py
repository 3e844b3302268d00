"""Several masters on one machine, with the etcd that keeps their state: ``rce up --replicas``."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rce.config import LOOPBACK, EngineSettings
from rce.services.etcd import EtcdProgramError, find_etcd
from rce.supervision.plan import Program
from rce.tls.choice import WARNED_VARIABLE

COUNTS = (3, 5)
FIRST_PORT = 12379
"""Of the members of etcd, where it and the next ones are free; not etcd's own, which another etcd may use."""
_STAND_BY = " stand-by: "
_OPTIONS = (
    *("--max-txn-ops", "4096", "--max-request-bytes", "16777216", "--quota-backend-bytes", "8589934592"),
    *("--auto-compaction-mode", "periodic", "--auto-compaction-retention", "5m"),
    *("--pre-vote", "--logger", "zap", "--log-level", "error"),
)
_BECOME = 'echo "etcd ready: $0"; exec "$@"'


class ReplicasError(Exception):
    """The masters cannot be run; the text says why."""


@dataclass(frozen=True, slots=True)
class Member:
    """A member of etcd."""

    name: str
    client_port: int
    peer_port: int


class Replicas:
    """Masters that share an etcd, all on this machine.

    Args:
        settings: The engine's settings, with the number of masters, which is also that of members of etcd.
            Each master takes the ports of the former one plus one.

    Raises:
        ReplicasError: They cannot be run like that.
    """

    def __init__(self, settings: EngineSettings) -> None:
        count = settings.master.replicas
        if count not in COUNTS:
            why = " Two masters survive no failure: one of them is not more than half." if count == 2 else ""  # noqa: PLR2004
            raise ReplicasError(f"--replicas must be {' or '.join(map(str, COUNTS))}, found {count}.{why}")
        if settings.master.store:
            raise ReplicasError("--replicas keeps the state in an etcd of its own; leave store out")
        if not (settings.master.http_port and settings.master.control_port):
            raise ReplicasError("--replicas needs known ports: --http-port and --control-port, not 0")
        try:
            self._program = find_etcd()
        except EtcdProgramError as error:
            raise ReplicasError(f"--replicas runs etcd: {error}") from None
        self._settings = settings
        self._folder = settings.state_dir.absolute() / "etcd"
        self._members = _members(self._folder, count)

    @property
    def master_host(self) -> str:
        """Where task sets find the masters."""
        host, port = self._settings.near_host, self._settings.master.control_port
        host = f"[{host}]" if ":" in host else host
        return ",".join(f"{host}:{port + index}" for index in range(len(self._members)))

    @property
    def http_urls(self) -> str:
        """Where clients on this machine find the masters."""
        url, port = self._settings.http_url, self._settings.master.http_port
        start = url.removesuffix(f"{port}/")
        return ",".join(f"{start}{port + index}/" for index in range(len(self._members)))

    @property
    def warning(self) -> str | None:
        """What users of a shared machine must know."""
        if self._settings.tls.enabled:
            return None
        return "every user of this machine can read and change the state in etcd: use --tls, or try it alone"

    def programs(self, document: dict[str, Any]) -> Iterator[Program]:
        """Return the members of etcd and the masters, in start order.

        Args:
            document: The engine's settings.
        """
        for member in self._members:
            argv = [self._program, "--name", member.name, *self._etcd_options(member)]
            yield Program(f"etcd-{member.name}", ["/bin/sh", "-c", _BECOME, member.name, *argv])
        for index in range(len(self._members)):
            words = ("--settings", json.dumps(self._of_master(document, index)))
            ready = {} if index == 0 else {"ready": _STAND_BY}
            yield Program.of(f"master{index + 1}", "rce_master", *words, env={WARNED_VARIABLE: "1"}, **ready)

    def _of_master(self, document: dict[str, Any], index: int) -> dict[str, Any]:
        """Return the settings of one master; its own member of etcd is the first one that it asks."""
        own = self._settings.master
        members = [*self._members[index:], *self._members[:index]]
        scheme = "etcds" if self._settings.tls.enabled else "etcd"
        hosts = ",".join(f"{LOOPBACK}:{member.client_port}" for member in members)
        found = {
            "store": f"{scheme}://{hosts}",
            "http_port": own.http_port + index,
            "control_port": own.control_port + index,
        }
        others: dict[str, Any] = {}
        if index:
            found["state_dir"] = str(self._settings.state_dir.absolute() / f"master{index + 1}")
            if self._settings.log_dir is not None:  # two programs cannot rotate one file
                others["log_dir"] = str(self._settings.log_dir.absolute() / f"master{index + 1}")
        return document | {"master": document.get("master", {}) | found} | others

    def _etcd_options(self, member: Member) -> Iterator[str]:
        tls = self._settings.tls
        scheme = "https" if tls.enabled else "http"
        client = f"{scheme}://{LOOPBACK}:{member.client_port}"
        all_ = ",".join(f"{one.name}={self._peer(one)}" for one in self._members)
        yield from ("--data-dir", str(self._folder / member.name))
        yield from ("--listen-client-urls", client, "--advertise-client-urls", client)
        yield from ("--listen-peer-urls", self._peer(member))
        yield from ("--initial-advertise-peer-urls", self._peer(member), "--initial-cluster", all_)
        yield from _OPTIONS
        if tls.enabled:
            folder = self._settings.certificates.absolute()
            for start in ("", "peer-"):
                yield from (f"--{start}cert-file", str(folder / f"{tls.name}.pem"))
                yield from (f"--{start}key-file", str(folder / f"{tls.name}.key"))
                yield from (f"--{start}trusted-ca-file", str(folder / "authority.pem"))
                yield f"--{start}client-cert-auth"

    def _peer(self, member: Member) -> str:
        return f"{'https' if self._settings.tls.enabled else 'http'}://{LOOPBACK}:{member.peer_port}"


def _members(folder: Path, count: int) -> list[Member]:
    """Return the members whose data is in a folder; their ports are the same for good, since etcd keeps them.

    Raises:
        ReplicasError: The folder has the data of another number of members, or cannot be used.
    """
    path = folder / "ports.json"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not path.exists():
            aside = path.with_name(f".{path.name}.{os.getpid()}")
            aside.write_text(json.dumps(_free_ports(2 * count)), encoding="utf-8")
            aside.replace(path)  # a start that is killed leaves no half of it
        ports = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReplicasError(f"{path} cannot be used: {error}") from error
    if not isinstance(ports, list) or len(ports) != 2 * count:
        raise ReplicasError(
            f"{folder} has the data of {len(ports) // 2} members of etcd: give --replicas {len(ports) // 2},"
            " or another --state-dir"
        )
    return [Member(f"m{i + 1}", ports[2 * i], ports[2 * i + 1]) for i in range(count)]


def _free_ports(count: int) -> list[int]:
    """Return ports of loopback: from the usual one on, or any if one of those is taken."""
    with ExitStack() as stack:
        try:
            return [_bind(stack, FIRST_PORT + index) for index in range(count)]
        except OSError:
            return [_bind(stack, 0) for _ in range(count)]


def _bind(stack: ExitStack, port: int) -> int:
    sock = stack.enter_context(socket.socket())
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((LOOPBACK, port))
    return int(sock.getsockname()[1])
