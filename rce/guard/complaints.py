"""Keeps strangers from filling the log: one complaint for each address now and then (sans-I/O)."""

from __future__ import annotations

EVERY_S = 10.0
"""The log is told of an address at most so often."""
_MOST = 1024
"""Addresses that are remembered."""


class Complaints:
    """Says which complaints the log is to be told."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}

    def is_due(self, address: str, now: float) -> bool:
        """Tell whether to complain of an address; counts as a complaint if so.

        Args:
            address: Whom it is about.
            now: Seconds that never go back.
        """
        if now - self._last.get(address, -EVERY_S) < EVERY_S:
            return False
        if len(self._last) >= _MOST:
            self._last.clear()
        self._last[address] = now
        return True
