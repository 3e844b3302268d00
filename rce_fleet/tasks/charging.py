"""Which idle robots charge, at which charger, and where idle robots wait without being in the way."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.tasks.energy import BatteryLevels
    from rce_fleet.tasks.facts import RobotFacts
    from rce_fleet.tasks.travel import TravelCosts

_RING = ((-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1))
_LOOK_AT_MOST = 2000
"""Cells that are looked at for a place to wait."""


class ChargerQueue:
    """Chargers as a resource: one robot each, the others wait, the emptiest first.

    Args:
        levels: Thresholds.
        travel: Distances.

    Attributes:
        charging: The charger that each robot goes to or charges at.
        waiting: Robots that wait for a charger, the emptiest first.
    """

    def __init__(self, levels: BatteryLevels, travel: TravelCosts) -> None:
        self._levels = levels
        self._travel = travel
        self.charging: dict[str, int] = {}
        self.waiting: list[str] = []

    def can_work(self, robot: RobotFacts) -> bool:
        """Return whether a robot may be given a task, by its battery."""
        if robot.battery is None:
            return True
        if robot.id in self.charging:
            return robot.battery >= self._levels.sufficient
        return robot.battery > self._levels.critical

    def adopt(self, idle: Mapping[str, RobotFacts], chargers: Sequence[int], taken: Collection[int]) -> None:
        """Let robots that stand at a charger charge on, as after a restart; forget those that left.

        Args:
            idle: Robots without a task that can be sent somewhere, by name.
            chargers: Cells with chargers.
            taken: Cells that tasks use.
        """
        for name, charger in list(self.charging.items()):
            if name not in idle or charger not in chargers or charger in taken:
                del self.charging[name]
        for robot in idle.values():
            cell = robot.cell
            free_here = cell in chargers and cell not in self.charging.values() and cell not in taken
            if cell is not None and free_here and self._wants(robot, full=True):
                self.charging.setdefault(robot.id, cell)

    def update(self, idle: Mapping[str, RobotFacts], chargers: Sequence[int], taken: Collection[int]) -> None:
        """Choose who charges.

        Args:
            idle: Robots without a task that can be sent somewhere, by name.
            chargers: Cells with chargers.
            taken: Cells that tasks use.
        """
        self.adopt(idle, chargers, taken)
        wanting = [robot for robot in idle.values() if robot.id not in self.charging and self._wants(robot)]
        wanting.sort(key=lambda robot: (robot.battery if robot.battery is not None else 1.0, robot.id))
        self._leave(idle, chargers, wanting)
        free = [cell for cell in chargers if cell not in self.charging.values() and cell not in taken]
        self.waiting = []
        for robot in wanting:
            nearest = None if robot.cell is None else self._travel.nearest(robot.cell, free)
            if nearest is None:
                self.waiting.append(robot.id)
            else:
                self.charging[robot.id] = nearest
                free.remove(nearest)

    def _leave(
        self, idle: Mapping[str, RobotFacts], chargers: Sequence[int], wanting: Sequence[RobotFacts]
    ) -> None:
        """End the charging of robots that are full, and of as many sufficient ones as others need."""
        free = len(set(chargers) - set(self.charging.values()))
        urgent = sum(
            robot.battery is not None and robot.battery <= self._levels.critical for robot in wanting
        )
        by_battery = sorted(self.charging, key=lambda robot: -(idle[robot].battery or 0.0))
        for robot in by_battery:
            battery = idle[robot].battery
            is_full = battery is None or battery >= self._levels.full
            if is_full or (battery is not None and battery >= self._levels.sufficient and urgent > free):
                del self.charging[robot]
                free += 1

    def _wants(self, robot: RobotFacts, *, full: bool = False) -> bool:
        level = self._levels.full if full else self._levels.good
        return robot.battery is not None and robot.battery < level


def keeps_clear(grid: GridMap, shut: Collection[int], cell: int) -> bool:
    """Return whether others get around a robot that waits in a cell.

    The free cells beside it must be connected over the eight cells around it: it is not in a corridor.
    """
    row, column = grid.place(cell)
    ring = []
    for down, right in _RING:
        inside = 0 <= row + down < grid.rows and 0 <= column + right < grid.columns
        ring.append(inside and grid.cell(row + down, column + right) not in shut)
    sides = [index for index in (1, 3, 5, 7) if ring[index]]
    if len(sides) <= 1:
        return True
    gaps = sum(ring[index] and not ring[index - 1] for index in range(len(ring)))
    lone_corners = sum(
        ring[index] and not ring[index - 1] and not ring[(index + 1) % len(ring)] for index in (0, 2, 4, 6)
    )
    return gaps - lone_corners <= 1


def place_to_wait(grid: GridMap, shut: Collection[int], start: int, avoided: Collection[int]) -> int | None:
    """Return the nearest cell where a robot hinders no other one; None if there is none near.

    Args:
        grid: The map.
        shut: Cells that cannot be entered.
        start: The robot's cell.
        avoided: Cells that tasks, chargers or other robots use.
    """
    seen, queue = {start}, deque([start])
    while queue and len(seen) < _LOOK_AT_MOST:
        cell = queue.popleft()
        if cell not in avoided and cell not in shut and keeps_clear(grid, shut, cell):
            return cell
        for other in grid.around(cell):
            if other not in seen and other not in shut:
                seen.add(other)
                queue.append(other)
    return None
