"""Limits log lines about strangers: one complaint for each address per interval (sans-I/O)."""

from __future__ import annotations

EVERY_S = 10.0
"""Seconds between two complaints about an address."""
_MOST = 1024
"""Addresses that are remembered."""


class Complaints:
    """Decides which complaints are logged."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}

    def is_due(self, address: str, now: float) -> bool:
        """Return whether to log a complaint about an address; if so, it counts as logged.

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
