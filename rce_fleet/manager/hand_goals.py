"""Keeps goals that people set for robots in the book, so that they survive restarts. Pure.

A request has its goal in the journal before the planner hears of it. A goal that a program set at the planner
is taken over into the book. Both are sent to a planner that was restarted. Such a goal ends when the robot
gets another one: of a task, of a program, or none because it was taken out.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.manager.goals import NO_ANSWER
from rce_fleet.tasks.records import OUT_MODES, GoalEntry
from rce_fleet.tasks.task import TaskState

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rce_fleet.manager.goals import GoalKeeper
    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.facts import FleetFacts


class HandGoals:
    """The goals of people and other programs.

    Args:
        book: Where they are kept.
        facts: What the planner says.
        keeper: Knows which goals were sent.
    """

    def __init__(self, book: TaskBook, facts: FleetFacts, keeper: GoalKeeper) -> None:
        self._book = book
        self._facts = facts
        self._keeper = keeper
        self._asking: set[str] = set()
        """Robots whose goal the planner is asked to take over now."""
        self._is_started_anew = False
        """Whether the planner still has the goals that a manager before this one sent."""

    def take_book(self, book: TaskBook) -> None:
        """Continue with another book, made from the journal again."""
        self._book = book

    def begin(self, now: float, *, is_same: bool, is_other_floor: bool) -> None:
        """Begin with a planner that was started, or is heard for the first time.

        Args:
            now: Seconds since 1970.
            is_same: The planner has not been restarted since it confirmed goals: one that it does not have
                now was changed there.
            is_other_floor: It has another grid: the goals are cells of the one before.
        """
        self._keeper.reset()
        self._is_started_anew = is_same
        for entry in list(self._book.goals.values()):
            if is_other_floor:
                self._end(entry, now, "the planner has another grid")
            elif is_same and not entry.unsent:
                self._keeper.assume(entry.id, entry.cell, now)

    def wanted(self, goals: Mapping[str, int | None]) -> dict[str, int | None]:
        """Return where robots shall go; a goal that a person set is before the manager's own.

        Args:
            goals: The manager's own.
        """
        return {**goals, **{entry.id: entry.cell for entry in self._book.goals.values()}}

    def request(self, robot: str, cell: int | None, now: float, user: str) -> GoalEntry:
        """Keep a goal that a person asks for.

        Args:
            robot: Its name.
            cell: The goal; None: stop and stay.
            now: Seconds since 1970.
            user: Who asks.

        Raises:
            TaskRefusedError: The robot is out of service, or brings the load of a cancelled task away.
        """
        task, mode = self._book.task_of(robot), self._book.entry(robot).mode
        if cell is not None and mode in OUT_MODES:
            raise TaskRefusedError(f"{robot} is {mode.replace('_', ' ')}: put it in first")
        if task is not None and task.state is TaskState.CANCELLING:
            raise TaskRefusedError(f"{robot} brings the load of {task.id} away; wait until it has done so")
        entry = GoalEntry(robot, cell, user, unsent=True)
        text = f"{robot} was stopped" if cell is None else f"{robot} was sent to cell {cell}"
        self._book.emit(entry, "stop" if cell is None else "goal", now, user=user, text=text)
        return entry

    @contextmanager
    def asking(self, entry: GoalEntry, now: float) -> Iterator[None]:
        """Note that the planner is asked to take over a goal: no step sends or judges it meanwhile."""
        self._keeper.note_sent(entry.id, entry.cell, now)
        self._asking.add(entry.id)
        try:
            yield
        finally:
            self._asking.discard(entry.id)

    def undo(self, entry: GoalEntry, before: GoalEntry | None, now: float, refusal: str) -> bool:
        """Go back to the goal before, because the planner refused one; return whether the book was changed.

        Args:
            entry: The goal that was refused.
            before: The one before it; None: there was none.
            now: Seconds since 1970.
            refusal: Why the planner refused.
        """
        if self._book.goals.get(entry.id) != entry:
            return False
        back = before or GoalEntry(entry.id)
        if not refusal.startswith(NO_ANSWER):
            self._keeper.forget(entry.id)
        self._book.emit(back, "refused", now, text=f"goal of {entry.id}: {refusal}")
        return True

    def adopt(self, goals: Mapping[str, int | None], now: float) -> None:
        """Take over what was changed at the planner, and end goals that others have replaced.

        Tasks of robots that were sent elsewhere are held.

        Args:
            goals: The manager's own.
            now: Seconds since 1970.
        """
        book, facts = self._book, self._facts
        if self._is_started_anew and facts.is_current:
            self._is_started_anew = False
            self._take_over_places(goals, now)
        for name, how in self._keeper.notice(facts, self.wanted(goals)).items():
            self._hold(name, how, now)
            known = book.goals.get(name)
            if known is not None and facts.robots[name].goal is None:
                self._end(known, now, how)
        for robot in facts.robots.values():
            if robot.by_hand and facts.is_current and robot.mode not in OUT_MODES:
                text = f"{robot.id} was sent to cell {robot.goal} by another program"
                book.emit(GoalEntry(robot.id, robot.goal), "goal", now, text=text)
        needed = {cell: robot for robot, cell in goals.items() if cell is not None}
        for entry in list(book.goals.values()):
            if entry.id not in self._asking:
                self._judge(entry, goals, needed, now)
        for entry in book.goals.values():
            known_robot = facts.robots.get(entry.id)
            if known_robot is not None and entry.cell is not None:
                known_robot.by_hand = not known_robot.is_at(entry.cell)

    def _take_over_places(self, goals: Mapping[str, int | None], now: float) -> None:
        """Take over robots that drive to a charger or parking place: the manager before sent them there."""
        places = {*self._book.places.chargers, *self._book.places.parking}
        for robot in self._facts.robots.values():
            is_known = robot.id in goals or robot.id in self._book.goals
            if robot.goal in places and not is_known and not robot.is_at(robot.goal):
                self._keeper.assume(robot.id, robot.goal, now)

    def confirmed(self) -> list[GoalEntry]:
        """Return goals of requests that the planner has now, marked so."""
        if not self._facts.is_live or not self._facts.is_current:
            return []
        robots = self._facts.robots
        return [
            replace(entry, unsent=False)
            for entry in self._book.goals.values()
            if entry.unsent
            and entry.id not in self._asking
            and not self._has_running_task(entry.id)  # the next step holds it, if it still sees the request
            and entry.id in robots
            and robots[entry.id].is_known
            and robots[entry.id].goal == entry.cell
        ]

    def _judge(
        self, entry: GoalEntry, goals: Mapping[str, int | None], needed: Mapping[int, str], now: float
    ) -> None:
        robot = self._facts.robots.get(entry.id)
        if self._book.entry(entry.id).is_out or (robot is not None and robot.mode in OUT_MODES):
            self._end(entry, now, f"{entry.id} takes no goals now")
        elif entry.unsent:
            by = entry.user or "a program"
            how = f"was stopped by {by}" if entry.cell is None else f"was sent to cell {entry.cell} by {by}"
            self._hold(entry.id, f"{entry.id} {how}", now)
        elif goals.get(entry.id) is not None:
            self._end(entry, now, f"{entry.id} has a task")
        elif (
            robot is not None
            and entry.cell is not None
            and robot.is_at(entry.cell)
            and needed.get(entry.cell, entry.id) != entry.id
        ):
            self._end(entry, now, f"cell {entry.cell} is the goal of {needed[entry.cell]}")

    def _has_running_task(self, robot: str) -> bool:
        task = self._book.task_of(robot)
        return task is not None and task.state is TaskState.RUNNING

    def _hold(self, robot: str, how: str, now: float) -> None:
        task = self._book.task_of(robot)
        if task is not None and task.state is TaskState.RUNNING:
            self._book.hold(task.id, now, reason=f"{how}; resume the task to continue")

    def _end(self, entry: GoalEntry, now: float, why: str) -> None:
        self._book.emit(GoalEntry(entry.id), "goal ended", now, text=f"goal of {entry.id}: {why}")
