"""A limit in bytes per second for all links of one endpoint, both directions together.

:class:`Bucket` is the rule (sans-I/O); :class:`Pacer` is the thin shell that wakes waiting senders. One part
of a message may overdraw the bucket; the next part waits until the debt is paid. So a message of any size
passes, and the mean rate holds.

Small messages need not wait behind large ones: they may use up to half the rate, from a second bucket. Their
bytes are taken from the first bucket too, so that the sum stays within the limit and bulk keeps at least the
other half.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rce.link.frames import FRAGMENT_SIZE
from rce.link.settings import KIB, MIB

if TYPE_CHECKING:
    from collections.abc import Callable

MIN_RATE = 4 * KIB
"""Bytes per second. A lower limit counts as this one: heartbeats of a link would not pass."""

_BURST_S = 0.05
"""After a rest so many seconds' worth passes at once, within the bounds that follow."""
_MIN_BURST = 8 * KIB
_MAX_BURST = 4 * MIB
_MIN_WAIT = 0.001
"""Seconds; event loops do not count finer."""


class Bucket:
    """Bytes that may be moved: it fills up steadily, to ``burst`` at most, and may be overdrawn.

    Args:
        rate: Bytes per second that come in.
        burst: Bytes that it holds; it begins full.
        now: Seconds on the caller's clock.
    """

    def __init__(self, rate: float, burst: float, now: float) -> None:
        self._rate = rate
        self._burst = burst
        self._level = burst
        self._since = now

    def spend(self, size: int, now: float) -> None:
        """Take ``size`` bytes out, whether they are in it or not."""
        self._level = self._level_at(now) - size
        self._since = now

    def pause(self, now: float) -> float:
        """Return the seconds until it holds a byte at least; 0 if it does."""
        return max(0.0, (1.0 - self._level_at(now)) / self._rate)

    def _level_at(self, now: float) -> float:
        return min(self._burst, self._level + (now - self._since) * self._rate)


class Pacer:
    """Passes the bytes of one endpoint in turn, at the rate that is set.

    Args:
        rate: Bytes per second; above 0.
        loop: Its clock and timers are used; none is the running one.

    Attributes:
        burst: Bytes that pass at once after a rest.
        part: Largest part of a message to be moved in one turn, in bytes.
    """

    def __init__(self, rate: int, *, loop: asyncio.AbstractEventLoop | None = None) -> None:
        self._loop = loop or asyncio.get_running_loop()
        self._waiting: dict[Callable[[], None], bool] = {}
        """The callbacks to call, in turn, and whether each is for urgent messages."""
        self._serving = False
        self._timer: asyncio.TimerHandle | None = None
        self.change(rate)

    def change(self, rate: int) -> None:
        """Set another rate, which counts at once."""
        now = self._loop.time()
        rate = max(rate, MIN_RATE)
        self.burst = int(min(max(rate * _BURST_S, _MIN_BURST), _MAX_BURST))
        self.part = min(self.burst, FRAGMENT_SIZE)
        self._all = Bucket(rate, self.burst, now)
        self._ahead = Bucket(rate / 2, self.burst, now)
        self._arm()

    def ask(self, go: Callable[[], None], *, urgent: bool) -> bool:
        """Return whether a part may pass now; if not, ``go`` is called when it is its turn to ask again."""
        if self._pause(urgent=urgent) <= 0 and (urgent or self._serving or not self._waiting):
            return True
        self._waiting[go] = urgent or self._waiting.get(go, False)
        self._arm()
        return False

    def spend(self, size: int, *, urgent: bool) -> None:
        """Count bytes that pass."""
        now = self._loop.time()
        self._all.spend(size, now)
        if urgent:
            self._ahead.spend(size, now)

    def forget(self, go: Callable[[], None]) -> None:
        """Cancel a callback."""
        self._waiting.pop(go, None)

    def close(self) -> None:
        """Cancel all callbacks."""
        self._waiting.clear()
        self._arm()

    def _pause(self, *, urgent: bool) -> float:
        now = self._loop.time()
        pause = self._all.pause(now)
        return min(pause, self._ahead.pause(now)) if urgent else pause

    def _arm(self) -> None:
        """Set the timer for when the first waiting callback may ask again."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._waiting and not self._serving:
            pause = self._pause(urgent=any(self._waiting.values()))
            self._timer = self._loop.call_later(max(pause, _MIN_WAIT), self._serve)

    def _serve(self) -> None:
        self._timer = None
        self._serving = True
        try:
            for go, urgent in list(self._waiting.items()):
                if self._pause(urgent=urgent) <= 0 and self._waiting.pop(go, None) is not None:
                    go()
        finally:
            self._serving = False
            self._arm()
