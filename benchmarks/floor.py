"""The demo's floor with boxes and walkers at random places: where localization and navigation are measured.

World, robot model, odometry and sensors are those of the simulation. Time is the world's own: a run is as
fast as the processor. The same seed gives the same floor and the same run.
"""

from __future__ import annotations

from math import hypot, pi
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from rce_fleet.demo.floor import FLOOR, with_surroundings
from rce_fleet.drivers.scene import RobotStart, Scene
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.scan import LaserScan
from rce_fleet.simulation.box import BoxSpec
from rce_fleet.simulation.map_walls import draw_map
from rce_fleet.simulation.walkers import WalkerSpec
from rce_fleet.simulation.walls import Point, Walls

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


TICK = 0.02
"""Step of the world, seconds."""
_ROBOT = "Robot1"
_CONFIGS = Path(__file__).resolve().parent.parent / "configs" / "turtlebot"
_TRIES = 100_000
_FAILURES = 1000
"""Tries without a place after which all boxes, or all waypoints of a walker, are chosen anew."""
_WAYPOINTS = 4
"""Places between which a walker walks."""
_OUTLINE = 0.1
"""Distance of the points on a box's outline at which its distance from other things is looked at, metres."""


def shipped(name: str) -> dict[str, Any]:
    """Return the parameters of a file in ``configs/turtlebot``."""
    values = yaml.safe_load((_CONFIGS / name).read_text(encoding="utf-8"))
    assert isinstance(values, dict)
    return values


class Floor:
    """The demo's floor with a TurtleBot, boxes and walkers.

    Args:
        seed: Of everything that is random.
        sensor: The robot's: ``lidar`` or ``camera``.
        boxes: How many boxes there are; none is nearer to the robot's start than its hull.
        unmapped: How many of them are not on the map.
        apart: Least distance of a box from walls and other boxes, metres; None: they may touch or overlap.
        walkers: How many people walk about. They turn back if the robot is in front of them for long.

    Attributes:
        rng: Draws what the world does not draw itself.
        map: The map that a perfect mapper would make of the walls and the boxes that are on it.
        world: The world.
        robot: The robot.
    """

    def __init__(
        self,
        seed: int,
        *,
        sensor: str = "lidar",
        boxes: int = 10,
        unmapped: int = 1,
        apart: float | None = 0.5,
        walkers: int = 0,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        scene = with_surroundings(Scene(walls=tuple(sorted(FLOOR.blocked)), model="turtlebot2", seed=seed))
        self.map = scene.draw()
        self.world = scene.build()
        placed = self._put_boxes(boxes, apart)
        on_map = Walls(tuple(box.block for box in placed[unmapped:]))
        free = scene.floor().grid.free
        self.map = draw_map(self.world.walls + on_map, [self.world.grid.centre(cell) for cell in free])
        x, y = self.free_place()
        start = RobotStart(id=_ROBOT, at=(x, y), yaw=float(self.rng.uniform(-pi, pi)), sensor=sensor)
        scene.place(start, self.world)
        self.robot = self.world.robots[_ROBOT]
        for number in range(walkers):
            self._add_walker(f"walker_{number}")

    def step(self) -> None:
        """Let a tick pass."""
        self.world.step(TICK)

    def scan(self) -> LaserScan:
        """Return what the robot's sensor measures now."""
        spec = self.robot.model.lidar
        laser = Pose(spec.x, spec.y, spec.yaw)
        ranges = self.world.scan(_ROBOT)
        return LaserScan(ranges, spec.angle_min, spec.increment, spec.min_range, spec.max_range, laser)

    def move_robot(self, pose: Pose) -> None:
        """Put the robot elsewhere, as a hand would."""
        self.world.move_robot(_ROBOT, pose)

    # Places

    def is_free(self, x: float, y: float, room: float) -> bool:
        """Return whether no wall, box or door is within ``room`` of a point of the floor, metres."""
        return not self.world.is_solid(x, y, room)

    def free_place(self, room: float = 0.1) -> Point:
        """Return a random place at which the robot has so much room around it, metres."""
        radius = self.world.spec.model.radius
        return next(place for place in self._places() if self.is_free(*place, radius + room))

    def has_straight_way(self, start: Point, end: Point, room: float) -> bool:
        """Return whether the line between two points keeps ``room`` to walls, boxes and doors, metres."""
        count = int(hypot(end[0] - start[0], end[1] - start[1]) / 0.05) + 2
        points = np.linspace(start, end, count)
        return all(self.is_free(x, y, room) for x, y in points.tolist())

    def _places(self) -> Iterator[Point]:
        """Yield random places on the map's free cells."""
        cells = np.argwhere(self.map.free)
        for _ in range(_TRIES):
            cell = cells[self.rng.integers(len(cells))] + self.rng.random(2) - 0.5
            x, y = self.map.cell_to_world(cell[None])[0].tolist()
            yield x, y
        raise RuntimeError(f"there is no room on the floor in {_TRIES} tries")

    # What is on the floor

    def _put_boxes(self, count: int, apart: float | None) -> list[BoxSpec]:
        """Put boxes at random places; begin anew if those that stand leave no room for the next."""
        placed: list[BoxSpec] = []
        failed = 0
        for x, y in self._places():
            if len(placed) == count:
                break
            width, depth = self.rng.uniform(0.4, 0.6, 2).tolist()
            box = BoxSpec(Pose(x, y, float(self.rng.uniform(-pi, pi))), width, depth)
            if apart is None or all(self.is_free(x, y, apart) for x, y in _outline(box).tolist()):
                self.world.put_box(f"box_{len(placed)}", box)
                placed.append(box)
                failed = 0
            else:
                failed += 1
            if failed > _FAILURES:
                for name in list(self.world.all_boxes):
                    self.world.take_box(name)
                placed, failed = [], 0
        return placed

    def _add_walker(self, name: str) -> None:
        """Add a person who walks back and forth between places that have straight ways between them."""
        speed, radius = float(self.rng.uniform(0.4, 1.0)), 0.2
        room, robot = radius + 0.05, self.robot.pose
        way: list[Point] = []
        failed = 0
        for place in self._places():
            off_robot = hypot(place[0] - robot.x, place[1] - robot.y) > 1.0
            if off_robot and self.is_free(*place, room) and (not way or self._is_next(way[-1], place, room)):
                way.append(place)
                failed = 0
            failed += 1
            if len(way) == _WAYPOINTS:
                break
            if failed > _FAILURES:  # there is no way from here: begin somewhere else
                way, failed = [], 0
        pause = float(self.rng.uniform(0.0, 2.0))
        spec = WalkerSpec(tuple(way), speed, radius, pause, loop=False, social_distance=0.35, patience=1.5)
        self.world.add_walker(name, spec)

    def _is_next(self, last: Point, place: Point, room: float) -> bool:
        far = hypot(place[0] - last[0], place[1] - last[1]) > 1.0
        return far and self.has_straight_way(last, place, room)


def _outline(box: BoxSpec) -> NDArray[np.float64]:
    """Return points on the outline of a box, shape (N, 2), metres."""
    sides = [
        np.linspace(edge[:2], edge[2:], int(hypot(edge[2] - edge[0], edge[3] - edge[1]) / _OUTLINE) + 2)
        for edge in box.block.edges
    ]
    points: NDArray[np.float64] = np.concatenate(sides)
    return points
