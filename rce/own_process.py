"""This process: the signals that end it, its streams, ports, limit of open files, time, memory and garbage.

The kernel is asked directly: a library for it would cost each task set 4 MB.
"""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import os
import resource
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterator

_ENOUGH = 1 << 20
_log = logging.getLogger(__name__)


_COLLECTIONS_UNTIL_FULL = 100
"""Python's default is 10, where the number of objects has grown by a quarter since the last full one."""

_STATM = Path("/proc/self/statm")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def end_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that tell this program to end: Ctrl-C, SIGTERM, and a terminal that is closed.

    SIGHUP counts only if it is not ignored, as it is for programs that ``nohup`` starts.
    """
    ends = (signal.SIGINT, signal.SIGTERM)
    return ends if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (*ends, signal.SIGHUP)


class EndSignals:
    """Cancels the task of a program at the first signal that tells it to end.

    Args:
        task: The task.
        again: Called at each later signal: a second cancellation would interrupt the end of the program.

    Attributes:
        came: Whether a signal has come. The task itself cannot be asked: it also says that it is being
            cancelled while a timeout in it ends, and goes on after that.
    """

    def __init__(self, task: asyncio.Task[Any], again: Callable[[], object] = lambda: None) -> None:
        self.came = False
        self._task = task
        self._again = again

    def handle(self) -> None:
        """Take the signals from now on."""
        loop = self._task.get_loop()
        for number in end_signals():
            loop.add_signal_handler(number, self.take)

    def take(self) -> None:
        """Do what a signal asks for."""
        if self.came:
            self._again()
        else:
            self.came = True
            self._task.cancel()


def open_missing_streams() -> None:
    """Open closed standard streams (``rce up <&-``) on the null device.

    Otherwise the next file or socket takes their number, and what writes to the stream writes to it.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:  # noqa: PLR2004 - standard error
        os.set_inheritable(fd, True)
    os.close(fd)


def escape_missing_letters() -> None:
    """Have standard output escape the letters that the encoding of its locale lacks, as standard error does.

    Names of robots and containers may be in any language; printing one that is not would end the program.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def raise_file_limit() -> int:
    """Raise the limit of open files to the most that the system allows this user, also for child processes.

    The usual soft limit of 1024 is there for old programs; a server needs a socket for each of its clients.

    Returns:
        The new limit.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < _ENOUGH:
        with contextlib.suppress(OSError, ValueError):  # only root may raise it
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, _ENOUGH))
            hard = _ENOUGH
    wanted = _ENOUGH if hard == resource.RLIM_INFINITY else min(hard, _ENOUGH)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (OSError, ValueError) as error:
        _log.info("this process can have only %d files open: %s", soft, error)
        return soft
    return wanted


@contextlib.contextmanager
def listening(host: str, port: int | None, option: str) -> Iterator[None]:
    """Name the address and the option in the error of a port that cannot be bound.

    Args:
        host: The address; empty for all.
        port: The port; None for the default one.
        option: The program's option that sets the port.

    Raises:
        OSError: The port cannot be bound; its text is for the program's user.
    """
    try:
        yield
    except OSError as error:
        known = error.errno is not None and error.errno > 0  # name lookups have negative numbers
        reason = os.strerror(error.errno or 0) if known else error.strerror or str(error)
        place = f"{host or 'all addresses'}, port {'(default)' if port is None else port}"
        raise OSError(
            f"cannot listen on {place}: {reason}; choose another with --bind or {option}, or end the program"
            " that has it"
        ) from error


def cpu_seconds() -> float:
    """Return the processor time that all threads of this process have used."""
    return time.process_time()


def resident_bytes() -> int:
    """Return how much memory of this process is resident; 0 where there is no ``/proc``."""
    try:
        return int(_STATM.read_text().split()[1]) * _PAGE_BYTES
    except FileNotFoundError:
        return 0


def machine_memory() -> int:
    """Return the size of this machine's memory in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * _PAGE_BYTES


def collect_all_seldom() -> None:
    """Let the garbage collector look at all objects less often; new ones are looked at as before.

    For programs that make many objects which stay, such as thousands of topics: each time takes some tenths
    of a second there, in which the event loop is held, and finds nothing.
    """
    newest, newer, _ = gc.get_threshold()
    gc.set_threshold(newest, newer, _COLLECTIONS_UNTIL_FULL)
