"""What the manager knows of the robots now: facts that are read anew after a restart, and are not kept."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.tasks.records import AUTOMATIC

if TYPE_CHECKING:
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.lanes import LaneGraph
    from rce_fleet.tasks.records import CellBlock, Zone

AT_REST = frozenset({"idle", "arrived"})
"""States of the planner in which a robot has nothing to do."""
AWAY = frozenset({"silent", "joining", "lost"})
"""States in which the planner cannot send a robot anywhere: it does not hear it, or know its place."""
MOST_STEPS = 100
"""So many steps of the clock are remembered."""
NOT_DRIVEN = frozenset({"paused", "stopped", "manual", "out_of_service", "dead", "lost"})
"""States in which a robot cannot move: a person decided so, or it is lost."""


@dataclass(slots=True)
class RobotFacts:
    """One robot, as planner and battery tell.

    Attributes:
        id: Its name.
        state: Its state in the planner.
        reason: Why, for people.
        cell: Its cell; None: not known.
        goal: Its goal in the planner; None: none.
        battery: Share of the full battery, 0 .. 1; None: not known.
        moved_at: When its cell changed last, or it got its goal: seconds since 1970.
        away_since: Since when it has been silent, joining, lost or not in the planner; ``inf``: it is there.
        by_hand: Whether it drives to a goal that a person or another program gave it.
        mode: Who drives it, by its own mode and the fleet's.
        mode_reason: Why it has its mode, for people.
        is_known: Whether the planner knows it now.
        barred_by: The cell of a robot that rests on its path and that the planner does not send away; None:
            there is not one.
    """

    id: str
    state: str = "joining"
    reason: str = ""
    cell: int | None = None
    goal: int | None = None
    battery: float | None = None
    moved_at: float = -inf
    away_since: float = inf
    by_hand: bool = False
    mode: str = AUTOMATIC
    mode_reason: str = ""
    is_known: bool = True
    barred_by: int | None = None

    @property
    def is_there(self) -> bool:
        """Whether the planner knows where it is, and hears it."""
        return self.state not in AWAY and self.cell is not None

    @property
    def is_driven(self) -> bool:
        """Whether the planner drives it: it was not paused, and no person drives it."""
        return self.is_there and self.state not in NOT_DRIVEN and self.mode == AUTOMATIC

    def is_at(self, cell: int) -> bool:
        """Return whether it has arrived in a cell."""
        return self.cell == cell and self.state in AT_REST


@dataclass(slots=True)
class FleetFacts:
    """The fleet, as the planner tells.

    Attributes:
        robots: By name.
        shut: Cells that no robot may enter: walls, and cells that are blocked or will be.
        map_revision: Changes whenever ``shut`` or the grid does.
        is_live: Whether the planner is heard.
        is_current: Whether no change of its state was missed.
        grid: The grid, its walls blocked; None before the first state.
        lanes: Lanes that robots keep to; None: they drive over all cells that are not blocked.
        mode: The fleet's: ``automatic``, ``paused`` or ``stopped``.
        zones: The planner's zones, by name.
        pending: Cells that will be blocked once a robot has left them.
        requested: Cells that people blocked, as the planner says; None: it has not said so since it began.
        blocks: Who blocked cells, and why, by cell: people one by one, or robots' sensors.
        clock_steps: When the clock was set forward, by the time before, and by how many seconds.
    """

    robots: dict[str, RobotFacts] = field(default_factory=dict)
    shut: frozenset[int] = frozenset()
    map_revision: int = 0
    is_live: bool = False
    is_current: bool = False
    grid: GridMap | None = None
    lanes: LaneGraph | None = None
    mode: str = AUTOMATIC
    zones: dict[str, Zone] = field(default_factory=dict)
    pending: frozenset[int] = frozenset()
    requested: frozenset[int] | None = None
    blocks: dict[int, CellBlock] = field(default_factory=dict)
    clock_steps: list[tuple[float, float]] = field(default_factory=list)

    def skip(self, seconds: float, now: float) -> None:
        """Note that the clock was set forward: robots neither moved nor were away in that time.

        Args:
            seconds: By which it was set forward.
            now: Seconds since 1970, after the step.
        """
        self.clock_steps = [*self.clock_steps[1 - MOST_STEPS :], (now - seconds, seconds)]
        before = now - seconds
        for robot in self.robots.values():
            # What was noted after the step of the clock has the new time already.
            if robot.moved_at <= before:
                robot.moved_at += seconds
            if robot.away_since <= before:
                robot.away_since += seconds

    def elapsed(self, since: float, now: float) -> float:
        """Return the seconds from one time to another, without steps of the clock."""
        return now - since - sum(seconds for before, seconds in self.clock_steps if since <= before)

    def standing(self) -> dict[int, str]:
        """Return the cells of robots that the planner does not drive now, and which robot is in each."""
        return {
            robot.cell: robot.id
            for robot in self.robots.values()
            if robot.cell is not None and robot.is_known and not robot.is_driven
        }
