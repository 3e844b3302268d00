"""The floor, the robot and the sensors of the localization's benchmark: exact, kinematic, seeded."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, inf, pi, radians, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.scan import LaserScan
from rce_fleet.maps.occupancy_map import FREE, OCCUPIED, OccupancyMap
from rce_fleet.navigation.navigation import DriveLimits, Navigator

if TYPE_CHECKING:
    from numpy.typing import NDArray

RESOLUTION = 0.05
SIZE = 8.0
"""Edge of the floor, metres."""
BOX = 0.5
RADIUS = 0.177
STEP_S = 0.1

Rectangle = tuple[float, float, float, float]
WALLS: tuple[Rectangle, ...] = (
    (-0.1, -0.1, SIZE + 0.1, 0.0),
    (-0.1, SIZE, SIZE + 0.1, SIZE + 0.1),
    (-0.1, -0.1, 0.0, SIZE + 0.1),
    (SIZE, -0.1, SIZE + 0.1, SIZE + 0.1),
    (2.9, 0.0, 3.0, 2.4),  # a wall from the lower side
    (0.0, 5.0, 1.6, 5.1),  # a room on the left, with a door
    (2.6, 5.0, 3.4, 5.1),
    (3.4, 5.0, 3.5, SIZE),
    (5.5, 3.2, 6.4, 4.1),  # a pillar
    (7.4, 5.6, SIZE, 6.7),  # what is left beside an alcove
    (5.2, 7.5, 6.0, SIZE),
)


@dataclass(frozen=True, slots=True)
class Sensor:
    """A planar range sensor: radians, metres."""

    beams: int = 360
    angle_min: float = -pi
    field: float = 2 * pi
    range_min: float = 0.1
    range_max: float = 8.0
    noise: float = 0.01
    dropout: float = 0.01

    @property
    def increment(self) -> float:
        """Angle between two beams."""
        return self.field / (self.beams if self.field > 6 else self.beams - 1)


LIDAR = Sensor()
DEPTH_CAMERA = Sensor(640, -radians(29), radians(58), 0.45, 10.0, 0.02, 0.02)


class Floor:
    """Walls and boxes, one in ten of which is not on the map."""

    def __init__(self, rng: np.random.Generator, *, boxes: int = 10) -> None:
        self.solid = list(WALLS)
        placed: list[Rectangle] = []
        while len(placed) < boxes:
            x, y = rng.uniform(0.6, SIZE - 0.6 - BOX, 2)
            box = (x, y, x + BOX, y + BOX)
            if all(_apart(box, other) >= 2 * RADIUS + 0.3 for other in (*WALLS[4:], *placed)):
                placed.append(box)
        unmapped = boxes // 10
        self.grid = draw_map((*WALLS, *placed[unmapped:]))
        self.solid += placed
        self.segments = np.array([edge for each in self.solid for edge in _edges(each)])

    def is_free(self, x: float, y: float, room: float) -> bool:
        """Return whether a disc of radius ``room`` is free."""
        return all(_away(each, x, y) > room for each in self.solid)

    def scan(self, pose: Pose, sensor: Sensor, rng: np.random.Generator) -> LaserScan:
        """Return a scan at a pose."""
        ranges = cast(self.segments, pose, sensor)
        ranges = np.where(np.isfinite(ranges), ranges + sensor.noise * rng.standard_normal(sensor.beams), inf)
        ranges[(ranges > sensor.range_max) | (rng.random(sensor.beams) < sensor.dropout)] = inf
        ranges[ranges < sensor.range_min] = inf
        return LaserScan(ranges, sensor.angle_min, sensor.increment, sensor.range_min, sensor.range_max)


def cast(segments: NDArray[np.float64], pose: Pose, sensor: Sensor) -> NDArray[np.float64]:
    """Return exact ranges: each beam with each edge."""
    angles = pose.yaw + sensor.angle_min + sensor.increment * np.arange(sensor.beams)
    dx, dy = np.cos(angles)[:, None], np.sin(angles)[:, None]
    ax, ay, bx, by = (segments - (pose.x, pose.y, pose.x, pose.y)).T
    ex, ey = bx - ax, by - ay
    with np.errstate(divide="ignore", invalid="ignore"):
        across = dx * ey - dy * ex
        far = (ax * ey - ay * ex) / across
        share = (ax * dy - ay * dx) / across
        far = np.where((share >= 0) & (share <= 1) & (far > 0), far, inf)
    return np.asarray(far.min(axis=1))


def draw_map(solid: tuple[Rectangle, ...]) -> OccupancyMap:
    """Return the map of these rectangles, 5 cm a cell."""
    margin = 0.5
    count = round((SIZE + 2 * margin) / RESOLUTION)
    data = np.full((count, count), FREE, np.int8)
    centres = -margin + (np.arange(count) + 0.5) * RESOLUTION
    for left, low, right, high in solid:
        inside_x = (centres >= left) & (centres < right)
        inside_y = (centres >= low) & (centres < high)
        data[np.ix_(inside_y, inside_x)] = OCCUPIED
    outside = (centres < -0.1) | (centres > SIZE + 0.1)
    data[outside] = -1
    data[:, outside] = -1
    return OccupancyMap(data, RESOLUTION, Pose(-margin, -margin, 0.0))


class Robot:
    """A TurtleBot that drives between random places, and its wrong odometry."""

    def __init__(self, floor: Floor, rng: np.random.Generator) -> None:
        self.floor, self.rng = floor, rng
        self.pose = self._place()
        self.odometry = Pose(0.0, 0.0, 0.0)
        self.time = 0.0
        self._navigator = Navigator(DriveLimits(speed=0.5, acceleration=0.6, turn_rate=1.2))
        self._way_scale, self._turn_scale = 1 + 0.02 * rng.standard_normal(2)

    def step(self) -> None:
        """Drive for a tenth of a second."""
        if self._navigator.done or not self._navigator.waypoints:
            self._navigator.follow([self._next_place()])
        for _ in range(5):
            twist = self._navigator.update(self.pose, STEP_S / 5)
            way, turn = twist.speed * STEP_S / 5, twist.turn_rate * STEP_S / 5
            self.pose = _moved(self.pose, way, turn)
            way = way * self._way_scale + self.rng.standard_normal() * 0.02 * sqrt(abs(way))
            turn = turn * self._turn_scale + self.rng.standard_normal() * 0.02 * sqrt(abs(turn))
            self.odometry = _moved(self.odometry, way, turn)
        self.time += STEP_S

    def kidnap(self) -> None:
        """Put the robot somewhere else; its wheels do not notice."""
        before = self.pose
        while hypot(self.pose.x - before.x, self.pose.y - before.y) < 2:
            self.pose = self._place()
        self._navigator.follow([])

    def _place(self) -> Pose:
        while True:
            x, y = self.rng.uniform(0.3, SIZE - 0.3, 2)
            if self.floor.is_free(x, y, RADIUS + 0.1):
                return Pose(float(x), float(y), float(self.rng.uniform(-pi, pi)))

    def _next_place(self) -> tuple[float, float]:
        """Choose a place that a straight way leads to."""
        for _ in range(2000):
            place = self._place()
            away = hypot(place.x - self.pose.x, place.y - self.pose.y)
            if away < 0.5:
                continue
            bearing = atan2(place.y - self.pose.y, place.x - self.pose.x)
            if all(
                self.floor.is_free(
                    self.pose.x + cos(bearing) * d, self.pose.y + sin(bearing) * d, RADIUS + 0.03
                )
                for d in np.arange(0.05, away, 0.05)
            ):
                return place.x, place.y
        raise RuntimeError(f"no way out of {self.pose}")


def _moved(pose: Pose, way: float, turn: float) -> Pose:
    yaw = pose.yaw + turn / 2
    return Pose(pose.x + way * cos(yaw), pose.y + way * sin(yaw), wrap(pose.yaw + turn))


def _edges(each: Rectangle) -> list[Rectangle]:
    left, low, right, high = each
    return [
        (left, low, right, low),
        (right, low, right, high),
        (right, high, left, high),
        (left, high, left, low),
    ]


def _away(each: Rectangle, x: float, y: float) -> float:
    left, low, right, high = each
    return hypot(max(left - x, 0.0, x - right), max(low - y, 0.0, y - high))


def _apart(a: Rectangle, b: Rectangle) -> float:
    return hypot(max(a[0] - b[2], b[0] - a[2], 0.0), max(a[1] - b[3], b[1] - a[3], 0.0))
