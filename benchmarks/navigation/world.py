"""A world for navigation: walls, boxes, walkers, and a robot with limited accelerations. Without physics.

The robot is a disc. Nothing pushes it: where it would enter a wall, a box or a walker, the step is counted as
a contact and undone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, cos, hypot, inf, pi, sin
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
WALKER_RADIUS = 0.25
LOOK = 0.35
"""A walker stops if the robot or a wall is this near in front of it, metres."""
STOPPED_AT_MOST = 1.5
"""Seconds after which a walker that was stopped goes elsewhere."""
OWN_MOTION = 0.02
"""A contact is the robot's own if it moves towards the other by more than this, m/s."""


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


@dataclass(slots=True)
class Walker:
    """A person who walks from place to place, and stops for what is in front."""

    x: float
    y: float
    goal: tuple[float, float]
    speed: float
    velocity: tuple[float, float] = (0.0, 0.0)
    stopped_for: float = 0.0


@dataclass
class World:
    """The floor and what is on it.

    Attributes:
        walls: Rectangles ``(left, low, right, high)`` that are on the map, metres.
        boxes: Those that are not.
        walkers: The persons.
        pose: True pose of the robot.
        rng: Source of all randomness.
        size: Size of the floor, metres.
        twist: True speeds of the robot.
        time: Seconds.
        contacts: Contacts by the robot's own motion.
        pushed: Contacts that a walker caused.
        driven: Length of the robot's way, metres.
    """

    walls: list[Rectangle]
    boxes: list[Rectangle]
    walkers: list[Walker]
    pose: Pose
    rng: np.random.Generator
    model: RobotModel = field(default_factory=RobotModel)
    lidar: LidarSpec = field(default_factory=LidarSpec)
    size: tuple[float, float] = (WIDTH, HEIGHT)
    twist: Twist = field(default_factory=Twist)
    time: float = 0.0
    contacts: int = 0
    pushed: int = 0
    driven: float = 0.0

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
        circles = np.array([(one.x, one.y, WALKER_RADIUS) for one in self.walkers], np.float64).reshape(-1, 3)
        ranges = cast(self.lidar, (self.pose.x, self.pose.y), self.pose.yaw, self.edges, circles)
        hit = ranges < self.lidar.max_range
        noisy = ranges + self.lidar.noise * self.rng.standard_normal(len(ranges))
        return np.where(hit, np.maximum(noisy, 0.01), inf)

    def step(self, dt: float) -> None:
        """Let time pass."""
        self._walk(dt)
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
        self._touch(moved, vx, vy, dt)
        self.time += dt

    def clearance(self, x: float, y: float, *, walkers: bool = True) -> float:
        """Return the distance from a point to the nearest wall, box or walker, metres."""
        left, low, right, high = self._rectangles.T
        away = np.hypot(
            np.maximum(np.maximum(left - x, x - right), 0), np.maximum(np.maximum(low - y, y - high), 0)
        )
        nearest = float(away.min(initial=inf))
        for one in self.walkers if walkers else ():
            nearest = min(nearest, hypot(one.x - x, one.y - y) - WALKER_RADIUS)
        return nearest

    def map(self) -> OccupancyMap:
        """Return the map of the walls."""
        return OccupancyMap(drawn(self.walls, PIXEL, self.size), PIXEL, Pose(0.0, 0.0, 0.0))

    def _touch(self, moved: Pose, vx: float, vy: float, dt: float) -> None:
        before = self.clearance(self.pose.x, self.pose.y)
        after = self.clearance(moved.x, moved.y)
        touches = after < self.model.radius
        if touches and not self._touching:
            if before - after > OWN_MOTION * dt and hypot(vx, vy) > OWN_MOTION:
                self.contacts += 1
            else:
                self.pushed += 1
        self._touching = touches
        if touches and after < before:
            self.twist = Twist(0.0, self.twist.turn_rate)
            self.pose = Pose(self.pose.x, self.pose.y, moved.yaw)
            return
        self.driven += hypot(moved.x - self.pose.x, moved.y - self.pose.y)
        self.pose = moved

    def _walk(self, dt: float) -> None:
        for one in self.walkers:
            dx, dy = one.goal[0] - one.x, one.goal[1] - one.y
            away = hypot(dx, dy)
            if away < one.speed * dt or one.stopped_for > STOPPED_AT_MOST:
                one.goal, one.stopped_for = self._somewhere(), 0.0
                continue
            ux, uy = dx / away, dy / away
            if self._is_in_the_way(one, ux, uy):
                one.stopped_for += dt
                one.velocity = (0.0, 0.0)
                continue
            one.stopped_for = 0.0
            one.velocity = (ux * one.speed, uy * one.speed)
            one.x += one.velocity[0] * dt
            one.y += one.velocity[1] * dt

    def _is_in_the_way(self, one: Walker, ux: float, uy: float) -> bool:
        rx, ry = self.pose.x - one.x, self.pose.y - one.y
        gap = hypot(rx, ry) - WALKER_RADIUS - self.model.radius
        if gap < LOOK and rx * ux + ry * uy > 0:
            return True
        ahead = (one.x + ux * LOOK, one.y + uy * LOOK)
        return self.clearance(*ahead, walkers=False) < WALKER_RADIUS

    def _somewhere(self) -> tuple[float, float]:
        return float(self.rng.uniform(0.6, WIDTH - 0.6)), float(self.rng.uniform(0.6, HEIGHT - 0.6))


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


