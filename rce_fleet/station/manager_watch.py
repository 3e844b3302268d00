"""Whether a fleet manager answers: asked from time to time, so that pages know what they can show."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress

from rce_fleet.station.planner_client import PlannerUnavailableError

ASK_EVERY_S = 3.0
ASK_EARLY_S = 0.5
"""The same while the manager may not have begun yet."""
START_S = 30.0
"""How long a configured manager may take to begin, after the first request that needs it."""
LOOK_WAIT_S = 12.0
"""How long a request waits until it is known whether a manager answers."""
COMES_WAIT_S = 5.0
"""How long a request waits for a manager that has not begun yet."""


def _ignore(here: bool) -> None:
    del here


def _always() -> bool:
    return True


class ManagerWatch:
    """Asks the manager, and tells when it comes or goes.

    Args:
        ask: Asks the manager something small; raises :class:`PlannerUnavailableError` if it does not answer.
        can_ask: Whether requests can reach a manager now, if there is one.

    Attributes:
        here: Whether it answered last time; None before the first request.
        on_change: Called when this changed.
    """

    def __init__(self, ask: Callable[[], Awaitable[object]], can_ask: Callable[[], bool] = _always) -> None:
        self._ask = ask
        self._can_ask = can_ask
        self._looked = asyncio.Event()
        """A request to a manager was answered, or would have been."""
        self._came = asyncio.Event()
        self._waiting = asyncio.Event()
        self._start_ends: float | None = None
        self.here: bool | None = None
        self.on_change: Callable[[bool], None] = _ignore

    @property
    def was_here(self) -> bool:
        """Whether it has ever answered."""
        return self._came.is_set()

    async def looked(self) -> None:
        """Wait until it is known whether a manager answers."""
        if self._can_ask() and not self._looked.is_set():
            self._waiting.set()
            with suppress(TimeoutError):
                async with asyncio.timeout(LOOK_WAIT_S):
                    await self._looked.wait()

    async def comes(self) -> bool:
        """Wait some seconds for a manager that may still begin.

        Returns:
            False if it did not come in this time. True if it came, and also once it had enough time to begin:
            the fleet is then driven without it.
        """
        now = asyncio.get_running_loop().time()
        if self._start_ends is None:
            self._start_ends = now + START_S
        if not self.was_here and now < self._start_ends:
            self._waiting.set()
            with suppress(TimeoutError):
                async with asyncio.timeout(COMES_WAIT_S):
                    await self._came.wait()
            return self.was_here
        return True

    async def run(self) -> None:
        """Ask until cancelled; more often while requests wait for a manager that begins."""
        while True:
            await self.look()
            await asyncio.sleep(ASK_EARLY_S)
            with suppress(TimeoutError):
                async with asyncio.timeout(ASK_EVERY_S - ASK_EARLY_S):
                    await self._waiting.wait()
            self._waiting.clear()

    async def look(self) -> None:
        """Ask once."""
        can_ask = self._can_ask()
        try:
            await self._ask()
        except PlannerUnavailableError:
            here = False
        else:
            here = True
            self._came.set()
        if can_ask or here:
            self._looked.set()
        if here is not self.here:
            self.here = here
            self.on_change(here)
