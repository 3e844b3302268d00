"""Slows down the guessing of passwords, by address and user (pure: the time is an argument).

A check that fails costs a token of two buckets: that of the address and user, and that of the address.

When the first is empty a check has to wait for its next token. Who gets that is drawn by lot among all who
wait for one (:mod:`rce_master.lottery`): an attacker behind the same router makes others wait, but does not
take every turn. When the second is empty checks wait for a moment: many robots and people share an address.

A check that succeeds costs nothing, so a fleet behind one address is never slowed down by itself, and wrong
passwords from one address cost those at other addresses nothing.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from typing import TYPE_CHECKING

from rce.guard import Rates

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
AGAIN_S = 1.0
"""When a login that got no turn may try again; it has waited already."""
MAX_ADDRESS_DELAY_S = 2.0
"""The same where only others at the address have failed."""
MAX_DELAYED = 256
"""Checks that are put off at the same time; beyond it, one of each address and user."""
_LONGEST_NAME = 64


class FailureThrottle:
    """Counts failures, and tells how long the next check has to wait."""

    def __init__(self) -> None:
        self._pairs = Rates(per_second=1 / PACE_S, burst=FREE)
        self._addresses = Rates(per_second=1 / PACE_OF_ADDRESS_S, burst=FREE_OF_ADDRESS)
        self.delayed: Counter[str] = Counter()
        """Checks that are put off now, by address and user."""

    def take(self, pair: str, now: float) -> float:
        """Count a check of a user at an address as a failure, until :meth:`passed` takes it back.

        Args:
            pair: The address and user (:func:`pair_of`).
            now: Seconds of a clock that never goes back.

        Returns:
            0 if it was counted and may be made; else the seconds until one may be.
        """
        return self._pairs.take(pair, now)

    def admit(self, address: str, now: float) -> float:
        """Count a check as a failure at an address, until :meth:`passed` takes it back.

        Args:
            address: Where it comes from.
            now: Seconds of a clock that never goes back.

        Returns:
            Seconds to wait before the check.
        """
        delay = self._addresses.reserve(address, now)
        if delay > MAX_ADDRESS_DELAY_S:
            self._addresses.give_back(address, now)  # who is not refused must not owe more and more
        return min(delay, MAX_ADDRESS_DELAY_S)

    def is_crowded(self, pair: str) -> bool:
        """Return whether so many checks are put off that one more of this address and user is refused."""
        return self.delayed.total() >= MAX_DELAYED and pair in self.delayed

    @contextlib.contextmanager
    def delaying(self, pair: str) -> Iterator[None]:
        """Count a check among those that are put off while the context lasts."""
        self.delayed[pair] += 1
        try:
            yield
        finally:
            self.delayed[pair] -= 1
            if not self.delayed[pair]:
                del self.delayed[pair]

    def passed(self, address: str, pair: str, now: float) -> None:
        """Take back all that was counted: the check succeeded, or was not made."""
        self._pairs.give_back(pair, now)
        self._addresses.give_back(address, now)


def pair_of(address: str, user: str) -> str:
    """Return the key of an address and a user; the user need not exist."""
    return f"{address} {user[:_LONGEST_NAME]}"
