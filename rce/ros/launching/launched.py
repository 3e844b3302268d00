"""One node of a launch: started, started again when it ends, told to end."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.launch.plan import NodePlan

MIN_RESPAWN_S = 0.1
"""Least pause before a node is started again."""
RETRY_S = 1.0
"""Least pause after a node could not be started again."""


class StopTimeouts(NamedTuple):
    """How long a node may take to end, in seconds, as ``roslaunch`` has it."""

    interrupt: float = 15.0
    """After SIGINT."""
    terminate: float = 2.0
    """After SIGTERM, which comes next; then SIGKILL."""


class LaunchedNode(ABC):
    """A node of a launch; how it runs is for the classes below to say.

    Args:
        plan: The node.
        report: Takes lines about it.
        timeouts: How long it may take to end.
    """

    def __init__(self, plan: NodePlan, report: Callable[[str], None], timeouts: StopTimeouts) -> None:
        self.plan = plan
        self._report = report
        self._timeouts = timeouts
        self._stopping = asyncio.Event()
        self._hurrying = asyncio.Event()

    async def run(self) -> int:
        """Run the node until it ends for good; return its last exit code.

        Cancelling this ends the node at once, with everything that it started.

        Raises:
            OSError: It cannot be started for the first time.
        """
        code, has_run = 0, False
        while not self._stopping.is_set():
            pause = max(self.plan.respawn_delay, MIN_RESPAWN_S)
            try:
                code = await self._run_once()
                has_run = True
            except OSError as error:
                if not has_run:
                    raise
                pause = max(pause, RETRY_S)
                self._report(f"{self.plan.name}: {describe_failure(error)}; it is tried again in {pause:g} s")
            if not self.plan.respawn:
                break
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), pause)
        return code

    def stop(self) -> None:
        """End the node. :meth:`run` then returns."""
        self._stopping.set()

    def hurry(self) -> None:
        """Do not wait any longer for the node to end: take the next, harder measure."""
        self._hurrying.set()

    @abstractmethod
    async def _run_once(self) -> int:
        """Run the node until it ends, or ``_stopping`` is set; return its exit code."""

    async def _wait(self, ended: asyncio.Future[int], timeout: float) -> None:
        """Wait until the node has ended, or is told to hurry, or for ``timeout`` seconds."""
        hurrying = asyncio.ensure_future(self._hurrying.wait())
        await asyncio.wait((ended, hurrying), timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
        hurrying.cancel()
        self._hurrying.clear()


def describe_failure(error: OSError) -> str:
    """Return why a process cannot be started, in words."""
    where = f": {error.filename}" if error.filename is not None else ""
    return f"cannot be started: {error.strerror or error}{where}"


def describe_end(code: int) -> str:
    """Return how a process ended, in words."""
    if code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:  # a real-time signal has no name
            return f"was ended by signal {-code}"
    return f"ended with exit code {code}" if code else "ended"
