"""Rate limits: a token bucket for each key, and a log line for each address per interval.

Pure: the time is an argument.
"""

from __future__ import annotations

from collections import OrderedDict

MOST_KEYS = 16_384


EVERY_S = 10.0
"""Seconds between two log lines about an address."""
_MOST = 1024
"""Addresses that are remembered."""


class Rates:
    """Token buckets by key. Each holds ``burst`` tokens at most, and gains ``per_second`` of them.

    Args:
        per_second: Tokens that a bucket gains each second.
        burst: Tokens in a full bucket.
        most_keys: Buckets that are kept; beyond it, the one that was used longest ago is full again.

    Example:
        >>> rates = Rates(per_second=2, burst=1)
        >>> rates.take("anna", now=0.0)
        0.0
        >>> rates.take("anna", now=0.0)
        0.5
    """

    def __init__(self, *, per_second: float, burst: float, most_keys: int = MOST_KEYS) -> None:
        if per_second <= 0 or burst < 1:
            raise ValueError("a bucket must gain tokens, and hold at least one")
        self.per_second = per_second
        self.burst = burst
        self._most_keys = most_keys
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """Tokens, and when they were counted."""

    def __len__(self) -> int:
        return len(self._buckets)

    def take(self, key: str, now: float, cost: float = 1.0) -> float:
        """Take tokens, if there are enough.

        What costs more than a full bucket needs a full one, and leaves it below zero.

        Args:
            key: Whose bucket.
            now: Seconds of a clock that never goes back.
            cost: How many tokens.

        Returns:
            0 if they were taken; else the seconds until there are enough.
        """
        tokens = self._tokens(key, now)
        lacking = min(cost, self.burst) - tokens
        if lacking > 1e-9:  # noqa: PLR2004 - rounding error of added seconds
            self._put(key, tokens, now)
            return lacking / self.per_second
        self._put(key, tokens - cost, now)
        return 0.0

    def reserve(self, key: str, now: float) -> float:
        """Take a token that may yet have to be gained; return the seconds until it is."""
        tokens = self._tokens(key, now) - 1
        self._put(key, tokens, now)
        return max(0.0, -tokens / self.per_second)

    def give_back(self, key: str, now: float) -> None:
        """Put a token back that was taken or reserved."""
        self._put(key, min(self.burst, self._tokens(key, now) + 1), now)

    def _tokens(self, key: str, now: float) -> float:
        tokens, counted = self._buckets.get(key, (self.burst, now))
        return min(self.burst, tokens + max(0.0, now - counted) * self.per_second)

    def _put(self, key: str, tokens: float, now: float) -> None:
        if tokens >= self.burst:
            self._buckets.pop(key, None)
            return
        self._buckets[key] = tokens, now
        self._buckets.move_to_end(key)
        if len(self._buckets) > self._most_keys:
            self._buckets.popitem(last=False)


class LogThrottle:
    """Limits how often a warning about an address is logged."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}

    def is_due(self, address: str, now: float) -> bool:
        """Return whether to log a warning about an address; if so, it counts as logged.

        Args:
            address: The peer's address.
            now: Seconds that never go back.
        """
        if now - self._last.get(address, -EVERY_S) < EVERY_S:
            return False
        if len(self._last) >= _MOST:
            self._last.clear()
        self._last[address] = now
        return True
