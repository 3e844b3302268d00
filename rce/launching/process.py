"""One node of a launch as a process: started, started again, ended with everything that it started."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rce.supervision.process import end_with

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.launching.command import NodeCommand
    from rce.ros.launch.plan import NodePlan

MIN_RESPAWN_S = 0.1
"""Least pause before a node is started again."""

KILL_S = 5.0
"""How long the end of a killed process is waited for."""


class StopTimeouts(NamedTuple):
    """How long a node may take to end, in seconds, as ``roslaunch`` has it."""

    interrupt: float = 15.0
    """After SIGINT."""
    terminate: float = 2.0
    """After SIGTERM, which comes next; then SIGKILL."""


class NodeProcess:
    """A node of a launch.

    Args:
        plan: The node.
        command: How to start it.
        output: File of its standard output; None: the launcher's own.
        report: Takes lines about it.
        timeouts: How long it may take to end.
    """

    def __init__(
        self,
        plan: NodePlan,
        command: NodeCommand,
        output: Path | None,
        report: Callable[[str], None],
        timeouts: StopTimeouts,
    ) -> None:
        self.plan = plan
        self._command = command
        self._output = output
        self._report = report
        self._timeouts = timeouts
        self._stopping = asyncio.Event()
        self._hurrying = asyncio.Event()

    async def run(self) -> int:
        """Run the node until it ends for good; return its last exit code.

        Cancelling this kills the node and everything that it started.

        Raises:
            OSError: It cannot be started.
        """
        while True:
            code = await self._run_once()
            if self._stopping.is_set() or not self.plan.respawn:
                return code
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(self.plan.respawn_delay, MIN_RESPAWN_S)):
                    await self._stopping.wait()
                return code

    def stop(self) -> None:
        """End the node: SIGINT, then SIGTERM, then SIGKILL. :meth:`run` then returns."""
        self._stopping.set()

    def hurry(self) -> None:
        """Do not wait any longer for the node to end: go to the next signal."""
        self._hurrying.set()

    async def _run_once(self) -> int:
        process = await self._start()
        name = self.plan.name
        self._report(f"{name}: started with pid {process.pid}")
        ended = asyncio.ensure_future(process.wait())
        stopping = asyncio.ensure_future(self._stopping.wait())
        try:
            await asyncio.wait((ended, stopping), return_when=asyncio.FIRST_COMPLETED)
            if ended.done():
                self._report(f"{name}: {describe_end(ended.result())}" + self._hint())
            else:
                await self._escalate(process.pid, ended)
            return await ended
        finally:
            stopping.cancel()
            _signal_group(process.pid, signal.SIGKILL)  # what it has started and left behind
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(ended), KILL_S)

    async def _start(self) -> asyncio.subprocess.Process:
        argv, env, folder, _ = self._command
        folder.mkdir(parents=True, exist_ok=True)
        if self._output is None:
            return await _spawn(argv, env, folder, None)
        with self._output.open("ab") as output:
            return await _spawn(argv, env, folder, output.fileno())

    async def _escalate(self, pid: int, ended: asyncio.Future[int]) -> None:
        steps = ((signal.SIGINT, self._timeouts.interrupt), (signal.SIGTERM, self._timeouts.terminate))
        for number, timeout in steps:
            _signal_group(pid, number)
            hurrying = asyncio.ensure_future(self._hurrying.wait())
            await asyncio.wait((ended, hurrying), timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
            hurrying.cancel()
            self._hurrying.clear()
            if ended.done():
                return
            self._report(f"{self.plan.name}: did not end on {number.name}")
        _signal_group(pid, signal.SIGKILL)

    def _hint(self) -> str:
        return f"; its output is in {self._output}" if self._output is not None else ""


async def _spawn(
    argv: list[str], env: dict[str, str], folder: Path, output: int | None
) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *argv,
        env=env,
        cwd=folder,
        stdout=output,
        start_new_session=True,  # a Ctrl-C at the terminal reaches the launcher only
        preexec_fn=partial(end_with, os.getpid()),
    )


def _signal_group(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, number)


def describe_end(code: int) -> str:
    """Return how a process ended, in words."""
    if code < 0:
        return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}" if code else "ended"
