"""``rce cluster``: the machines of an engine with several masters, each with a member of etcd."""

from __future__ import annotations

import asyncio
import os
import shlex
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer

from rce.cli.service import USER, check, install, is_system, make_service, make_user, systemd_runs
from rce.config import ETCD_FILE, default_state_dir
from rce.config.store_address import DEFAULT_PREFIX
from rce.masters import split_addresses
from rce.own_process import end_signals
from rce.services.units import SYSTEM_STATE, Role
from rce.tls import CertificateError
from rce.tls.choice import TlsChoice
from rce.tls.folder import AUTHORITY, CertificateFolder
from rce_master.cli.client import run
from rce_master.cluster.files import CERTIFICATE, Machine, read_config
from rce_master.cluster.joining import (
    check_place,
    cluster_client,
    forget_machine,
    hint,
    remove_member,
    request_membership,
    wait_for_vote,
)
from rce_master.cluster.members import ClusterError, UnknownMemberError
from rce_master.cluster.process import find_etcd, start_etcd, until_ends
from rce_master.cluster.recovery import read_machine
from rce_master.cluster.recovery import recover as recover_alone
from rce_master.cluster.report import make_report
from rce_master.settings import HTTP_PORT
from rce_master.store.etcd.layout import Keys

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from rce.tls import Context
    from rce_master.cluster.members import Member

CLIENT_PORT, PEER_PORT = 2379, 2380

app = typer.Typer(no_args_is_help=True, help="Run masters on three machines (docs/how-to/cluster.md).")

Address = Annotated[
    str, typer.Option(metavar="HOST", help="Address of this machine that the other machines reach.")
]
Name = Annotated[str, typer.Option(help="Name of this machine in the cluster (default: its host name).")]
ClientPort = Annotated[int, typer.Option(min=1, max=65535, help="Port of etcd for masters.")]
PeerPort = Annotated[int, typer.Option(min=1, max=65535, help="Port of etcd for other members.")]
StateDir = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder of data and certificates (of root: /var/lib/rce)."),
]
UseTls = Annotated[bool, typer.Option("--tls/--no-tls", help="Use TLS between machines.")]
Foreground = Annotated[
    bool, typer.Option("--foreground", help="Run etcd in this terminal, without systemd; install nothing.")
]
RunAs = Annotated[str, typer.Option(help="User of the services of the machine; created if missing.")]
Etcd = Annotated[
    str,
    typer.Option(
        metavar="HOST[:PORT],...", help="Members of etcd (default: those of this machine's cluster)."
    ),
]


@app.command("init")
def init(
    address: Address,
    name: Name = "",
    client_port: ClientPort = CLIENT_PORT,
    peer_port: PeerPort = PEER_PORT,
    tls: UseTls = True,
    state_dir: StateDir = None,
    foreground: Foreground = False,
    run_as: RunAs = USER,
) -> None:
    """Begin a cluster on the first machine."""
    run(_init(_Local.of(address, name, (client_port, peer_port), tls, state_dir, foreground, run_as)))


@app.command("join")
def join(
    members: Annotated[
        str, typer.Argument(metavar="HOST[:PORT],...", help="Members of the cluster, one or several.")
    ],
    address: Address,
    name: Name = "",
    client_port: ClientPort = CLIENT_PORT,
    peer_port: PeerPort = PEER_PORT,
    tls: UseTls = True,
    state_dir: StateDir = None,
    foreground: Foreground = False,
    run_as: RunAs = USER,
) -> None:
    """Let this machine join a cluster."""
    local = _Local.of(address, name, (client_port, peer_port), tls, state_dir, foreground, run_as)
    run(_join(local, members))


