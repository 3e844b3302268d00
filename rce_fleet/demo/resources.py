"""TCP ports and the folder of a demo run."""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import shutil
import socket
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import psutil

from rce_fleet.demo.exceptions import DemoError, PortInUseError

LOOPBACK = "127.0.0.1"
QUIET_PORTS = range(12000, 32000)
"""Ports below the system's ephemeral range."""
MAX_PORT = 65535
ATTEMPTS = 100
PREFIX = "rce-demo-"
LOCK = "lock"
"""A file in the folder that its owner keeps locked; the system releases the lock when the owner ends."""

# Ports


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of engine, core and page; 0 stands for a free port that is not chosen yet."""

    page: int = 9080
    """The operator's page and the API for an ERP."""
    http: int = 9000
    """Clients and REST of the master."""
    control: int = 8080
    """Task sets."""
    ws: int = 9010
    """The robots' WebSockets."""
    robot_link: int = 10030
    """Links to robot endpoints."""
    container_link: int = 10031
    """Links to containers."""
    core: int = 11311
    """The ROS core of the mode ``single``."""

    def choose(self, names: Iterable[str] = ()) -> Ports:
        """Return the same with each 0 replaced by a free port, after checking that the others are free.

        Args:
            names: Ports that are needed; the others are left as they are, unchecked. Empty: all.

        Raises:
            PortInUseError: A port is in use.
        """
        names = tuple(names) or [field.name for field in fields(self)]
        # All stay bound until the last one is found, so that no port is chosen twice.
        with contextlib.ExitStack() as bound:
            found = {name: bound.enter_context(_bind(getattr(self, name), option_of(name))) for name in names}
        return replace(self, **found)

    def in_rows(self, count: int) -> Ports:
        """Return the same with ports for so many masters: theirs and the next ones are free.

        Raises:
            PortInUseError: A port is in use.
        """
        with contextlib.ExitStack() as bound:
            found = {
                name: _bind_row(bound, getattr(self, name), count, option_of(name))
                for name in ("http", "control")
            }
        return replace(self, **found)


ANY = Ports(page=0, http=0, control=0, ws=0, robot_link=0, container_link=0, core=0)
"""Free ports, so that several demos can run side by side."""


def free_ports(count: int) -> list[int]:
    """Return free ports."""
    with contextlib.ExitStack() as bound:
        return [bound.enter_context(_bind(0, "")) for _ in range(count)]


def option_of(name: str) -> str:
    """Return the option of ``rce demo`` that sets a port."""
    return "--port" if name == "page" else f"--{name.replace('_', '-')}-port"


@contextlib.contextmanager
def _bind(port: int, option: str) -> Iterator[int]:
    with _listen(port, option) if port else _listen_anywhere(option) as server:
        yield int(server.getsockname()[1])


def _listen(port: int, option: str) -> socket.socket:
    if port > MAX_PORT:
        raise DemoError(f"{port} cannot be a port; choose another one with {option}")
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        raise PortInUseError(port, option) from error


def _listen_anywhere(option: str) -> socket.socket:
    """Listen on a free port that the system does not hand out by itself.

    The port is released here and bound again later by the program that it is for; an ephemeral port could be
    given to another program in between.
    """
    for port in random.SystemRandom().sample(QUIET_PORTS, ATTEMPTS):
        with contextlib.suppress(PortInUseError):
            return _listen(port, option)
    raise PortInUseError(QUIET_PORTS.start, option)


def _bind_row(bound: contextlib.ExitStack, first: int, count: int, option: str) -> int:
    """Bind free ports in a row; return the first of them.

    Args:
        bound: Releases them.
        first: The first one; 0: any.
        count: How many.
        option: The option that sets the first one.

    Raises:
        PortInUseError: One is in use.
    """
    if first:
        for port in range(first, first + count):
            bound.enter_context(_listen(port, option))
        return first
    starts = range(QUIET_PORTS.start, QUIET_PORTS.stop - count)
    for start in random.SystemRandom().sample(starts, ATTEMPTS):
        with contextlib.ExitStack() as row, contextlib.suppress(PortInUseError):
            for port in range(start, start + count):
                row.enter_context(_listen(port, option))
            bound.push(row.pop_all())
            return start
    raise PortInUseError(QUIET_PORTS.start, option)


# Folder


@contextlib.contextmanager
def run_folder(keep_in: Path | None = None) -> Iterator[Path]:
    """Create the folder of a run.

    Args:
        keep_in: Parent of a folder that is kept. If None, the folder is temporary: it is removed at the end,
            as are folders of earlier demos that were killed.

    Raises:
        DemoError: It cannot be created.
    """
    if keep_in is not None:
        try:
            keep_in.mkdir(parents=True, exist_ok=True)
            stamp = time.strftime("demo-%Y%m%d-%H%M%S-")
            made = Path(tempfile.mkdtemp(prefix=stamp, dir=keep_in.absolute()))
        except OSError as error:
            text = f"--state-dir {keep_in} cannot be used: {error.strerror or error}; give another folder"
            raise DemoError(text) from error
        yield made
        return
    remove_abandoned(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with (folder / LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder


def remove_abandoned(parent: Path) -> list[Path]:
    """Remove folders of this user's killed demos, except those whose programs still run.

    Returns:
        The removed folders.
    """
    abandoned = [folder for folder in parent.glob(f"{PREFIX}*") if _is_abandoned(folder)]
    if not abandoned:
        return []
    lines = _command_lines()
    unused = [folder for folder in abandoned if not any(str(folder) in line for line in lines)]
    for folder in unused:
        shutil.rmtree(folder, ignore_errors=True)
    return unused


def _is_abandoned(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        if folder.is_symlink() or folder.stat().st_uid != os.getuid():
            return False
        with (folder / LOCK).open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    return False  # locked by a running demo, or not a demo's folder


def _command_lines() -> list[str]:
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            found.append(" ".join(process.cmdline()))
    return found
