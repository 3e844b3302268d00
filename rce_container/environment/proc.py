"""Processes as ``/proc`` shows them: their descendants, their marks and their identity.

Runs inside containers too, and as a script (``proc.py MARK``: kill all processes that carry the mark), so it
imports only the standard library. Without ``/proc`` the functions find no processes.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time
from typing import NamedTuple

MARK = "RCE_MARK"
"""Environment variable of every process of a container without isolation; names its incarnation."""

_PROC = "/proc"
_PAGE = os.sysconf("SC_PAGE_SIZE")
_TICKS = os.sysconf("SC_CLK_TCK")
_STRIKES = 100
_PAUSE_S = 0.02


class Process(NamedTuple):
    """One process, identified by ``pid`` and ``start``: a reused pid has another start."""

    pid: int
    start: int
    """Clock ticks between the start of the machine and of the process."""
    parent: int
    group: int
    session: int
    cpu_s: float
    """CPU seconds of the process and of the children that it waited for."""
    resident: int
    """Bytes."""


def read(pid: int, *, zombies: bool = False) -> Process | None:
    """Read one process; None if it does not exist or is a zombie.

    Args:
        pid: The process.
        zombies: Read zombies too, such as a child that ended and was not waited for.
    """
    try:
        with open(f"{_PROC}/{pid}/stat", "rb") as file:  # noqa: PTH123 - pathlib doubles the cost of a scan
            text = file.read()
    except OSError:
        return None
    fields = text[text.rindex(b")") + 2 :].split()
    if fields[0] in (b"Z", b"X") and not zombies:
        return None
    return Process(
        pid=pid,
        start=int(fields[19]),
        parent=int(fields[1]),
        group=int(fields[2]),
        session=int(fields[3]),
        cpu_s=sum(map(int, fields[11:15])) / _TICKS,
        resident=int(fields[21]) * _PAGE,
    )


def table() -> dict[int, Process]:
    """Read all living processes."""
    try:
        names = os.listdir(_PROC)  # noqa: PTH208
    except OSError:
        return {}
    found = (read(int(name)) for name in names if name.isdigit())
    return {process.pid: process for process in found if process is not None}


def descendants(root: int, processes: dict[int, Process]) -> list[Process]:
    """Return ``root`` and all its descendants, parents before children."""
    children: dict[int, list[Process]] = {}
    for process in processes.values():
        children.setdefault(process.parent, []).append(process)
    found = [processes[root]] if root in processes else []
    for process in found:
        found.extend(children.get(process.pid, ()))
    return found


def marked(mark: str, *, variable: str = MARK) -> list[Process]:
    """Return all processes that were started with ``variable=mark`` in their environment."""
    needle = f"{variable}={mark}".encode()
    found = []
    for process in table().values():
        try:
            with open(f"{_PROC}/{process.pid}/environ", "rb") as file:  # noqa: PTH123
                variables = file.read().split(b"\0")
        except OSError:
            continue
        if needle in variables and process.pid != os.getpid():
            found.append(process)
    return found


def same(process: Process, other: Process | None) -> bool:
    """Return whether two records of a pid are of the same process."""
    return other is not None and (process.pid, process.start) == (other.pid, other.start)


def alive(pid: int, start: int) -> bool:
    """Return whether the process with this pid and start time still runs."""
    process = read(pid)
    return process is not None and process.start == start


def has_ended(pidfd: int) -> bool:
    """Return whether the process of a pidfd has ended."""
    poll = select.poll()  # select() refuses descriptors from 1024
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(0))


def proportional(pid: int) -> int | None:
    """Return the process's proportional share of memory (PSS) in bytes; None if it may not be read."""
    try:
        with open(f"{_PROC}/{pid}/smaps_rollup", "rb") as file:  # noqa: PTH123
            for line in file:
                if line.startswith(b"Pss:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        return None
    return None


def inner_pid(pid: int) -> int:
    """Return the process's pid in its innermost pid namespace; 0 if the process has ended."""
    try:
        with open(f"{_PROC}/{pid}/status", "rb") as file:  # noqa: PTH123
            for line in file:
                if line.startswith(b"NSpid:"):
                    return int(line.split()[-1])
    except OSError:
        pass
    return 0


def kill(process: Process) -> None:
    """Kill -9 a process, unless it has ended or its pid now belongs to another process."""
    if alive(process.pid, process.start):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(process.pid, signal.SIGKILL)


def strike(mark: str, *, variable: str = MARK) -> int:
    """Kill -9 all processes that carry the mark now.

    Returns:
        How many were found. They may have forked meanwhile, so repeat until it is 0.
    """
    found = marked(mark, variable=variable)
    for process in found:
        kill(process)
    return len(found)


def _main(mark: str) -> int:
    for _ in range(_STRIKES):
        if not strike(mark):
            return 0
        time.sleep(_PAUSE_S)
    return 1


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1]))
