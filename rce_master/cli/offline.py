"""Work on a master's state folder, or on its etcd, while no master runs on it.

Changes are in the audit log, as changes over the API: the user is that of the operating system, and the
address is ``offline``.
"""

from __future__ import annotations

import os
import pwd
import stat
import time
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec import structs

from rce.config import (
    ETCD_FILE,
    MASTER_FOLDER,
    STORE_FILE,
    ConfigError,
    EtcdAddress,
    default_state_dir,
    load_settings,
    read_store_address,
)
from rce.tls import CertificateError
from rce.tls.choice import FOLDER, TlsChoice
from rce_master.audit import AUDIT, AuditLog
from rce_master.cli import credentials
from rce_master.cli.exceptions import CliError, NotLoggedInError
from rce_master.exceptions import StoreBusyError
from rce_master.settings import state_settings
from rce_master.state.core import State
from rce_master.state_service import load_converted
from rce_master.store import SqliteStore, Store
from rce_master.store.etcd import EtcdClient, EtcdStore
from rce_master.store.etcd.layout import prepare

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rce.config import EngineSettings
    from rce_master.cli.credentials import Credentials
    from rce_master.state.commands import Command

_ETCD_S = 5.0
"""How long one member of etcd may take for an answer."""
OFFLINE = "offline"
"""The address in the audit log for changes made on this machine."""

StateDir = Annotated[
    Path | None,
    typer.Option(help="Work on this state folder while no master runs on it, instead of over the API."),
]
StoreOption = Annotated[
    str,
    typer.Option(
        metavar="etcd://HOST:2379,...",
        help="Work on the state in this etcd while no master leads, instead of over the API.",
    ),
]


def read_etcd(store: str) -> EtcdAddress:
    """Read the value of ``--store``.

    Raises:
        CliError: It is not the address of an etcd.
    """
    try:
        address = read_store_address(store)
    except ValueError as error:
        raise CliError(f"--store {error}") from None
    if not isinstance(address, EtcdAddress):
        raise CliError("--store must be etcd://HOST:2379,...; for a folder use --state-dir")
    return address


def choose(state_dir: Path | None) -> Path | Credentials:
    """Choose the named folder, else the master of the login, else the default folder."""
    if state_dir is not None:
        return state_dir
    try:
        return credentials.load()
    except NotLoggedInError:
        return default_state_dir()


def find_state(state_dir: Path) -> Path:
    """Return the folder of the master's state that belongs to a state folder.

    It is the folder that holds a state: the state folder itself (``rce-master --state-dir``), or ``master``
    in it (``rce up --state-dir``). A new state is made where both programs find it.

    Raises:
        CliError: Both hold a state.
    """
    inner = state_dir / MASTER_FOLDER
    is_outer, is_inner = (state_dir / STORE_FILE).exists(), (inner / STORE_FILE).exists()
    if is_outer and is_inner:
        raise CliError(
            f"{state_dir} and {inner} both hold a master's state: rce up uses the second,"
            " rce-master --state-dir the first. Move the one that is not used aside"
        )
    is_own = state_dir.absolute().name == MASTER_FOLDER and not is_inner
    return state_dir if is_outer or is_own else inner


def find_folder(state_dir: Path) -> Path:
    """Return the folder of a master whose store is in etcd.

    It is the folder itself (``rce-master --state-dir``), or ``master`` in it, if that is there or the folder
    is of a machine of a cluster (``rce cluster``): neither holds a store that would tell them apart.
    """
    inner = state_dir / MASTER_FOLDER
    return inner if inner.is_dir() or (state_dir / ETCD_FILE).exists() else state_dir


def certificates_of(master: Path, settings: EngineSettings) -> Path:
    """Find the certificates of a master whose store is in etcd.

    Args:
        master: Its folder.
        settings: Name the folder of certificates; else it is in the master's folder, or in the engine's.
    """
    inside = master / FOLDER
    if settings.tls.certificates is None and inside.is_dir():
        return inside
    return structs.replace(settings, state_dir=master.parent).certificates


