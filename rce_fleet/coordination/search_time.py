"""How long one plan for all robots is looked for. Pure.

The planner's effort for one search is enough for most fleets. Where robots stand so closely, or streets are
so narrow or one-way, that it ends before all robots are at their targets, the next plans get time in which
the search is repeated with other seeds and more effort. Until then robots are granted nothing new. So the
time is short at first, and a plan that takes it is rare: robots that have paths drive on between two of them.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce_fleet.coordination.replanning import PlanRequest, PlanResult

SHORTEST = 0.5
"""Seconds after the first plan that was not complete; twice as many after each further one ..."""
LONGEST = 15.0
"""... up to so many, or to a share of the time after which a plan is given up."""
_SHARE = 0.25
PAUSE = 5.0
"""After a plan with such a time the next ones have none for so many times as long."""


class SearchTime:
    """Decides how long the next plan for all is looked for.

    Args:
        timeout: Seconds after which the plan of a small fleet is given up.
    """

    def __init__(self, timeout: float) -> None:
        self._longest = min(LONGEST, _SHARE * timeout)
        self._next = 0.0
        self._taken = 0.0
        self._taken_at = -inf

    def take(self, now: float) -> float:
        """Return the time for the plan that is requested now, seconds; 0: for one search."""
        if now - self._taken_at < PAUSE * self._taken:
            return 0.0
        self._taken, self._taken_at = self._next, now
        return self._next

    def note(self, request: PlanRequest, result: PlanResult) -> None:
        """Note how a plan for all ended; one that has no visits because of a failure does not count."""
        if result.complete:
            # The next one has half of the time; to find it takes less, so that it needs no pause.
            self._next = self._next / 2 if self._next > SHORTEST else 0.0
            self._taken = 0.0
        elif not result.failure and request.search_seconds == self._next:
            self._next = min(max(2 * self._next, SHORTEST), self._longest)
