"""Policies on which goals a server works on, and when. Pure: reducers from events to steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from rce.ros.actions.goal_id import GoalId

MAX_GOALS = 100
"""How many goals a server works on at the same time, unless it is told otherwise."""

REPLACED = "another goal came"


@dataclass(frozen=True, slots=True)
class Start:
    """Work on a goal."""

    goal_id: str


@dataclass(frozen=True, slots=True)
class Stop:
    """Ask the handler of a goal to end."""

    goal_id: str


@dataclass(frozen=True, slots=True)
class Drop:
    """Cancel a goal that no handler works on."""

    goal_id: str
    text: str = ""


@dataclass(frozen=True, slots=True)
class Refuse:
    """Reject a goal."""

    goal_id: str
    text: str


Step = Start | Stop | Drop | Refuse


class Policy(Protocol):
    """Decides on goals."""

    def offer(self, goal: GoalId) -> list[Step]:
        """Take a new goal."""

    def cancel(self, goal_id: str) -> list[Step]:
        """Take note that a client asks to end a goal that is not over."""

    def ended(self, goal_id: str) -> list[Step]:
        """Take note that the work on a goal has ended."""

    def note_time_jump(self) -> None:
        """Take note that time jumped back: later goals have earlier stamps."""


@dataclass(slots=True)
class ManyGoals:
    """Works on all goals side by side, up to a limit; more are rejected."""

    limit: int = MAX_GOALS
    running: set[str] = field(default_factory=set)

    def offer(self, goal: GoalId) -> list[Step]:
        """Start it, if there is room."""
        if len(self.running) >= self.limit:
            return [Refuse(goal.id, f"the server works on {self.limit} goals already")]
        self.running.add(goal.id)
        return [Start(goal.id)]

    def cancel(self, goal_id: str) -> list[Step]:
        """Pass it on."""
        return [Stop(goal_id)] if goal_id in self.running else []

    def ended(self, goal_id: str) -> list[Step]:
        """Make room."""
        self.running.discard(goal_id)
        return []

    def note_time_jump(self) -> None:
        """Do nothing: stamps are not compared."""


@dataclass(slots=True)
class SingleGoal:
    """Works on one goal; a newer one stops it and waits until it has ended. Older ones are dropped.

    As ROS's simple servers do: newer is what has the later stamp, and only one goal waits.
    """

    current: GoalId | None = None
    waiting: GoalId | None = None
    newest: int = 0
    """Stamp of the newest goal that was taken."""

    def offer(self, goal: GoalId) -> list[Step]:
        """Start it, or let it wait for the end of the present one."""
        if goal.stamp < self.newest:
            return [Drop(goal.id, REPLACED)]
        self.newest = goal.stamp
        if self.current is None:
            self.current = goal
            return [Start(goal.id)]
        steps: list[Step] = [Drop(self.waiting.id, REPLACED)] if self.waiting is not None else []
        self.waiting = goal
        return [*steps, Stop(self.current.id)]

    def cancel(self, goal_id: str) -> list[Step]:
        """Stop the present goal, or drop the one that waits."""
        if self.current is not None and goal_id == self.current.id:
            return [Stop(goal_id)]
        if self.waiting is not None and goal_id == self.waiting.id:
            self.waiting = None
            return [Drop(goal_id)]
        return []

    def ended(self, goal_id: str) -> list[Step]:
        """Start the one that waits."""
        if self.current is None or goal_id != self.current.id:
            return []
        self.current, self.waiting = self.waiting, None
        return [Start(self.current.id)] if self.current is not None else []

    def note_time_jump(self) -> None:
        """Take the next goal as the newest, whatever its stamp is."""
        self.newest = 0
