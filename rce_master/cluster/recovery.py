"""How one machine becomes a cluster of its own when more than half of the members are lost for good."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import shutil
import socket
import time
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import yaml

from rce.config import ETCD_FILE
from rce.dialing import connect_first, resolve
from rce_master.cluster.client import ClusterClient, ask_all
from rce_master.cluster.engines import forget_masters, known_masters
from rce_master.cluster.files import Machine, read_config
from rce_master.cluster.joining import START_S, check_ports
from rce_master.cluster.members import ClusterError, Member, MemberStatus
from rce_master.cluster.process import end_etcd, start_etcd
from rce_master.exceptions import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from rce.tls import Context

_PAUSE_S = 0.3
_CONNECT_S = 5.0
"""How long another machine may take to accept a connection, or to refuse it."""
_AWAY = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)
"""What the system says of a machine without etcd, or without a way to it."""
_LOOPBACK = "127.0.0.1"
_STOP = (
    "if etcd runs here, stop it and the master first (systemctl stop rce-master rce-etcd; with --foreground:"
    " Ctrl-C)"
)


def read_machine(folder: Path) -> tuple[Machine, tuple[Member, ...]]:
    """Return this machine, and the members that it knew when it joined, as its configuration names them.

    Raises:
        ClusterError: It is in no cluster.
    """
    found = read_config(folder / ETCD_FILE)
    client = urlsplit(str(found["advertise-client-urls"]))
    peer = urlsplit(str(found["initial-advertise-peer-urls"]))
    if client.hostname is None or client.port is None or peer.port is None:
        raise ClusterError(f"{folder / 'etcd.yaml'} does not name this machine's addresses")
    tls = client.scheme == "https"
    machine = Machine(str(found["name"]), client.hostname, client.port, peer.port, folder, tls)
    members = []
    for number, text in enumerate(str(found["initial-cluster"]).split(","), 1):
        name, _, url = text.partition("=")
        parts = urlsplit(url)
        members.append(Member(number, name, parts.netloc, _client_of(machine, parts.hostname or "")))
    return machine, tuple(members)


async def recover(
    machine: Machine, known: Iterable[Member], tls: Context | None, *, force: bool = False
) -> Path:
    """Make a machine's data that of a cluster with one member; return the folder of the data as it was.

    This works on a copy, which takes the place of the data at the end.

    Args:
        machine: The machine; its etcd does not run.
        known: The members that it knows.
        tls: TLS of requests.
        force: Recover it also if it is not known whether another member works.

    Raises:
        ClusterError: Another member works or may work, etcd runs here, or the data cannot be used; nothing
            was changed.
    """
    await _check_away([each for each in known if each.peer != machine.peer], tls, force=force)
    if not machine.data.exists():
        raise ClusterError(f"{machine.data} is missing: restore a backup (rce cluster init, rce restore)")
    try:
        check_ports(machine)
    except ClusterError as error:
        raise ClusterError(f"{error}; {_STOP}") from error
    copy = machine.folder / "etcd.alone"
    before = machine.folder / f"etcd.before-{time.strftime('%Y%m%d-%H%M%S')}"
    try:
        await asyncio.to_thread(_copy, machine.data, copy)
        await _run_alone(machine, copy, tls, force=force)
        machine.data.rename(before)
        copy.rename(machine.data)
    except OSError as error:
        raise ClusterError(f"cannot copy {machine.data}: {error}") from error
    finally:
        shutil.rmtree(copy, ignore_errors=True)
    machine.write({machine.name: machine.peer_url}, new=False)
    return before


async def _check_away(others: Sequence[Member], tls: Context | None, *, force: bool) -> None:
    answers = await ask_all(others, tls)
    signs = await asyncio.gather(*(_sign_of(member) for member in others))
    for member, sign in zip(others, signs, strict=True):
        if isinstance(answers[member.id], MemberStatus):
            raise ClusterError(
                f"etcd on {member.shown} ({member.client}) works: start members until more than half work,"
                " and remove the lost ones; or stop it for good first, and what only it has is lost"
            )
        if sign and not force:
            raise ClusterError(
                f"etcd on {member.shown} ({member.client}) may work: {sign} ({answers[member.id]}). Two"
                " clusters would go separate ways: look at that machine first; --force if its etcd is ended"
                " for good"
            )


async def _sign_of(member: Member) -> str:
    """Return why a member that does not answer may work nevertheless; empty: it is away."""
    host, _, port = member.client.rpartition(":")
    try:
        for address in await resolve(host.strip("[]"), int(port)):
            try:
                async with asyncio.timeout(_CONNECT_S):
                    connected = await connect_first([address])
            except TimeoutError:  # also that of the system
                continue
            except OSError as error:
                if error.errno not in _AWAY:
                    raise
            else:
                connected.close()
                return "its port takes connections"
    except OSError as error:
        return str(error)
    return ""


def _copy(source: Path, target: Path) -> None:
    """Copy a folder with its owners, which a copy by root would not keep."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)
    for path in (source, *source.rglob("*")):
        found = path.stat()
        os.chown(target / path.relative_to(source), found.st_uid, found.st_gid)


