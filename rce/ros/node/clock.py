"""ROS time: the machine's clock or, if the parameter ``/use_sim_time`` is true, the topic ``/clock``.

Simulated time is zero until the first tick: what sleeps until then sleeps from that tick on. It may run at
any speed, stand still, and jump back when a simulation or a bag begins again.
"""

from __future__ import annotations

import asyncio
import heapq
import logging
import struct
import time
from itertools import count

from rce.ros.node.runtime import TypeName

_log = logging.getLogger(__name__)

TOPIC = "/clock"
CLOCK = TypeName("rosgraph_msgs/Clock", "a9c97c1d230cfc112e270351a944ee47")
PARAMETER = "/use_sim_time"

_STAMP = struct.Struct("<II")
NANOSECONDS = 1_000_000_000


class Clock:
    """The clock of one node.

    Attributes:
        simulated: Whether time comes from ``/clock``.
        begun: Nanoseconds by which what was planned at time zero is later: the time of the first tick.
    """

    def __init__(self) -> None:
        self.simulated = False
        self.begun = 0
        self._now = 0  # simulated time in nanoseconds
        self._sleepers: list[tuple[int, int, asyncio.Future[None]]] = []
        self._order = count()
        self._stop = asyncio.Event()

    def nanoseconds(self) -> int:
        """Return the time now, in nanoseconds since the epoch."""
        return self._now if self.simulated else time.time_ns()

    def tick(self, payload: bytes, _latched: bool) -> None:
        """Take a serialized ``rosgraph_msgs/Clock``."""
        if len(payload) != _STAMP.size:
            _log.warning("%s: a message of %d bytes is not a clock", TOPIC, len(payload))
            return
        secs, nsecs = _STAMP.unpack(payload)
        now = secs * NANOSECONDS + nsecs
        if not self._now:
            self._begin(now)
        went_back, self._now = now < self._now, now
        while self._sleepers and (went_back or self._sleepers[0][0] <= now):
            _wake(heapq.heappop(self._sleepers)[2])

    def _begin(self, now: int) -> None:
        """Postpone what was planned at time zero, as roscpp and rospy do."""
        self.begun += now
        self._sleepers = [(deadline + now, order, woken) for deadline, order, woken in self._sleepers]

    def end(self) -> None:
        """Wake all sleepers, now and later: the node stops."""
        self._stop.set()
        while self._sleepers:
            _wake(self._sleepers.pop()[2])

    async def sleep_until(self, deadline: int) -> bool:
        """Sleep until a time in nanoseconds, until simulated time jumps back, or until the node stops.

        Returns:
            Whether the node continues.
        """
        if self._stop.is_set():
            return False
        if not self.simulated:
            return await self._sleep(max(0, deadline - time.time_ns()) / NANOSECONDS)
        if deadline <= self._now:
            await asyncio.sleep(0)
        else:
            woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            heapq.heappush(self._sleepers, (deadline, next(self._order), woken))
            await woken
        return not self._stop.is_set()

    async def _sleep(self, seconds: float) -> bool:
        try:
            async with asyncio.timeout(seconds):
                await self._stop.wait()
        except TimeoutError:
            return True
        return False


def _wake(sleeper: asyncio.Future[None]) -> None:
    if not sleeper.done():  # it may have been cancelled
        sleeper.set_result(None)
