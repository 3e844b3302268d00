"""The goals that an action server keeps. Pure: takes events and the time, and returns what changed.

Rules of ROS's own servers that clients rely on:

- a goal that comes twice is one goal;
- a cancellation that overtakes its goal, or that is meant for all goals up to a time, also meets goals that
  come later;
- a goal that is over stays in the list for a while, so that no client misses how it ended.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, auto

from rce.lifecycle import remember
from rce.ros.actions.exceptions import UnknownGoalError
from rce.ros.actions.goal_id import GoalId
from rce.ros.actions.states import GOAL_LIFE, GoalEvent, GoalState

MEMORY = 5.0
"""Seconds that a goal stays in the list after its end."""

CANCELLED_BEFORE = "the goal is older than a cancellation of all goals up to a time"
CANCELLED_EARLY = "the goal was cancelled before it came"


@dataclass(slots=True)
class Entry:
    """One goal.

    Attributes:
        goal_id: Its name and stamp.
        state: Its state.
        text: The server's text on its state.
        has_come: False for a goal of which only the cancellation has come.
        forget_at: When it leaves the list, seconds; None while it is not over.
        recent: Its latest event.
    """

    goal_id: GoalId
    state: GoalState = GoalState.PENDING
    text: str = ""
    has_come: bool = True
    forget_at: float | None = None
    recent: tuple[GoalEvent, ...] = ()


class Arrival(Enum):
    """How a server classifies an incoming goal."""

    NEW = auto()
    """It is new: the server works on it."""
    REPEATED = auto()
    """It is in the list already."""
    CANCELLED = auto()
    """It was cancelled before it came; it is over and its result must be published."""


class GoalLedger:
    """All goals of a server. Times are seconds of any clock that does not jump.

    Invariant: an entry has ``forget_at`` exactly if its goal is over or has not come.
    """

    def __init__(self, memory: float = MEMORY) -> None:
        self.memory = memory
        self._entries: dict[str, Entry] = {}
        self._cancelled_up_to = 0

    def __getitem__(self, goal_id: str) -> Entry:
        """Return a goal's entry.

        Raises:
            UnknownGoalError: The goal is not in the list (any more).
        """
        try:
            return self._entries[goal_id]
        except KeyError:
            raise UnknownGoalError(goal_id) from None

    def receive(self, goal_id: GoalId, now: float) -> Arrival:
        """Take a goal. Its id must not be empty; without a stamp, no cancellation up to a time meets it."""
        entry = self._entries.get(goal_id.id)
        if entry is None:
            entry = self._entries[goal_id.id] = Entry(goal_id)
            if not goal_id.stamp or goal_id.stamp > self._cancelled_up_to:
                return Arrival.NEW
            self.apply(goal_id.id, GoalEvent.CANCEL, now, CANCELLED_BEFORE)
            return Arrival.CANCELLED
        if entry.has_come:
            if entry.forget_at is not None:
                entry.forget_at = now + self.memory
            return Arrival.REPEATED
        entry.goal_id, entry.has_come = goal_id, True
        self.apply(goal_id.id, GoalEvent.CANCEL, now, CANCELLED_EARLY)
        return Arrival.CANCELLED

    def cancel(self, request: GoalId, now: float) -> list[str]:
        """Take a cancellation.

        Args:
            request: With an id: that goal. With a stamp: all goals up to it. With neither: all goals.
            now: The time.

        Returns:
            The goals that are asked to end and were not before.
        """
        asked = []
        for entry in self._entries.values():
            is_meant = (
                entry.goal_id.id == request.id
                or (request.stamp and entry.goal_id.stamp <= request.stamp)
                or request == GoalId()
            )
            if is_meant and entry.has_come and GOAL_LIFE.allows(entry.state, GoalEvent.REQUEST_CANCEL):
                self.apply(entry.goal_id.id, GoalEvent.REQUEST_CANCEL, now, entry.text)
                asked.append(entry.goal_id.id)
        if request.id and request.id not in self._entries:
            self._entries[request.id] = Entry(
                request, GoalState.RECALLING, has_come=False, forget_at=now + self.memory
            )
        self._cancelled_up_to = max(self._cancelled_up_to, request.stamp)
        return asked

    def note_time_jump(self) -> None:
        """Take note that time jumped back: cancellations of all goals up to a time are void."""
        self._cancelled_up_to = 0

    def apply(self, goal_id: str, event: GoalEvent, now: float, text: str = "") -> Entry:
        """Apply an event to a goal.

        Raises:
            UnknownGoalError: The goal has not come, or is forgotten.
            IllegalTransitionError: It is not possible in the goal's state; nothing was changed.
        """
        entry = self[goal_id]
        if not entry.has_come:
            raise UnknownGoalError(goal_id)
        state = GOAL_LIFE.advance(entry.state, event, goal_id, entry.recent)
        entry.state, entry.text, entry.recent = state, text, remember(entry.recent, event)
        if state.is_over:
            entry.forget_at = now + self.memory
        return entry

    def listed(self, now: float) -> Iterable[Entry]:
        """Remove expired goals and return the rest, the oldest first."""
        overdue = [
            key
            for key, entry in self._entries.items()
            if entry.forget_at is not None and entry.forget_at < now
        ]
        for key in overdue:
            del self._entries[key]
        return self._entries.values()

    def validate(self) -> None:
        """Check the invariant."""
        for key, entry in self._entries.items():
            assert key == entry.goal_id.id, f"{key} holds {entry}"
            assert (entry.forget_at is not None) == (entry.state.is_over or not entry.has_come), entry
