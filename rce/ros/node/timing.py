"""Rates and timers in ROS time: :class:`Rate` in the program's own loop, :class:`Timer` beside it."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import NamedTuple

from rce.aio.tasks import TaskScope, pass_cancellation
from rce.ros.node.clock import NANOSECONDS, Clock

_log = logging.getLogger(__name__)


class Rate:
    """Keeps a loop at a rate. Made by :meth:`rce.ros.node.Node.rate`.

    ``async for _ in node.rate(10): ...`` or ``while await rate.sleep(): ...``; both end with the node. Time
    that the loop's body takes does not shift the beat; a beat that is missed altogether is left out.
    """

    def __init__(self, clock: Clock, hz: float) -> None:
        if hz <= 0:
            raise ValueError(f"a rate is positive, not {hz}")
        self.period = 1.0 / hz
        """Seconds."""
        self._clock = clock
        self._step = round(NANOSECONDS / hz)
        self._last = clock.nanoseconds()
        self._begun = clock.begun

    @property
    def due(self) -> int:
        """When the next beat is, in nanoseconds of ROS time."""
        self._postpone()
        return self._last + self._step

    @property
    def remaining(self) -> float:
        """Seconds until the next beat; negative if it was missed."""
        return (self.due - self._clock.nanoseconds()) / NANOSECONDS

    async def sleep(self) -> bool:
        """Sleep until the next beat.

        Returns:
            Whether the node continues.
        """
        self._postpone()
        self._last = min(self._last, self._clock.nanoseconds())  # time may have jumped back
        goes_on = await self._clock.sleep_until(self._last + self._step)
        self._postpone()
        self._last += self._step
        now = self._clock.nanoseconds()
        if not self._last <= now <= self._last + self._step:
            self._last = now
        return goes_on

    def _postpone(self) -> None:
        """Count from the first tick of simulated time if the beat was planned before it."""
        self._last += self._clock.begun - self._begun
        self._begun = self._clock.begun

    async def __aiter__(self) -> AsyncIterator[int]:
        """Count the beats, the first at once."""
        beat = 0
        while True:
            yield beat
            beat += 1
            if not await self.sleep():
                return


class TimerEvent(NamedTuple):
    """The argument of a timer's callback; all times in seconds."""

    expected: float
    """When the call was due, in ROS time."""
    now: float
    """When it is made."""
    last: float | None
    """When the call before was made."""


TimerCallback = Callable[[TimerEvent], Awaitable[None] | None]


class Timer:
    """Calls a function at a rate. Made by :meth:`rce.ros.node.Node.timer`; runs until the node stops.

    A coroutine function is awaited before the next call; calls that are missed meanwhile are left out. What
    it raises is logged. When simulated time jumps back, the next call is a period later.
    """

    def __init__(
        self, clock: Clock, period: float, callback: TimerCallback, tasks: TaskScope, *, oneshot: bool
    ) -> None:
        if period <= 0:
            raise ValueError(f"a timer's period is positive, not {period}")
        self.calls = 0
        """How many calls were made."""
        self._clock = clock
        self._rate = Rate(clock, 1.0 / period)
        self._callback = callback
        self._oneshot = oneshot
        self._task: asyncio.Task[None] = tasks.spawn(self._run(), name="timer")

    def stop(self) -> None:
        """Make no more calls; one that is being made is cancelled."""
        self._task.cancel()

    async def _run(self) -> None:
        last: float | None = None
        due, begun = self._rate.due, self._clock.begun
        while await self._rate.sleep():
            due += self._clock.begun - begun
            jumped_back = self._clock.simulated and self._clock.nanoseconds() < due
            if not jumped_back:
                now = self._clock.nanoseconds() / NANOSECONDS
                await self._call(TimerEvent(due / NANOSECONDS, now, last))
                if self._oneshot:
                    return
                last = now
            due, begun = self._rate.due, self._clock.begun

    async def _call(self, event: TimerEvent) -> None:
        self.calls += 1
        try:
            result = self._callback(event)
            if inspect.isawaitable(result):
                await result
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - the program's own
            pass_cancellation(error)
            _log.exception("the callback of a timer failed")