async def _run_alone(machine: Machine, data: Path, tls: Context | None, *, force: bool) -> None:
    """Run etcd on a copy of the data, on ports that no other program knows, until it is the only member."""
    client, peer = _free_port(machine.host), _free_port(_LOOPBACK)
    client_url = f"{machine.scheme}://{_client_of(machine, machine.host, client)}"
    own = {
        "data-dir": str(data),
        "listen-client-urls": client_url,
        "advertise-client-urls": client_url,
        "listen-peer-urls": f"{machine.scheme}://{_LOOPBACK}:{peer}",
        "force-new-cluster": True,
    }
    config = machine.folder / "etcd.alone.yaml"
    config.write_text(yaml.safe_dump(read_config(machine.config) | own), encoding="utf-8")
    config.chmod(0o644)  # etcd's user reads it, whatever the umask is
    process = await start_etcd(config, _owner(data))
    try:
        endpoint = _client_of(machine, machine.host, client)
        async with ClusterClient([endpoint], tls=tls) as alone:
            await _until_alone(alone, machine, process)
            await _forget_other_masters(alone, machine, tls, force=force)
    finally:
        await end_etcd(process)
        config.unlink(missing_ok=True)


async def _until_alone(client: ClusterClient, machine: Machine, process: asyncio.subprocess.Process) -> None:
    why: object = "etcd was not started"
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(START_S):
            while process.returncode is None:
                try:
                    members = await client.members()
                    if [each.peer for each in members] == [machine.peer]:
                        return
                    why = f"it has {len(members)} members"
                except StoreError as error:
                    why = error
                await asyncio.sleep(_PAUSE_S)
    raise ClusterError(f"etcd did not become a cluster of its own: {why}; its output says more")


async def _forget_other_masters(
    client: ClusterClient, machine: Machine, tls: Context | None, *, force: bool
) -> None:
    """Remove what etcd knows of masters on other machines, so that packages do not wait for them.

    Raises:
        ClusterError: etcd works, or may work, on one of these machines, which joined later than this one.
    """
    others = [one for one in await known_masters(client) if one.host != machine.host]
    places = {one.host: one.name.rpartition(":")[0] for one in others}
    await _check_away(
        [
            Member(number, name, "", _client_of(machine, host))
            for number, (host, name) in enumerate(places.items(), 1)
        ],
        tls,
        force=force,
    )
    await forget_masters(client, others)


def _owner(folder: Path) -> tuple[int | None, int | None]:
    """Return the user and group that etcd is to run as; None: those of this process."""
    found = folder.stat()
    return (found.st_uid, found.st_gid) if os.geteuid() == 0 else (None, None)


def _client_of(machine: Machine, host: str, port: int = 0) -> str:
    shown = f"[{host}]" if ":" in host else host
    return f"{shown}:{port or machine.client_port}"


def _free_port(host: str) -> int:
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as sock:
        sock.bind((host, 0))
        return int(sock.getsockname()[1])
