"""Which idle robots charge, and at which charger."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from rce_fleet.tasks.energy import BatteryLevels
    from rce_fleet.tasks.facts import RobotFacts
    from rce_fleet.tasks.idle_ways import IdleWays

_LISTED = 5
"""So many chargers are named to people."""


class ChargerUser(NamedTuple):
    """An idle robot that charges, or goes to a charger for that.

    Attributes:
        robot: Its name.
        can_leave: Whether its battery is sufficient, so that it makes room for a robot that needs to charge.
    """

    robot: str
    can_leave: bool


class ChargerQueue:
    """Chargers as a resource: one robot each, the others wait, the emptiest first.

    Args:
        levels: Thresholds.
        ways: Which chargers robots can reach.

    Attributes:
        charging: The charger that each robot goes to or charges at.
        waiting: Robots that wait for a charger, the emptiest first, and why, for people.
    """

    def __init__(self, levels: BatteryLevels, ways: IdleWays) -> None:
        self._levels = levels
        self._ways = ways
        self.charging: dict[str, int] = {}
        self.waiting: dict[str, str] = {}

    def can_work(self, robot: RobotFacts) -> bool:
        """Return whether a robot may be given a task, by its battery."""
        if robot.battery is None:
            return True
        if robot.id in self.charging:
            return robot.battery >= self._levels.sufficient
        return robot.battery > self._levels.critical

    def users(self, idle: Iterable[RobotFacts], chargers: Collection[int]) -> dict[int, ChargerUser]:
        """Return which idle robots use chargers, by the charger's cell.

        A robot that stands at a charger uses it also before :meth:`adopt` knows of it, as after a restart.

        Args:
            idle: Robots without a task that can be sent somewhere.
            chargers: Cells with chargers.
        """
        found = {}
        for robot in idle:
            cell = self.charging.get(robot.id)
            if cell is None and robot.cell in chargers and self._wants(robot, full=True):
                cell = robot.cell
            if cell is not None:
                can_leave = robot.battery is None or robot.battery >= self._levels.sufficient
                found[cell] = ChargerUser(robot.id, can_leave)
        return found

    def adopt(self, idle: Mapping[str, RobotFacts], chargers: Sequence[int], taken: Collection[int]) -> None:
        """Let robots that stand at a charger charge on, as after a restart; forget those that left.

        A robot gives a charger up that it cannot reach any more, or at which another robot stays.

        Args:
            idle: Robots without a task that can be sent somewhere, by name.
            chargers: Cells with chargers.
            taken: Cells that tasks use.
        """
        for name, charger in list(self.charging.items()):
            is_gone = name not in idle or charger not in chargers or charger in taken
            if is_gone or self._ways.is_closed(idle[name], charger):
                del self.charging[name]
        free = {*chargers}.difference(self.charging.values(), taken)
        for robot in idle.values():
            if robot.cell in free and robot.id not in self.charging and self._wants(robot, full=True):
                self.charging[robot.id] = robot.cell
                free.remove(robot.cell)

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
        usable = [cell for cell in chargers if cell not in taken and not self._ways.stands(cell)]
        used = set(self.charging.values())
        self._leave(idle, sum(cell not in used for cell in usable), wanting)
        used = set(self.charging.values())
        free = [cell for cell in usable if cell not in used]
        self.waiting = {}
        why_none_is_free = self._why_none_is_free(chargers)
        for robot in wanting:
            nearest = self._ways.nearest(robot, free) if free else None
            if nearest is None:
                closed = f"no path leads {robot.id} to a charger that is free (cells {_listed(free)})"
                self.waiting[robot.id] = closed if free else why_none_is_free
            else:
                self.charging[robot.id] = nearest
                free.remove(nearest)

    def _why_none_is_free(self, chargers: Sequence[int]) -> str:
        """Return why robots wait that would reach a charger, for people."""
        stands = [f"{who} stands at {cell}" for cell in chargers if (who := self._ways.stands(cell))]
        if not chargers:
            return "the fleet has no chargers"
        return "; ".join(["no charger is free", *stands[:_LISTED]])

    def _leave(self, idle: Mapping[str, RobotFacts], free: int, wanting: Sequence[RobotFacts]) -> None:
        """End the charging of robots that are full, and of as many sufficient ones as others need.

        Args:
            idle: Robots without a task that can be sent somewhere, by name.
            free: How many chargers can be used, and no robot uses.
            wanting: Robots that want to charge.
        """
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


def _listed(cells: Sequence[int]) -> str:
    return ", ".join(map(str, cells[:_LISTED])) + (", ..." if len(cells) > _LISTED else "")
