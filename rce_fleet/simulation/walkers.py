"""People who walk from waypoint to waypoint."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan2, cos, hypot, inf, pi
from typing import TYPE_CHECKING

import pymunk

if TYPE_CHECKING:
    from rce_fleet.simulation.lidar import Floats
    from rce_fleet.simulation.walls import Point

_AHEAD = pi / 3
"""A robot at most this far off the direction of a walker's walk is in front, radians."""
_ARRIVED = 1e-6
"""A walker this near to a waypoint is there, metres."""


@dataclass(frozen=True, slots=True)
class WalkerSpec:
    """How a walker walks.

    Attributes:
        waypoints: Points that are walked to in order, metres; the walker starts at the first.
        speed: Metres per second.
        radius: Radius at the height of the sensors, metres.
        pause: Seconds of standing at each waypoint.
        loop: Whether the first waypoint follows the last; else the way is walked back and forth.
        social_distance: The walker stops for a robot that is this near in front, metres between hulls;
            0: never.
        start: Seconds after which the walker begins to walk.
        patience: A walker who has stopped for a robot for so many seconds goes back to the last waypoint.
    """

    waypoints: tuple[Point, ...]
    speed: float = 1.0
    radius: float = 0.2
    pause: float = 0.0
    loop: bool = True
    social_distance: float = 0.0
    start: float = 0.0
    patience: float = inf


class Walker:
    """A walker in a world. Created by :meth:`rce_fleet.simulation.world.World.add_walker`.

    Attributes:
        id: Name of the walker.
        spec: How the walker walks.
        body: The body in the physics engine; robots do not move it.
        shape: The hull in the physics engine.
        waits: Whether the walker stands because of a robot.
    """

    def __init__(self, walker: str, spec: WalkerSpec) -> None:
        self.id = walker
        self.spec = spec
        self.body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.shape = pymunk.Circle(self.body, spec.radius)
        self.waits = False
        self._next = 0
        self._direction = 1
        self._stands_until = 0.0
        self._waited = 0.0
        self.reset()

    @property
    def position(self) -> tuple[float, float]:
        """Where the walker is, metres."""
        x, y = self.body.position
        return x, y

    def reset(self) -> None:
        """Go back to the first waypoint."""
        self.body.position = self.spec.waypoints[0]
        self.body.velocity = (0.0, 0.0)
        self.waits = False
        self._next, self._direction = min(1, len(self.spec.waypoints) - 1), 1
        self._stands_until = self.spec.start
        self._waited = 0.0

    def put(self, x: float, y: float) -> None:
        """Stand elsewhere, metres; the whole way moves with the walker."""
        before_x, before_y = self.body.position
        ways = tuple((way_x + x - before_x, way_y + y - before_y) for way_x, way_y in self.spec.waypoints)
        self.spec = replace(self.spec, waypoints=ways)
        self.body.position = (x, y)

    def walk(self, now: float, dt: float, robots: Floats) -> None:
        """Choose the velocity for the next ``dt`` seconds.

        Args:
            now: Simulated time, seconds.
            dt: Length of the step, seconds.
            robots: Places and radii of the robots, shape (N, 3), metres.
        """
        spec = self.spec
        x, y = self.body.position
        goal = spec.waypoints[self._next]
        away = hypot(goal[0] - x, goal[1] - y)
        if now + 1e-9 < self._stands_until or not spec.speed:
            self.body.velocity = (0.0, 0.0)
            return
        if away < _ARRIVED:
            self._arrive(now)
            self.body.velocity = (0.0, 0.0)
            return
        self.waits = self._in_front(goal, robots)
        self._waited = self._waited + dt if self.waits else 0.0
        if self._waited > spec.patience:
            self._turn_back()
        pace = 0.0 if self.waits else min(spec.speed, away / dt) / away
        self.body.velocity = (pace * (goal[0] - x), pace * (goal[1] - y))

    def _arrive(self, now: float) -> None:
        count = len(self.spec.waypoints)
        self._stands_until = now + self.spec.pause
        if count == 1:
            return
        if not self.spec.loop and not 0 <= self._next + self._direction < count:
            self._direction = -self._direction
        self._next = (self._next + self._direction) % count

    def _turn_back(self) -> None:
        self._waited = 0.0
        self._direction = -self._direction
        self._next = (self._next + self._direction) % len(self.spec.waypoints)

    def _in_front(self, goal: Point, robots: Floats) -> bool:
        """Return whether a robot is in front, nearer than the social distance."""
        if not self.spec.social_distance:
            return False
        x, y = self.body.position
        heading = atan2(goal[1] - y, goal[0] - x)
        for robot_x, robot_y, radius in robots.tolist():
            gap = hypot(robot_x - x, robot_y - y) - radius - self.spec.radius
            if gap < self.spec.social_distance:
                bearing = atan2(robot_y - y, robot_x - x) - heading
                if cos(bearing) > cos(_AHEAD):
                    return True
        return False
