"""Starts the program anew in its own process, while its containers live on.

``SIGUSR1`` asks for it, which is what ``systemctl reload rce-container`` sends: the program lets go of its
containers, and executes itself as it is installed now, with the settings as they are now. Its pid stays, so
whatever supervises it does not notice; the new program adopts the containers.
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
    """Execute this program anew.

    Raises:
        OSError: Its file is gone.
    """
    signal.signal(RENEW, signal.SIG_IGN)  # until the new program listens for it, it would end by it
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - itself


@contextlib.contextmanager
def inherited_children() -> Iterator[None]:
    """Take the exit codes of the children that the program had before it was executed anew.

    To be entered before the program starts children of its own. Zombies would be left otherwise.
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
    """Return the children of this process, which has one thread yet."""
    pid = os.getpid()
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:  # a kernel without it: zombies stay until the program ends
        return []
