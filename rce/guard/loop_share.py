"""Shares an event loop among users, so that a user who sends much does not delay the others.

Input is handled at once as long as its user has used little of the loop's time recently. Beyond that, it
waits until the others have had their turn. A user is not slowed down while the others are idle.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict, deque
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

SLICE_S = 0.002
"""Seconds that a user may use before others have their turn."""
_RECOVERY = 0.5
"""Seconds of use that are forgotten in a second."""


class Workload(Protocol):
    """A user's object that has work to do."""

    def continue_work(self) -> bool:
        """Do a small part of it; return whether there is more."""


class LoopShare:
    """The shares of all users of one event loop.

    Invariant: a user is in ``_waiting`` exactly while workloads of theirs wait.

    Args:
        slice_s: Seconds that a user may use before others have their turn.
        clock: Tells the time in seconds.
    """

    def __init__(self, *, slice_s: float = SLICE_S, clock: Callable[[], float] = time.perf_counter) -> None:
        self._slice = slice_s
        self._clock = clock
        self._used: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """User to the seconds that they used, and the time of that count; oldest first."""
        self._waiting: OrderedDict[str, deque[Workload]] = OrderedDict()
        self._round: asyncio.Handle | None = None

    def run(self, user: str, workload: Workload) -> bool:
        """Have work done now, as far as the user's share allows, and the rest in later turns.

        Returns:
            Whether all is done. If not, do not call this again before ``continue_work`` has returned False.
        """
        if user not in self._waiting:
            now = self._clock()
            used, since = self._used.get(user, (0.0, now))
            if self._work(user, workload, max(0.0, used - (now - since) * _RECOVERY), now):
                return True
        self._waiting.setdefault(user, deque()).append(workload)
        self._plan()
        return False

    def forget(self, user: str, workload: Workload) -> None:
        """Give no more turns to a workload that waits."""
        workloads = self._waiting.get(user)
        if workloads is not None and workload in workloads:
            workloads.remove(workload)
            if not workloads:
                del self._waiting[user]

    def _work(self, user: str, workload: Workload, used: float, now: float) -> bool:
        """Work until the user's slice is used up; return whether all was done."""
        more = True
        while more and used < self._slice:
            more = workload.continue_work()
            end = self._clock()
            used += end - now
            now = end
        self._used[user] = used, now
        self._used.move_to_end(user)
        self._forget_oldest(now)
        return not more

    def _forget_oldest(self, now: float) -> None:
        """Remove the oldest count if all of it is forgotten, so that users who left are not kept."""
        user, (used, since) = next(iter(self._used.items()))
        if used <= (now - since) * _RECOVERY:
            del self._used[user]

    def _plan(self) -> None:
        """Schedule a round after the loop has polled its sockets, so that new input is received first."""
        if self._round is None and self._waiting:
            self._round = asyncio.get_running_loop().call_soon(self._next_round)

    def _next_round(self) -> None:
        """Give each waiting user a turn, all together no more than two slices."""
        self._round = None
        end = self._clock() + 2 * self._slice
        for user in list(self._waiting):
            now = self._clock()
            if now >= end:
                break
            workloads = self._waiting.get(user)
            if workloads is None:
                continue
            self._waiting.move_to_end(user)
            workload = workloads[0]
            if self._work(user, workload, 0.0, now):
                self.forget(user, workload)
            elif workloads[0] is workload:
                workloads.rotate(-1)
        self._plan()
