"""Contacts of robots: how many there were, who caused them, and what touches a robot now."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import atan2, cos, inf, sin
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pymunk

    from rce_fleet.simulation.lidar import Floats
    from rce_fleet.simulation.robot import SimulatedRobot

MOVES_TOWARDS = 0.01
"""A robot that approaches at this speed or faster causes the contact, metres per second."""


class Kind(IntEnum):
    """What a shape in the physics engine is."""

    ROBOT = 1
    BOX = 2
    WALL = 3
    DOOR = 4
    WALKER = 5


@dataclass(slots=True)
class Collisions:
    """Number of collisions; each contact counts once, when it begins.

    Attributes:
        robot_robot: Between two robots.
        robot_box: Between a robot and a box.
        robot_wall: Between a robot and a wall.
        robot_door: Between a robot and a door.
        robot_walker: Between a robot and a walker.
        own_motion: Those of all these in which a robot drove against the other thing.
    """

    robot_robot: int = 0
    robot_box: int = 0
    robot_wall: int = 0
    robot_door: int = 0
    robot_walker: int = 0
    own_motion: int = 0

    @property
    def total(self) -> int:
        """All contacts."""
        return self.robot_robot + self.robot_box + self.robot_wall + self.robot_door + self.robot_walker

    def add(self, kind: Kind) -> None:
        """Count a contact of a robot."""
        name = f"robot_{kind.name.lower()}"
        setattr(self, name, getattr(self, name) + 1)


class ContactWatch:
    """Counts contacts in a physics space.

    Args:
        space: The space.
        robots: The world's robots by id.
    """

    def __init__(self, space: pymunk.Space, robots: Mapping[str, SimulatedRobot]) -> None:
        self.collisions = Collisions()
        self._robots = robots
        self._touching: dict[str, dict[pymunk.Shape, float]] = {}
        for kind in Kind:
            space.on_collision(Kind.ROBOT, kind, begin=self._begin, separate=self._end)

    def bearings(self, robot: str) -> list[float]:
        """Return the directions in which something touches a robot, radians in its frame."""
        return list(self._touching.get(robot, {}).values())

    def reset(self) -> None:
        """Forget all contacts."""
        self.collisions = Collisions()
        self._touching.clear()

    def _begin(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: object) -> None:
        sides = self._sides(arbiter)
        points = arbiter.contact_point_set.points
        causes = False
        for robot, shape in sides:
            x, y = robot.body.position
            place = points[0].point_a if points else shape.center_of_gravity
            direction = atan2(place.y - y, place.x - x)
            self._touching.setdefault(robot.id, {})[shape] = wrap(direction - robot.body.angle)
            speed_x, speed_y = robot.pushed
            causes = causes or speed_x * cos(direction) + speed_y * sin(direction) > MOVES_TOWARDS
        kinds = {Kind(shape.collision_type) for shape in arbiter.shapes}
        self.collisions.add((kinds - {Kind.ROBOT} or {Kind.ROBOT}).pop())
        self.collisions.own_motion += causes

    def _end(self, arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: object) -> None:
        for robot, shape in self._sides(arbiter):
            self._touching.get(robot.id, {}).pop(shape, None)

    def _sides(self, arbiter: pymunk.Arbiter) -> list[tuple[SimulatedRobot, pymunk.Shape]]:
        """Return each robot of a contact with the shape that it touches."""
        first, second = arbiter.shapes
        found = []
        for own, other in ((first, second), (second, first)):
            robot = next((robot for robot in self._robots.values() if robot.shape is own), None)
            if robot is not None:
                found.append((robot, other))
        return found


def separation(places: Floats) -> float:
    """Return the smallest distance between the hulls of two robots, metres; ``inf`` with fewer than two.

    Args:
        places: x, y and radius of each robot, shape (N, 3), metres.
    """
    middles, radii = places[:, :2], places[:, 2]
    apart = np.hypot(*(middles[:, None, :] - middles[None, :, :]).transpose(2, 0, 1))
    apart -= radii[:, None] + radii[None, :]
    np.fill_diagonal(apart, inf)
    return float(apart.min(initial=inf))
