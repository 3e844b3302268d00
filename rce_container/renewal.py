"""Executes the program again in its own process, while its containers keep running.

``SIGUSR1`` requests it, which ``systemctl reload rce-container`` sends: the program releases its containers,
and executes itself as installed now, with the present settings. Its pid stays, so its supervisor does not
notice; the new program adopts the containers.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

RENEW = signal.SIGUSR1


def renew() -> NoReturn:
    """Execute this program again.

    Raises:
        OSError: Its file does not exist any more.
    """
    signal.signal(RENEW, signal.SIG_IGN)  # the signal would end the new program before it handles it
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - itself


@contextlib.contextmanager
def inherited_children() -> Iterator[None]:
    """Collect the exit codes of the children that the program had before it executed itself again.

    Enter this before the program starts its own children. It prevents zombies.
    """
    loop = asyncio.get_running_loop()
    waiting: dict[int, int] = {}

    def collect(pid: int) -> None:
        fd = waiting.pop(pid)
        loop.remove_reader(fd)
        os.close(fd)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, 0)

    for pid in _children():
        with contextlib.suppress(ProcessLookupError):
            fd = waiting[pid] = os.pidfd_open(pid)
            loop.add_reader(fd, collect, pid)
    try:
        yield
    finally:
        for fd in waiting.values():
            loop.remove_reader(fd)
            os.close(fd)


def _children() -> list[int]:
    """Return the children of this process, which still has only one thread."""
    pid = os.getpid()
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:  # not supported by this kernel: zombies stay until the program ends
        return []
