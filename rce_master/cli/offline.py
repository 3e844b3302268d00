"""Work on a master's state folder while no master runs on it.

Changes are in the audit log, as changes over the API: the user is that of the operating system, and the
address is ``offline``.
"""

from __future__ import annotations

import os
import pwd
import time
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rce.config import MASTER_FOLDER, STORE_FILE, ConfigError, default_state_dir, load_settings
from rce_master.audit import AuditLog
from rce_master.cli import credentials
from rce_master.cli.exceptions import CliError, NotLoggedInError
from rce_master.exceptions import StoreBusyError
from rce_master.settings import state_settings
from rce_master.state.core import State
from rce_master.state_service import load_converted
from rce_master.store import SqliteStore, Store

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rce_master.cli.credentials import Credentials
    from rce_master.state.commands import Command

OFFLINE = "offline"
"""The address in the audit log for changes made on this machine."""

StateDir = Annotated[
    Path | None,
    typer.Option(help="Work on this state folder while no master runs on it, instead of over the API."),
]


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


class OfflineState:
    """The state of a master that does not run. Its store is locked.

    Attributes:
        state: The state of the store, with the changes since.
        folder: Where it is.
    """

    def __init__(self, state: State, store: Store, term: int, audit: AuditLog, folder: Path) -> None:
        self.state = state
        self.folder = folder
        self._store = store
        self._term = term
        self._audit = audit

    async def do(self, command: Command, action: str, subject: str) -> None:
        """Apply a change, store it, and write it to the audit log.

        Args:
            command: The change.
            action: What the audit log calls it, as for the same change over the API.
            subject: What it is about.

        Raises:
            MasterError: The state does not allow it, or it cannot be stored.
        """
        rows = self.state.apply(command, time.monotonic()).rows()
        await self._store.save(rows, self._term)
        self._audit.add(_caller(), action, subject, address=OFFLINE)


@asynccontextmanager
async def open_state(state_dir: Path) -> AsyncIterator[OfflineState]:
    """Open the state in a folder: the master's own, or the engine's, which contains the master's.

    Raises:
        CliError: A master runs on it, there are two states, or the settings cannot be read.
    """
    folder = find_state(state_dir)
    try:
        settings = state_settings(load_settings(None))
    except ConfigError as error:
        raise CliError(str(error)) from error
    try:
        store = await SqliteStore.open(folder)
    except StoreBusyError as error:
        raise CliError(f"{error}; to work over its API, log in there: rce login") from error
    audit = AuditLog(folder / "audit", time.time)
    try:
        term = await store.begin_term()
        state = State.load(await load_converted(store, term), time.monotonic(), settings=settings)
        yield OfflineState(state, store, term, audit, folder)
    finally:
        audit.close()
        await store.close()


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
