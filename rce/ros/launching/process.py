"""One node of a launch as a process: started, started again, ended with everything that it started."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rce.ros.launching.launched import LaunchedNode, StopTimeouts, describe_end
from rce.ros.node.settings import SHOW_WARNINGS
from rce.supervision.process import end_with

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.launch.plan import NodePlan
    from rce.ros.launching.command import NodeCommand

KILL_S = 5.0
"""How long the end of a killed process is waited for."""


class NodeProcess(LaunchedNode):
    """A node of a launch, in a process of its own.

    It is ended by SIGINT, then SIGTERM, then SIGKILL.

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
        super().__init__(plan, report, timeouts)
        self._command = command
        self._output = output

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
        command = self._command
        command.folder.mkdir(parents=True, exist_ok=True)
        if self._output is None:
            return await _spawn(command, None)
        self._output.parent.mkdir(parents=True, exist_ok=True)  # rosclean may have removed it
        with self._output.open("ab") as output:
            return await _spawn(command, output.fileno())

    async def _escalate(self, pid: int, ended: asyncio.Future[int]) -> None:
        steps = ((signal.SIGINT, self._timeouts.interrupt), (signal.SIGTERM, self._timeouts.terminate))
        for number, timeout in steps:
            _signal_group(pid, number)
            await self._wait(ended, timeout)
            if ended.done():
                return
            self._report(f"{self.plan.name}: did not end on {number.name}")
        _signal_group(pid, signal.SIGKILL)

    def _hint(self) -> str:
        return f"; its output is in {self._output}" if self._output is not None else ""


async def _spawn(command: NodeCommand, output: int | None) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *command.argv,
        env={SHOW_WARNINGS: "yes", **command.env},
        cwd=command.folder,
        stdout=output,
        start_new_session=True,  # a Ctrl-C at the terminal reaches the launcher only
        preexec_fn=partial(end_with, os.getpid()),
    )


def _signal_group(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, number)