class OfflineState:
    """The state of a master that does not run. Its store is locked.

    Attributes:
        state: The state of the store, with the changes since.
        place: Where it is, for messages.
    """

    def __init__(self, state: State, store: Store, term: int, audit: AuditLog, place: str) -> None:
        self.state = state
        self.place = place
        self._store = store
        self._term = term
        self._audit = audit

    async def do(
        self, command: Command, action: str, subject: str, *, is_done: Callable[[], bool] = lambda: True
    ) -> None:
        """Apply a change, store it, and write it to the audit log.

        Args:
            command: The change; repeated until it is done.
            action: What the audit log calls it, as for the same change over the API.
            subject: What it is about.
            is_done: Tells whether it is, of one that exceeds the work of one command.

        Raises:
            MasterError: The state does not allow it, or it cannot be stored.
        """
        while True:
            rows = self.state.apply(command, time.monotonic()).rows()
            await self._store.save(rows, self._term)
            if is_done():
                break
        self._audit.add(_caller(), action, subject, address=OFFLINE)


@asynccontextmanager
async def open_state(place: Path | EtcdAddress, state_dir: Path | None = None) -> AsyncIterator[OfflineState]:
    """Open the state in a folder, the master's own or the engine's, which contains the master's, or in etcd.

    Args:
        place: Where the state is.
        state_dir: For etcd, the folder with the audit log and the certificates; None: the default one.

    Raises:
        CliError: A master runs on it, there are two states, or the settings cannot be read.
        StoreError: The store cannot be used.
    """
    try:
        settings = load_settings(None, *([{"state_dir": state_dir}] if state_dir else []))
    except ConfigError as error:
        raise CliError(str(error)) from error
    folder = find_state(place) if isinstance(place, Path) else settings.master_state
    async with AsyncExitStack() as stack:
        stack.callback(give_to_owner, folder)
        try:
            store = await stack.enter_async_context(
                open_store(folder if isinstance(place, Path) else place, TlsChoice.of(settings))
            )
            term = await store.begin_term()
        except StoreBusyError as error:
            raise CliError(f"{error}; to work over its API, log in there: rce login") from error
        audit = AuditLog(folder / AUDIT, time.time)
        stack.callback(audit.close)
        limits = state_settings(settings)
        state = State.load(await load_converted(store, term), time.monotonic(), settings=limits)
        yield OfflineState(state, store, term, audit, str(folder if isinstance(place, Path) else place))


@asynccontextmanager
async def open_store(place: Path | EtcdAddress, tls: TlsChoice) -> AsyncIterator[Store]:
    """Open the store in a folder or in etcd.

    Raises:
        CliError: A certificate cannot be used.
        StoreBusyError: A master runs on the folder.
        StoreError: The store cannot be used.
    """
    if isinstance(place, Path):
        store = await SqliteStore.open(place)
        try:
            yield store
        finally:
            await store.close()
        return
    async with _etcd_store(place, tls) as in_etcd:
        yield in_etcd


@asynccontextmanager
async def _etcd_store(address: EtcdAddress, tls: TlsChoice) -> AsyncIterator[Store]:
    try:
        identity = tls.own_identity() if address.tls else None
    except CertificateError as error:
        raise CliError(str(error)) from error
    contexts = None if identity is None else identity.client
    async with EtcdClient(address.endpoints, tls=contexts, attempt=_ETCD_S) as client:
        await prepare(client, address.prefix)
        yield EtcdStore(client, address.prefix)


def give_to_owner(folder: Path) -> None:
    """Give the owner of a state folder what root made in it, so that a master of another user can use it."""
    if os.geteuid() != 0 or not folder.is_dir() or (owner := folder.stat()).st_uid == 0:
        return
    for _, folders, files, place in os.fwalk(folder):  # follows no link that the owner made
        for name in (*folders, *files):
            found = os.stat(name, dir_fd=place, follow_symlinks=False)
            if found.st_uid == 0 and (stat.S_ISDIR(found.st_mode) or found.st_nlink == 1):
                os.chown(name, owner.st_uid, owner.st_gid, dir_fd=place, follow_symlinks=False)


def _caller() -> str:
    """Return the user who runs this program, also through sudo."""
    number = os.getuid()
    through = os.environ.get("SUDO_UID", "") if number == 0 else ""
    if through.isdecimal():
        number = int(through)
    try:
        return pwd.getpwuid(number).pw_name
    except (KeyError, OverflowError):
        return f"uid {number}"
