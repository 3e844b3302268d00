"""Starts processes and waits for them, adopted orphans included."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any, Self

from rce_container.environment.nodes.fork_server import NodeForkServer
from rce_container.environment.process import OF_NODES, set_oom_score


class Child:
    """A process that was started here, in a session of its own."""

    def __init__(
        self, pid: int, ended: asyncio.Future[int], process: subprocess.Popen[bytes] | None = None
    ) -> None:
        self.pid = pid
        """The process id, which is also its group's and its session's."""
        self.ended = ended
        """The exit code; negative for a signal."""
        self._process = process

    def signal_group(self, number: signal.Signals) -> None:
        """Send a signal to all processes of its group."""
        try:
            os.killpg(self.pid, number)
        except (ProcessLookupError, PermissionError):
            return

    def finish(self, code: int) -> None:
        """Note the exit code that the reaper read."""
        if self._process is not None:
            self._process.returncode = code
        if not self.ended.done():
            self.ended.set_result(code)


class Reaper:
    """Waits for every child of this process, so that orphans which it adopts leave no zombies.

    Use as a context manager in the main thread, one per process, and start processes by :meth:`spawn` only:
    it collects the exit codes of all children, which then nothing else can read.

    Args:
        node_server: Starts the processes that it can; None for none.
    """

    def __init__(self, node_server: NodeForkServer | None = None) -> None:
        self._node_server = node_server
        self._children: dict[int, Child] = {}
        self._before: Any = None

    def __enter__(self) -> Self:
        # Not loop.add_signal_handler: uvloop keeps this signal for subprocesses of its own.
        loop = asyncio.get_running_loop()
        self._before = signal.signal(signal.SIGCHLD, lambda *_: loop.call_soon_threadsafe(self._reap))
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGCHLD, self._before)
        self._reap()

    def spawn(
        self, argv: Sequence[str], *, env: Mapping[str, str], cwd: str, stdout: int, stderr: int
    ) -> Child:
        """Start a process in a new session, with standard output and error to two descriptors.

        Raises:
            OSError: It cannot be started.
        """
        ended: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        if self._node_server is not None:
            pid = self._node_server.spawn(argv, env=env, cwd=cwd, stdout=stdout, stderr=stderr)
            if pid:
                return self._keep(Child(pid, ended))
        process = subprocess.Popen(  # noqa: S603 - runs the programs of users' packages
            argv,
            env=env,
            cwd=cwd,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
        )
        set_oom_score(OF_NODES, process.pid)
        return self._keep(Child(process.pid, ended, process))

    def spawn_attached(
        self,
        argv: Sequence[str],
        *,
        env: Mapping[str, str],
        cwd: str,
        streams: tuple[int, int, int],
        terminal: bool,
    ) -> Child:
        """Start a process in a new session with given standard input, output and error.

        Args:
            argv: The program and its arguments.
            env: All of its environment variables.
            cwd: Where it starts.
            streams: The descriptors.
            terminal: Whether the first of them becomes the session's terminal.

        Raises:
            OSError: It cannot be started.
        """
        ended: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        stdin, stdout, stderr = streams
        process = subprocess.Popen(  # noqa: S603 - a user's command in the user's own container
            argv,
            env=env,
            cwd=cwd,
            stdin=stdin,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
            preexec_fn=_take_terminal if terminal else None,  # noqa: PLW1509 - no other way; one system call
        )
        set_oom_score(OF_NODES, process.pid)
        return self._keep(Child(process.pid, ended, process))

    def _keep(self, child: Child) -> Child:
        self._children[child.pid] = child
        return child

    def _reap(self) -> None:
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if not pid:
                return
            child = self._children.pop(pid, None)
            if child is not None:
                child.finish(os.waitstatus_to_exitcode(status))


def _take_terminal() -> None:
    """Make standard input the terminal of this session."""
    import fcntl
    import termios

    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
