"""One node of a launch inside the launcher's own process, beside others: as ROS's nodelets.

Messages between such nodes are handed over as objects, without sockets, and the interpreter and its libraries
are loaded once. A node that computes for long delays the others, and an error of the interpreter ends all.
"""

from __future__ import annotations

import asyncio
import importlib
import logging
from typing import TYPE_CHECKING

from rce.aio.tasks import pass_cancellation
from rce.ros.launching.launched import LaunchedNode, StopTimeouts, describe_end
from rce.ros.node.hosting import HostedProgram

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.launch.plan import NodePlan
    from rce.ros.launching.command import NodeCommand

MAIN = "main"
"""Name of the coroutine function of a node's module."""
FAILED = 1

_log = logging.getLogger(__name__)


def can_host(plan: NodePlan, command: NodeCommand) -> bool:
    """Return whether a node can run in this process: a module with ``main``, and no prefix to its command."""
    return bool(command.module) and not plan.prefix


class HostedNode(LaunchedNode):
    """A node of a launch, in this process.

    It is ended by telling it to stop, then by cancelling it.

    Args:
        plan: The node.
        command: How to start it; names its module.
        report: Takes lines about it.
        timeouts: How long it may take to end.
    """

    def __init__(
        self,
        plan: NodePlan,
        command: NodeCommand,
        report: Callable[[str], None],
        timeouts: StopTimeouts,
    ) -> None:
        super().__init__(plan, report, timeouts)
        self._command = command

    async def _run_once(self) -> int:
        command, name = self._command, self.plan.name
        program = HostedProgram(command.arguments, command.env)
        ended = program.start(self._main())
        self._report(f"{name}: started in this process")
        stopping = asyncio.ensure_future(self._stopping.wait())
        try:
            await asyncio.wait((ended, stopping), return_when=asyncio.FIRST_COMPLETED)
            if ended.done():
                self._report(f"{name}: {describe_end(ended.result())}")
            else:
                program.stop("the launch ends")
                await self._wait(ended, self._timeouts.interrupt)
            return ended.result() if ended.done() and not ended.cancelled() else 0
        finally:
            stopping.cancel()
            program.cancel()
            await asyncio.wait((ended,))

    async def _main(self) -> int:
        """Run the module's coroutine; return what the exit code of a process of its own would be."""
        try:
            result = await getattr(importlib.import_module(self._command.module), MAIN)()
        except SystemExit as error:  # as of argparse
            if isinstance(error.code, str):
                self._report(f"{self.plan.name}: {error.code}")
                return FAILED
            result = error.code
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - the others run on
            pass_cancellation(error)
            _log.exception("%s failed", self.plan.name)
            return FAILED
        return result if isinstance(result, int) else 0
