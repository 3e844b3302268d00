"""Programs as forks of their supervisor, made before it does anything else.

The supervisor loads the modules that its programs share, and forks them: unchanged memory is shared. Each
fork waits until it is told to begin, and then behaves like ``python -P -m MODULE ARGUMENT ...``. Later
restarts execute the program: a running supervisor has an event loop, which must not be forked.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import sys
import threading
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from rce.own_process import end_signals
from rce.supervision.process import MAX_LINE, VARIABLES, end_with
from rce.supervision.title import set_title

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rce.supervision.plan import Program

_READY = b"\n"
_GO = b"g"


@dataclass(frozen=True, slots=True)
class Prepared:
    """A fork that waits to become its program. It ends if the pipe closes first."""

    pid: int
    go: int
    """Descriptor: at a byte it begins, at the end of the pipe it ends."""
    output: int
    """Descriptor: its output."""

    def drop(self) -> None:
        """End it before it has begun. Blocks for a moment."""
        os.close(self.output)
        self.withdraw()

    def withdraw(self) -> None:
        """End it before it has begun; its output belongs to another owner. Blocks for a moment."""
        os.close(self.go)
        os.waitpid(self.pid, 0)


def prepare(programs: Iterable[Program], shared: Iterable[str]) -> Mapping[str, Prepared]:
    """Fork the programs that are Python modules. In the forks, run them once they are told to begin.

    Must be called before there is an event loop or a thread.

    Args:
        programs: Those to run.
        shared: Modules that they load; they are loaded here, once for all.

    Returns:
        The forks by the names of their programs; empty where forks are not possible.

    Raises:
        SystemExit: In a fork: its program has ended.
    """
    forkable = [program for program in programs if program.module]
    if not forkable or not _has_streams() or not _can_watch():
        return {}
    for module in shared:
        import_module(module)
    if threading.active_count() > 1:  # a fork would have the threads' locks, but not the threads
        return {}
    gc.collect()
    gc.freeze()  # the garbage collector would write to, and so copy, the shared memory
    sys.stdout.flush()
    sys.stderr.flush()
    return {program.name: _fork(program) for program in forkable}


def _has_streams() -> bool:
    """Return whether the descriptors 0 to 2 are taken, so that no pipe gets their numbers."""
    return None not in (sys.stdin, sys.stdout, sys.stderr)


def _can_watch() -> bool:
    try:
        os.close(os.pidfd_open(os.getpid()))
    except (AttributeError, OSError):
        return False
    return True


def _fork(program: Program) -> Prepared:
    parent = os.getpid()
    wait, go = os.pipe()
    output, print_ = os.pipe()
    pid = os.fork()
    if pid == 0:
        _become(program, parent, wait, print_)
    os.close(wait)
    os.close(print_)
    os.read(output, len(_READY))  # from now on it has a session of its own, and ends with this process
    return Prepared(pid, go, output)


def _become(program: Program, parent: int, wait: int, print_: int) -> NoReturn:
    os.setsid()
    end_with(parent)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, end_signals())
    nothing = os.open(os.devnull, os.O_RDONLY)
    for fd, number in ((nothing, 0), (print_, 1), (print_, 2)):
        os.dup2(fd, number)
    os.closerange(3, wait)
    os.closerange(wait + 1, os.sysconf("SC_OPEN_MAX"))
    set_title(program.argv, Path(sys.executable).name)
    os.write(1, _READY)
    if os.read(wait, len(_GO)) != _GO:
        os._exit(0)
    os.close(wait)
    os.environ.update({**VARIABLES, **program.env})
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True, write_through=True)  # type: ignore[union-attr]  # as they are
    sys.argv = [program.module, *program.arguments]
    sys.orig_argv = list(program.argv)  # with these a program executes itself again
    import_module(f"{program.module}.__main__").main()
    raise SystemExit(0)


class ForkedProcess:
    """A fork that runs its program, with the interface of :class:`asyncio.subprocess.Process`."""

    def __init__(self, pid: int, stdout: asyncio.StreamReader) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self.stdout = stdout
        self._ended: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._watch = os.pidfd_open(pid)
        asyncio.get_running_loop().add_reader(self._watch, self._on_end)

    @classmethod
    async def begin(cls, prepared: Prepared) -> ForkedProcess:
        """Tell a fork to become its program."""
        stdout = asyncio.StreamReader(limit=MAX_LINE)
        pipe = os.fdopen(prepared.output, "rb", 0)
        try:
            await asyncio.get_running_loop().connect_read_pipe(
                lambda: asyncio.StreamReaderProtocol(stdout), pipe
            )
        except BaseException:
            with contextlib.suppress(OSError):  # uvloop has closed it if this is cancelled
                pipe.close()
            prepared.withdraw()
            raise
        process = cls(prepared.pid, stdout)
        with contextlib.suppress(BrokenPipeError):  # it was killed; its end is noticed as for all processes
            os.write(prepared.go, _GO)
        os.close(prepared.go)
        return process

    async def wait(self) -> int:
        """Wait for its end; return the exit code, that of a killed one as the signal's negative number."""
        return await asyncio.shield(self._ended)

    def _on_end(self) -> None:
        asyncio.get_running_loop().remove_reader(self._watch)
        os.close(self._watch)
        _, status = os.waitpid(self.pid, 0)
        self.returncode = os.waitstatus_to_exitcode(status)
        self._ended.set_result(self.returncode)
