"""Worlds of straight walls for tests of mapping: exact ranges, and drives with wrong odometry."""

from __future__ import annotations

from itertools import pairwise
from math import inf, pi
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.records import LaserRecord

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Walls = Sequence[tuple[float, float, float, float]]
    Poses = NDArray[np.float64]


def polyline(*corners: tuple[float, float], closed: bool = False) -> list[tuple[float, float, float, float]]:
    """Return the walls along corners."""
    ends = [*corners, corners[0]] if closed else list(corners)
    return [(*one, *two) for one, two in pairwise(ends)]


def box(x: float, y: float, width: float, height: float) -> list[tuple[float, float, float, float]]:
    """Return the four walls of a box with its lower left corner at (x, y)."""
    return polyline((x, y), (x + width, y), (x + width, y + height), (x, y + height), closed=True)


def ranges_at(
    walls: Walls,
    pose: NDArray[np.float64],
    angles: NDArray[np.float64],
    farthest: float,
) -> NDArray[np.float64]:
    """Return exact ranges from a pose, shape (B,); ``inf`` beyond ``farthest``."""
    ends = np.asarray(walls, float)
    directions = np.column_stack((np.cos(angles + pose[2]), np.sin(angles + pose[2])))
    along = ends[:, 2:] - ends[:, :2]
    start = ends[:, :2] - pose[:2]
    cross = directions[:, None, 0] * along[:, 1] - directions[:, None, 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
        share = (start[:, 0] * directions[:, None, 1] - start[:, 1] * directions[:, None, 0]) / cross
        seen = (distance > 0) & (share >= 0) & (share <= 1) & (distance <= farthest)
    ranges: NDArray[np.float64] = np.where(seen, distance, inf).min(1)
    return ranges


def scan_at(
    walls: Walls,
    pose: Sequence[float] | NDArray[np.float64],
    *,
    index: int = 0,
    odometry: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
    beams: int = 181,
    field_of_view: float = pi,
    farthest: float = 12.0,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> LaserRecord:
    """Return a scan of walls from a pose."""
    increment = field_of_view / (beams - 1)
    angles = np.asarray(-field_of_view / 2 + increment * np.arange(beams), np.float64)
    ranges = ranges_at(walls, np.asarray(pose, float), angles, farthest)
    if noise and rng is not None:
        ranges = ranges + rng.normal(0, noise, beams)
    x, y, yaw = (float(value) for value in odometry)
    return LaserRecord(index, 0.2 * index, ranges, -field_of_view / 2, increment, farthest, (x, y, yaw))


def drive(corners: Iterable[tuple[float, float]], step: float = 0.2) -> NDArray[np.float64]:
    """Return poses along corners: straight ahead in steps, and turns on the spot in steps of 0.2 rad."""
    points = [np.array(corner, float) for corner in corners]
    yaw = float(np.arctan2(*(points[1] - points[0])[::-1]))
    poses = [(*points[0], yaw)]
    for one, two in pairwise(points):
        goal = float(np.arctan2(*(two - one)[::-1]))
        turn = (goal - yaw + pi) % (2 * pi) - pi
        turns = int(abs(turn) / 0.2)
        poses += [(*one, yaw + turn * part / turns) for part in range(1, turns + 1)]
        yaw = goal
        steps = round(float(np.hypot(*(two - one))) / step)
        poses += [(*(one + (two - one) * part / steps), yaw) for part in range(1, steps + 1)]
    return np.array(poses)


def wrong_odometry(
    poses: NDArray[np.float64], rng: np.random.Generator, *, shift: float = 0.05, turn: float = 0.05
) -> NDArray[np.float64]:
    """Return dead reckoning from the origin with errors that are shares of way and turn."""
    odometry = [np.zeros(3)]
    for one, two in pairwise(poses):
        moved = relative(one, two)
        way = float(np.hypot(moved[0], moved[1]))
        error = rng.normal(0, 1, 3) * (shift * way, shift * way, turn * (abs(moved[2]) + 0.3 * way))
        odometry.append(compose(odometry[-1], moved + error))
    return np.array(odometry)


def drive_log(
    walls: Walls,
    poses: NDArray[np.float64],
    rng: np.random.Generator,
    **options: float,
) -> list[LaserRecord]:
    """Return the scans of a drive with wrong odometry."""
    odometry = wrong_odometry(poses, rng)
    return [
        scan_at(walls, pose, index=index, odometry=odometry[index], noise=0.01, rng=rng, **options)  # type: ignore[arg-type]  # beams is whole
        for index, pose in enumerate(poses)
    ]
