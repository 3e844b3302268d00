"""A world of rectangles for tests of navigation: walls, boxes, and a robot with limited accelerations.

It has no physics, so that a test can compute where the robot is. The robot is a disc. A step that would take
it into a wall or a box is counted as a contact and undone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import cos, inf, pi, sin
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.simulation.lidar import LidarSpec, cast

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Rectangle = tuple[float, float, float, float]
"""Left, low, right and high sides, metres."""
WIDTH, HEIGHT = 10.0, 8.0
"""Size of the floor, metres."""
PIXEL = 0.05
"""Edge of a pixel of the map, metres."""


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A TurtleBot 2: metres, seconds."""

    radius: float = 0.177
    speed: float = 0.65
    turn_rate: float = pi
    acceleration: float = 1.0
    turn_acceleration: float = 5.0
    delay: float = 0.05
    """Time until a command takes effect."""


@dataclass
class World:
    """The floor and what is on it.

    Attributes:
        walls: Rectangles ``(left, low, right, high)`` that are on the map, metres.
        boxes: Those that are not.
        pose: True pose of the robot.
        rng: Source of all randomness.
        size: Size of the floor, metres.
        twist: True speeds of the robot.
        time: Seconds.
        contacts: How often the robot touched a wall or a box.
    """

    walls: list[Rectangle]
    boxes: list[Rectangle]
    pose: Pose
    rng: np.random.Generator
    model: RobotModel = field(default_factory=RobotModel)
    lidar: LidarSpec = field(default_factory=LidarSpec)
    size: tuple[float, float] = (WIDTH, HEIGHT)
    twist: Twist = field(default_factory=Twist)
    time: float = 0.0
    contacts: int = 0

    def __post_init__(self) -> None:
        self._commands: list[tuple[float, Twist]] = []
        self._rectangles = np.array([*self.walls, *self.boxes], np.float64).reshape(-1, 4)
        self.edges = edges_of([*self.walls, *self.boxes])
        self._touching = False

    def drive(self, twist: Twist) -> None:
        """Send a command to the wheels."""
        self._commands.append((self.time + self.model.delay, twist))

    def scan(self) -> Floats:
        """Return a noisy scan of the lidar, shape (beams,); ``inf`` where nothing was hit."""
        here = (self.pose.x, self.pose.y)
        ranges = cast(self.lidar, here, self.pose.yaw, self.edges, np.empty((0, 3)))
        hit = ranges < self.lidar.max_range
        noisy = ranges + self.lidar.noise * self.rng.standard_normal(len(ranges))
        return np.where(hit, np.maximum(noisy, 0.01), inf)

    def step(self, dt: float) -> None:
        """Let time pass."""
        while len(self._commands) > 1 and self._commands[1][0] <= self.time:
            del self._commands[0]
        wanted = self._commands[0][1] if self._commands and self._commands[0][0] <= self.time else Twist()
        model = self.model
        self.twist = Twist(
            _approach(self.twist.speed, _limited(wanted.speed, model.speed), model.acceleration * dt),
            _approach(
                self.twist.turn_rate,
                _limited(wanted.turn_rate, model.turn_rate),
                model.turn_acceleration * dt,
            ),
        )
        middle = self.pose.yaw + self.twist.turn_rate * dt / 2
        vx, vy = self.twist.speed * cos(middle), self.twist.speed * sin(middle)
        moved = Pose(
            self.pose.x + vx * dt, self.pose.y + vy * dt, wrap(self.pose.yaw + self.twist.turn_rate * dt)
        )
        self._touch(moved)
        self.time += dt

    def clearance(self, x: float, y: float) -> float:
        """Return the distance from a point to the nearest wall or box, metres."""
        left, low, right, high = self._rectangles.T
        away = np.hypot(
            np.maximum(np.maximum(left - x, x - right), 0), np.maximum(np.maximum(low - y, y - high), 0)
        )
        return float(away.min(initial=inf))

    def map(self) -> OccupancyMap:
        """Return the map of the walls."""
        return OccupancyMap(drawn(self.walls, PIXEL, self.size), PIXEL, Pose(0.0, 0.0, 0.0))

    def _touch(self, moved: Pose) -> None:
        before = self.clearance(self.pose.x, self.pose.y)
        after = self.clearance(moved.x, moved.y)
        touches = after < self.model.radius
        self.contacts += touches and not self._touching
        self._touching = touches
        if touches and after < before:
            self.twist = Twist(0.0, self.twist.turn_rate)
            self.pose = Pose(self.pose.x, self.pose.y, moved.yaw)
            return
        self.pose = moved


def edges_of(rectangles: list[Rectangle]) -> Floats:
    """Return the edges of rectangles, shape (4 N, 4)."""
    edges = [
        edge
        for left, low, right, high in rectangles
        for edge in (
            (left, low, right, low),
            (right, low, right, high),
            (right, high, left, high),
            (left, high, left, low),
        )
    ]
    return np.array(edges, np.float64).reshape(-1, 4)


def drawn(
    rectangles: list[Rectangle], pixel: float, size: tuple[float, float] = (WIDTH, HEIGHT)
) -> NDArray[np.int8]:
    """Return an occupancy grid of a floor in which rectangles are occupied."""
    picture = np.zeros((round(size[1] / pixel), round(size[0] / pixel)), np.int8)
    for left, low, right, high in rectangles:
        rows = slice(max(0, int(np.floor(low / pixel + 1e-6))), max(0, int(np.ceil(high / pixel - 1e-6))))
        columns = slice(
            max(0, int(np.floor(left / pixel + 1e-6))), max(0, int(np.ceil(right / pixel - 1e-6)))
        )
        picture[rows, columns] = 100
    return picture


def _limited(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _approach(value: float, wanted: float, step: float) -> float:
    return value + max(-step, min(step, wanted - value))