def random_world(seed: int, *, walkers: int = 3) -> World:
    """Return a floor with walls and boxes, some of which are not on the map, and walkers."""
    rng = np.random.default_rng(seed)
    edge = 0.1
    walls: list[Rectangle] = [
        (0.0, 0.0, WIDTH, edge),
        (0.0, HEIGHT - edge, WIDTH, HEIGHT),
        (0.0, 0.0, edge, HEIGHT),
        (WIDTH - edge, 0.0, WIDTH, HEIGHT),
    ]
    # A wall across with a door, as in an office.
    across, door = float(rng.uniform(3.5, 6.5)), float(rng.uniform(1.0, HEIGHT - 2.0))
    walls += [(across, 0.0, across + edge, door), (across, door + 0.9, across + edge, HEIGHT)]
    known = [_box(rng) for _ in range(int(rng.integers(4, 9)))]
    hidden = [_box(rng) for _ in range(int(rng.integers(2, 5)))]
    persons = [
        Walker(
            float(rng.uniform(1, WIDTH - 1)),
            float(rng.uniform(1, HEIGHT - 1)),
            (float(rng.uniform(1, WIDTH - 1)), float(rng.uniform(1, HEIGHT - 1))),
            float(rng.uniform(0.4, 1.2)),
        )
        for _ in range(walkers)
    ]
    world = World([*walls, *known], hidden, [], Pose(0.0, 0.0, 0.0), rng)
    x, y = free_place(world)
    world.pose = Pose(x, y, float(rng.uniform(-pi, pi)))
    world.walkers += [
        one
        for one in persons
        if hypot(one.x - x, one.y - y) > 1.0 and world.clearance(one.x, one.y, walkers=False) > WALKER_RADIUS
    ]
    return world


def _box(rng: np.random.Generator) -> Rectangle:
    x, y = float(rng.uniform(0.5, WIDTH - 1.2)), float(rng.uniform(0.5, HEIGHT - 1.2))
    return x, y, x + float(rng.uniform(0.3, 0.9)), y + float(rng.uniform(0.3, 0.9))


def free_place(world: World) -> tuple[float, float]:
    """Return a random place at which the robot has room."""
    while True:
        x, y = float(world.rng.uniform(0.4, WIDTH - 0.4)), float(world.rng.uniform(0.4, HEIGHT - 0.4))
        if world.clearance(x, y) > world.model.radius + 0.15:
            return x, y


def heading(start: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the direction from one point to another."""
    return atan2(end[1] - start[1], end[0] - start[0])


def _limited(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _approach(value: float, wanted: float, step: float) -> float:
    return value + max(-step, min(step, wanted - value))
