"""Compares the goals that robots shall have with those that the planner has. Pure.

Goals are sent as often as it takes: after the restart of the planner or of the manager the same comparison
brings both together again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_fleet.tasks.records import OUT_MODES

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from rce_fleet.tasks.facts import FleetFacts, RobotFacts

NO_ANSWER = "the planner does not answer"
"""How a refusal begins that is not the planner's: it did not answer."""
ASK_AGAIN_S = 1.0
"""Seconds after which a goal is sent again that the planner did not take over."""


@dataclass(slots=True)
class _Sent:
    """A goal that was sent.

    Attributes:
        cell: The cell; None: the goal was removed.
        at: When, seconds.
        seen: Whether the planner's state had it since.
    """

    cell: int | None
    at: float
    seen: bool = False


class GoalKeeper:
    """Knows which goals are the manager's, and which a person or another program set."""

    def __init__(self) -> None:
        self._sent: dict[str, _Sent] = {}

    def reset(self) -> None:
        """Note that the planner was restarted: it knows no goals."""
        self._sent.clear()

    def assume(self, robot: str, cell: int | None, now: float) -> None:
        """Note that the planner had this goal when it was heard last."""
        self._sent[robot] = _Sent(cell, now, seen=True)

    def note_sent(self, robot: str, cell: int | None, now: float) -> None:
        """Note that a goal is being sent."""
        self._sent[robot] = _Sent(cell, now)

    def forget(self, robot: str) -> None:
        """Note that the planner refused a goal and has the one before."""
        self._sent.pop(robot, None)

    def notice(self, facts: FleetFacts, wanted: Mapping[str, int | None]) -> dict[str, str]:
        """Mark robots that drive to other goals; return those whose goal was changed, and how, for people.

        Args:
            facts: The robots; ``by_hand`` is set.
            wanted: Goals that they shall have.
        """
        changed = {}
        for robot in facts.robots.values():
            if robot.mode in OUT_MODES or not robot.is_known:
                self._sent.pop(robot.id, None)  # its mode took its goal, or it is new there; not a person
            sent = self._sent.get(robot.id)
            if sent is not None and robot.goal == sent.cell:
                sent.seen = True
            elif sent is not None and sent.seen and sent.cell is not None:
                del self._sent[robot.id]
                changed[robot.id] = (
                    f"the goal of {robot.id} was removed by hand"
                    if robot.goal is None
                    else f"{robot.id} was sent to cell {robot.goal} by hand"
                )
            taken = robot.id in changed and robot.goal is not None
            robot.by_hand = taken or self._is_by_hand(robot, wanted)
        for robot_id in self._sent.keys() - facts.robots.keys():
            del self._sent[robot_id]
        return changed

    def to_send(
        self, facts: FleetFacts, wanted: Mapping[str, int | None], now: float
    ) -> list[tuple[str, int | None]]:
        """Return the goals to send now: removed ones first, so that their cells are free for others.

        Args:
            facts: The robots.
            wanted: Goals that they shall have; None: they shall have none.
            now: Seconds.
        """
        out: list[tuple[str, int | None]] = []
        needed = frozenset(wanted.values())
        for robot in facts.robots.values():
            sent = self._sent.get(robot.id)
            if robot.id in wanted:
                goal = wanted[robot.id]
            elif sent is not None or _rests_in(robot, needed):
                goal = None  # another robot shall go to its cell
            else:
                continue
            if robot.goal == goal:
                if sent is None and robot.id in wanted:
                    self._sent[robot.id] = _Sent(goal, now, seen=True)
                elif robot.id not in wanted and sent is not None and sent.cell is None:
                    del self._sent[robot.id]
                continue
            if sent is not None and sent.cell == goal and now - sent.at < ASK_AGAIN_S:
                continue
            if goal is not None and (not robot.is_there or robot.mode in OUT_MODES):
                continue
            self._sent[robot.id] = _Sent(goal, now)
            out.append((robot.id, goal))
        return sorted(out, key=lambda pair: pair[1] is not None)

    def is_newest(self, robot: str, cell: int | None) -> bool:
        """Return whether a goal of :meth:`to_send` still counts: a person may have set another one."""
        sent = self._sent.get(robot)
        return sent is not None and sent.cell == cell

    def refused(self, robot: str) -> None:
        """Note that the planner refused a goal; it is sent again later."""
        if robot in self._sent:
            self._sent[robot].seen = False

    def _is_by_hand(self, robot: RobotFacts, wanted: Mapping[str, int | None]) -> bool:
        sent = self._sent.get(robot.id)
        if robot.goal is None or robot.goal == wanted.get(robot.id) or robot.is_at(robot.goal):
            return False
        return sent is None and robot.id not in wanted


def _rests_in(robot: RobotFacts, cells: Collection[int | None]) -> bool:
    """Return whether a robot has arrived at its goal, in one of some cells."""
    return robot.goal is not None and robot.goal in cells and robot.is_at(robot.goal)
