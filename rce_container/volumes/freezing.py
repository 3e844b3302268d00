"""Stops all processes of a container for a moment, so that its files are copied as they are at one time.

A copy of that moment is what a kill -9 would have left: a database that survives a kill -9, as SQLite does,
reads it as it reads its own files then. All functions block.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rce.control import SnapshotError

_STOP_S = 5.0
"""How long processes may take to stop: one that waits for a disk stops when it has read or written."""
_PAUSE_S = 0.001
_END_S = 10.0
_STOPPED = frozenset("TtZX")
_CONTINUE = 'p=; while read -r x; do p="$p $x"; done; test -z "$p" || kill -CONT $p'
"""Reads pids until its input ends, however that ends, and continues them."""


@contextlib.contextmanager
def frozen(list_pids: Callable[[], Iterable[int]]) -> Iterator[None]:
    """Stop processes, and continue them at the end of the block.

    A program beside this one continues them if this one is killed meanwhile.

    Args:
        list_pids: Returns all of them; they may make more while they are being stopped.

    Raises:
        SnapshotError: One does not stop in time. All continue then.
    """
    stopped: set[int] = set()
    keeper = subprocess.Popen(  # noqa: S602 - a constant
        _CONTINUE,
        shell=True,
        executable="/bin/sh",
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert keeper.stdin is not None
    try:
        deadline = time.monotonic() + _STOP_S
        while _stop(set(list_pids()) - stopped, stopped, keeper.stdin.fileno()) or not _have_stopped(stopped):
            if time.monotonic() > deadline:
                raise SnapshotError("its container cannot be stopped for a moment: a process does not stop")
            time.sleep(_PAUSE_S)
        yield
    finally:
        for pid in stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        keeper.stdin.close()
        try:
            keeper.wait(_END_S)
        except subprocess.TimeoutExpired:
            keeper.kill()
            keeper.wait()


def _stop(pids: set[int], stopped: set[int], keeper: int) -> bool:
    """Stop processes; return whether there were any."""
    for pid in pids:
        os.write(keeper, b"%d\n" % pid)
        stopped.add(pid)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
    return bool(pids)


def _have_stopped(pids: Iterable[int]) -> bool:
    return all(state in _STOPPED for pid in pids for state in _states(pid))


def _states(pid: int) -> Iterator[str]:
    """Iterate over the states of a process's threads."""
    with contextlib.suppress(OSError):  # it has ended
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                text = (thread / "stat").read_text(errors="replace")
                yield text[text.rindex(")") + 2]
