"""Slows down the guessing of passwords, by address and user (pure: the time is an argument).

A check that fails costs a token of two buckets: that of the address and user, and that of the address.

When the first is empty the next check has to wait for a token, and is refused when that takes longer than
a login at a door may wait. When the second is empty checks wait for a moment, but are not refused: many
robots and people share an address behind a router, and an attacker there must not lock them out.

A check that succeeds costs nothing, so a fleet behind one address is never slowed down by itself, and wrong
passwords from one address cost those at other addresses nothing.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from typing import TYPE_CHECKING

from rce.guard import Rates
from rce_master.exceptions import TooManyFailuresError

if TYPE_CHECKING:
    from collections.abc import Iterator

FREE = 10
"""Failures of a user at an address that are not slowed down."""
PACE_S = 3.0
"""Seconds for each further one."""
FREE_OF_ADDRESS = 100
"""The same of all users at an address."""
PACE_OF_ADDRESS_S = 0.5
MAX_DELAY_S = 5.0
"""Longest that a check is put off; less than a robot endpoint waits for the master's answer."""
MAX_ADDRESS_DELAY_S = 2.0
"""The same where only others at the address have failed."""
MAX_DELAYED = 256
"""Checks that are put off at the same time; beyond it, one of each address and user."""
_LONGEST_NAME = 64


class FailureThrottle:
    """Counts failures and says how long the next check has to wait."""

    def __init__(self) -> None:
        self._pairs = Rates(per_second=1 / PACE_S, burst=FREE)
        self._addresses = Rates(per_second=1 / PACE_OF_ADDRESS_S, burst=FREE_OF_ADDRESS)
        self.delayed: Counter[str] = Counter()
        """Checks that are put off now, by address and user."""

    def admit(self, address: str, user: str, now: float) -> float:
        """Count a check as a failure, until :meth:`passed` takes it back.

        Args:
            address: Where it comes from.
            user: Whose password it is said to be; need not exist.
            now: Seconds of a clock that never goes back.

        Returns:
            Seconds to wait before the check.

        Raises:
            TooManyFailuresError: It would have to wait too long; nothing was counted.
        """
        pair = _pair(address, user)
        delay = self._pairs.reserve(pair, now)
        if delay > MAX_DELAY_S:
            self._pairs.give_back(pair, now)
            raise TooManyFailuresError(delay)
        others = self._addresses.reserve(address, now)
        if others > MAX_ADDRESS_DELAY_S:
            self._addresses.give_back(address, now)  # who is not refused must not owe more and more
        delay = max(delay, min(others, MAX_ADDRESS_DELAY_S))
        if delay and self.delayed.total() >= MAX_DELAYED and self.delayed[pair]:
            self.passed(address, user, now)
            raise TooManyFailuresError(max(1.0, delay))
        return delay

    @contextlib.contextmanager
    def delaying(self, address: str, user: str) -> Iterator[None]:
        """Count a check among those that are put off while the context lasts."""
        pair = _pair(address, user)
        self.delayed[pair] += 1
        try:
            yield
        finally:
            self.delayed[pair] -= 1
            if not self.delayed[pair]:
                del self.delayed[pair]

    def passed(self, address: str, user: str, now: float) -> None:
        """Take back what :meth:`admit` counted: the check succeeded, or was not made."""
        self._pairs.give_back(_pair(address, user), now)
        self._addresses.give_back(address, now)


def _pair(address: str, user: str) -> str:
    return f"{address} {user[:_LONGEST_NAME]}"
