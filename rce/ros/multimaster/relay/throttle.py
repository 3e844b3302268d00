"""Which messages pass a throttle. Pure; the rules are those of topic_tools' ``throttle``."""

from __future__ import annotations

from collections import deque
from typing import Protocol


class Throttle(Protocol):
    """Decides on messages in the order in which they come."""

    def passes(self, now: float, size: int) -> bool:
        """Return whether a message of ``size`` bytes at ``now`` (seconds) is passed on."""


class Everything:
    """Passes every message."""

    def passes(self, now: float, size: int) -> bool:
        """Let it pass."""
        del now, size
        return True


class MessageThrottle:
    """At most ``hz`` messages per second: one passes when the last that did is ``1 / hz`` old."""

    def __init__(self, hz: float) -> None:
        if not hz > 0:
            raise ValueError(f"a rate must be above 0 Hz, not {hz:g}")
        self._period = 1 / hz
        self._last = float("-inf")

    def passes(self, now: float, size: int) -> bool:
        """Decide; a clock that is set back starts again."""
        del size
        if self._last <= now < self._last + self._period:
            return False
        self._last = now
        return True


class ByteThrottle:
    """At most ``bytes_per_second`` on average over a sliding ``window`` of seconds."""

    def __init__(self, bytes_per_second: float, window: float = 1.0) -> None:
        if not bytes_per_second > 0 or not window > 0:
            raise ValueError("bytes per second and window must be above 0")
        self._most = bytes_per_second * window
        self._window = window
        self._sent: deque[tuple[float, int]] = deque()
        self._total = 0

    def passes(self, now: float, size: int) -> bool:
        """Decide."""
        while self._sent and not now - self._window < self._sent[0][0] <= now:
            self._total -= self._sent.popleft()[1]
        if self._total + size > self._most:
            return False
        self._sent.append((now, size))
        self._total += size
        return True
