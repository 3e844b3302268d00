"""Which robots shall be stopped, and which are released but do not know it yet. Kept in a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from msgspec import Struct

from rce_fleet.station.private_files import KeptInFile, fleet_file


class StopOrder(Struct, kw_only=True, frozen=True):
    """What a person ordered.

    Attributes:
        stopped: Whether to stand; False: released.
        user: Who ordered it.
        time: When; seconds since 1970.
    """

    stopped: bool
    user: str
    time: float


class _Kept(Struct, kw_only=True):
    """The content of the file.

    Attributes:
        fleet: The stop of all robots, also of those that appear later.
        robots: Orders for single robots; each counts before the one for all.
    """

    fleet: StopOrder | None = None
    robots: dict[str, StopOrder] = {}


def stops_file(folder: Path, fleet: str) -> Path:
    """Return the file of a fleet's stops.

    Args:
        folder: The folder.
        fleet: What tells the fleet from others.
    """
    return fleet_file(folder, "stops", fleet)


class DesiredStops(KeptInFile[_Kept]):
    """The newest order for all robots, and for each robot.

    Args:
        file: Where they are kept; None: in memory only.
    """

    def __init__(self, file: Path | None = None) -> None:
        super().__init__(_Kept, _Kept(), file)

    @property
    def robots(self) -> set[str]:
        """Robots with an order of their own."""
        return set(self._content.robots)

    @property
    def fleet_stopped_by(self) -> str | None:
        """Who stopped all robots; None: they are not stopped as a whole."""
        return None if self._content.fleet is None else self._content.fleet.user

    def order_for(self, robot: str) -> StopOrder | None:
        """Return what a robot shall be told; None: nothing."""
        return self._content.robots.get(robot, self._content.fleet)

    def is_done_when_told(self, robot: str) -> bool:
        """Return whether a robot needs an order only until it is told: a release, if not all are stopped."""
        order = self.order_for(robot)
        return order is not None and not order.stopped and self._content.fleet is None

    def order_fleet(self, robots: Iterable[str], order: StopOrder) -> None:
        """Stop or release all robots.

        Args:
            robots: Those that are known now.
            order: What to do; a stop also counts for robots that appear later.
        """
        self._content.fleet = order if order.stopped else None
        self._content.robots = dict.fromkeys([*self._content.robots, *robots], order)
        self._revision += 1

    def order_robot(self, robot: str, order: StopOrder) -> None:
        """Stop or release a robot."""
        self._content.robots[robot] = order
        self._revision += 1

    def release_new(self, robot: str, order: StopOrder) -> None:
        """Release a robot that was not known when all were, unless there is a newer order for it."""
        if self.order_for(robot) is None:
            self.order_robot(robot, order)

    def was_told(self, robot: str, order: StopOrder | None) -> None:
        """Note that a robot got an order: one that is released needs none any more.

        The stop of a robot that was stopped with all others is kept, so that the robot can be released also
        if the planner does not know it then.
        """
        if order is None or order is not self.order_for(robot):
            return
        if order.stopped and robot not in self._content.robots:
            self._content.robots[robot] = order
            self._revision += 1
        elif self.is_done_when_told(robot):
            del self._content.robots[robot]
            self._revision += 1