@app.command("status")
def status(
    etcd: Etcd = "",
    http_port: Annotated[int, typer.Option(help="Port of the masters' HTTP servers.")] = HTTP_PORT,
    tls: UseTls = True,
    state_dir: StateDir = None,
    json_: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Show members of etcd and masters; exit with 1 if one fails."""

    async def show() -> None:
        endpoints, contexts = _place(etcd, state_dir, tls=tls)
        async with await cluster_client(endpoints, contexts) as client:
            report = await make_report(client, contexts, http_port)
        typer.echo(report.as_json() if json_ else "\n".join(report.lines()))
        if not report.ok:
            raise typer.Exit(1)

    run(show())


@app.command("remove")
def remove(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Member to remove, as status shows it.")],
    etcd: Etcd = "",
    tls: UseTls = True,
    state_dir: StateDir = None,
    force: Annotated[
        bool, typer.Option("--force", help="Remove it also if the others have no quorum then.")
    ] = False,
) -> None:
    """Remove a machine from the cluster, also one that is lost."""

    async def do() -> None:
        endpoints, contexts = _place(etcd, state_dir, tls=tls)
        async with await cluster_client(endpoints, contexts) as client:
            try:
                leaving, others = await remove_member(client, name, contexts, force=force)
            except UnknownMemberError:
                if not (masters := await forget_machine(client, name)):
                    raise
                typer.echo(f"etcd has no member {name}: it was removed before")
            else:
                typer.echo(f"removed {leaving.shown}; {hint(others)}")
                masters = await forget_machine(client, leaving.name, leaving.host)
            for master in masters:
                typer.echo(f"the other masters do not count {master} any more")
        typer.echo(
            "on that machine, if it is there: rce uninstall-service master; rce uninstall-service etcd; then"
            " remove its folder etcd and the file etcd.yaml"
        )

    run(do())


@app.command("recover")
def recover(
    state_dir: StateDir = None,
    force: Annotated[
        bool,
        typer.Option("--force", help="Recover it also if a member that can be reached does not answer."),
    ] = False,
) -> None:
    """Make this machine a cluster of its own when most members are lost."""

    async def do() -> None:
        machine, known = read_machine((state_dir or _default_folder()).absolute())
        contexts = _contexts(machine.certificates) if machine.tls else None
        before = await recover_alone(machine, known, contexts, force=force)
        again = "the command that started etcd here" if state_dir else "systemctl start rce-etcd rce-master"
        typer.echo(
            f"{machine.name} is a cluster of its own; its data as it was is in {before}\n"
            "writes that had not reached this machine are lost\n"
            f"start it: {again}\n"
            "on each other machine, before its etcd or master starts again: remove the folder etcd and the"
            " file etcd.yaml; then: rce cluster join"
        )

    run(do())


@dataclass(frozen=True, slots=True)
class _Local:
    """This machine, and how its programs run."""

    machine: Machine
    foreground: bool
    run_as: str
    system: bool

    @classmethod
    def of(
        cls,
        address: str,
        name: str,
        ports: tuple[int, int],
        tls: bool,
        state_dir: Path | None,
        foreground: bool,
        run_as: str,
    ) -> _Local:
        if state_dir is not None and not foreground:
            raise typer.BadParameter(
                "--state-dir is for --foreground; services keep their data in the default folder"
            )
        folder = (state_dir or _default_folder()).absolute()
        try:
            machine = Machine(name or socket.gethostname(), address.strip("[]"), *ports, folder, tls)
        except ClusterError as error:
            raise typer.BadParameter(str(error)) from None
        return cls(machine, foreground, run_as, is_system(None))

    @property
    def contexts(self) -> Context | None:
        """TLS of requests to etcd.

        Raises:
            ClusterError: The certificates cannot be used.
        """
        return _contexts(self.machine.certificates) if self.machine.tls else None

    async def has_users(self) -> bool:
        """Return whether the cluster's state has a user.

        Raises:
            EtcdError: etcd does not answer.
        """
        async with await cluster_client([self.machine.client], self.contexts) as client:
            return bool((await client.range(Keys(DEFAULT_PREFIX).row("users", ""), limit=1)).records)

    def begins(self) -> bool:
        """Check the machine; return whether it has no member yet.

        Raises:
            ClusterError: It cannot have one.
        """
        find_etcd()
        if not self.foreground:  # before others know of this machine
            check(make_service(Role.MASTER, (), system=self.system, config=None, run_as=self.run_as))
        machine = self.machine
        if machine.config.exists() and machine.data.exists():
            found = read_config(machine.config)
            if (found["name"], found["initial-advertise-peer-urls"]) == (machine.name, machine.peer_url):
                return False
        check_place(machine)
        return True

    async def start(self, steps: Callable[[], Awaitable[Sequence[Member]]]) -> None:
        """Run etcd, and what makes it a member; then the master, or say how."""
        if self.foreground:
            await self._run_etcd(steps)
            return
        if self.machine.tls and self.system and self.run_as != "root":
            self._hand_over_certificates()
        install(make_service(Role.ETCD, (), system=self.system, config=None, run_as=self.run_as))
        if not systemd_runs():
            typer.echo("then run this command again: it waits until etcd works")
            return
        members = await steps()
        self.machine.keep(members)
        arguments = self.machine.master_arguments(_clients(members))
        has_users = await self.has_users()
        install(
            make_service(Role.MASTER, tuple(arguments), system=self.system, config=None, run_as=self.run_as),
            start=has_users,
        )
        self._say_state(members)
        if not has_users:  # none can be added over the API, and no state be copied here, once a master leads
            scope = "" if self.system else "--user "
            typer.echo(f"when there is a user, start the master: systemctl {scope}start rce-master")

    async def _run_etcd(self, steps: Callable[[], Awaitable[Sequence[Member]]]) -> None:
        process = await start_etcd(self.machine.config)
        loop = asyncio.get_running_loop()
        ending = asyncio.Event()
        for number in end_signals():
            loop.add_signal_handler(number, ending.set)

        async def become_member() -> None:
            members = await steps()
            self.machine.keep(members)
            self._say_state(members)
            words = self.machine.master_arguments(_clients(members))
            typer.echo(
                "run the master:"
                f" {shlex.join(['rce-master', '--state-dir', str(self.machine.master), *words])}"
            )
            typer.echo(f"etcd ready: {self.machine.client}")

        code = await until_ends(process, ending, become_member)
        if not ending.is_set():
            raise ClusterError(f"etcd ended with exit code {code}; its output says why")

    def _say_state(self, members: Sequence[Member]) -> None:
        typer.echo(f"{self.machine.name} is a member of the cluster: {hint(members)}")

    def _hand_over_certificates(self) -> None:
        """Let the services' user read this machine's certificate; the authority's key stays root's."""
        make_user(self.run_as)
        folder = self.machine.certificates
        names = ("authority.pem", "revoked.pem", f"{CERTIFICATE}.pem", f"{CERTIFICATE}.key")
        for path in (folder, *(folder / name for name in names)):
            if path.exists():
                shutil.chown(path, self.run_as)


async def _init(local: _Local) -> None:
    machine = local.machine
    machine.check_data()
    if local.begins():
        if machine.tls:
            folder = CertificateFolder(machine.certificates)
            try:
                done = folder.ensure(
                    CERTIFICATE, [machine.host, socket.gethostname(), "localhost", "127.0.0.1"]
                )
                if folder.has(AUTHORITY):
                    folder.ensure_list()
            except CertificateError as error:
                raise ClusterError(str(error)) from error
            if done:
                typer.echo(done)
        machine.write({machine.name: machine.peer_url}, new=True)
    _warn_plain(machine)
    contexts = local.contexts

    async def steps() -> Sequence[Member]:
        members = await wait_for_vote([machine.client], machine, contexts)
        if not await local.has_users():
            typer.echo(
                f"next, add the first user: rce user add NAME --admin --state-dir {machine.folder} --store"
                f" {machine.store((machine.client,))}"
            )
        if machine.tls:
            typer.echo(
                f"for each further machine: rce certificate issue NAME --host ADDRESS --certificates"
                f" {machine.certificates}; copy NAME.pem, NAME.key, authority.pem and"
                f" revoked.pem to it, as {CERTIFICATE}.pem, {CERTIFICATE}.key, authority.pem and revoked.pem"
                " in its folder of certificates"
            )
        typer.echo(f"there, with the same secret: rce cluster join {machine.client} --address ADDRESS")
        return members

    await local.start(steps)


async def _join(local: _Local, addresses: str) -> None:
    endpoints = _endpoints(addresses)
    machine = local.machine
    begins = local.begins()
    if machine.tls:
        _check_certificate(machine)
    contexts = local.contexts
    _warn_plain(machine)
    if machine.client in endpoints:
        raise ClusterError(f"{machine.client} is this machine; name a member that the cluster has already")
    if begins:
        async with await cluster_client(endpoints, contexts) as client:
            peers = await request_membership(client, machine, contexts)
        machine.write(peers, new=False)

    async def steps() -> Sequence[Member]:
        return await wait_for_vote(endpoints, machine, contexts)

    await local.start(steps)
    if not local.foreground:
        typer.echo(
            "on the machines that were there before, when it suits, run the command again that made each of"
            " them a member: their masters then use this member of etcd too"
        )


def _check_certificate(machine: Machine) -> None:
    folder = CertificateFolder(machine.certificates)
    how = (
        f"on the machine with the authority run: rce certificate issue {machine.name} --host"
        f" {machine.host}; copy"
        f" {machine.name}.pem to {folder.certificate(CERTIFICATE)}, {machine.name}.key to"
        f" {folder.key(CERTIFICATE)}, and authority.pem and revoked.pem to {folder.path}"
    )
    if not folder.has(CERTIFICATE) or not folder.authority.exists():
        raise ClusterError(f"this machine has no certificate in {folder.path}: {how}")
    try:
        details = folder.details(CERTIFICATE)
    except CertificateError as error:
        raise ClusterError(str(error)) from error
    if not details.covers(machine.host):
        raise ClusterError(
            f"the certificate {folder.certificate(CERTIFICATE)} is for {', '.join(details.hosts)}, not for"
            f" {machine.host}: {how}"
        )


def _contexts(folder: Path) -> Context:
    try:
        return TlsChoice(enabled=True, folder=folder).own_identity().client
    except CertificateError as error:
        raise ClusterError(f"{error}; a cluster without TLS needs --no-tls") from error


def _place(etcd: str, state_dir: Path | None, *, tls: bool) -> tuple[list[str], Context | None]:
    """Return members of the cluster, and TLS of requests; without ``--etcd`` they are as on this machine."""
    folder = (state_dir or _default_folder()).absolute()
    if etcd:
        return _endpoints(etcd), _contexts(folder / "certificates") if tls else None
    found = read_config(folder / ETCD_FILE)
    url = urlsplit(str(found["advertise-client-urls"]))
    others = [
        urlsplit(each.partition("=")[2]).hostname or "" for each in str(found["initial-cluster"]).split(",")
    ]
    port = url.port or CLIENT_PORT
    endpoints = [url.netloc, *(f"[{host}]:{port}" if ":" in host else f"{host}:{port}" for host in others)]
    return list(dict.fromkeys(endpoints)), _contexts(
        folder / "certificates"
    ) if url.scheme == "https" else None


def _endpoints(text: str) -> list[str]:
    """Read addresses of members.

    Raises:
        ClusterError: They are not addresses.
    """
    from rce.config import EtcdAddress, read_store_address

    addresses = ",".join(split_addresses(text))
    try:
        found = read_store_address(f"etcd://{addresses}")
    except ValueError as error:
        raise ClusterError(str(error)) from None
    assert isinstance(found, EtcdAddress)
    return list(found.endpoints)


def _clients(members: Sequence[Member]) -> tuple[str, ...]:
    return tuple(each.client for each in members if each.client)


def _default_folder() -> Path:
    return SYSTEM_STATE if os.geteuid() == 0 else default_state_dir()


def _warn_plain(machine: Machine) -> None:
    if not machine.tls:
        typer.echo(
            "warning: without TLS, everyone who reaches etcd's ports can read and change the state;"
            " open them for"
            " the machines of the cluster only",
            err=True,
        )
