"""Obstacles on a robot's way, from its lidar scans."""

from __future__ import annotations

from math import ceil, cos, hypot, inf, sin
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rce_fleet.geometry.poses import Pose
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.simulation.lidar import Floats, LidarSpec


def hit_points(spec: LidarSpec, ranges: Floats, pose: Pose) -> Floats:
    """Return the points that beams hit, shape (N, 2), metres in the map.

    Args:
        spec: The lidar.
        ranges: One scan, shape (beams,); infinite or NaN where a beam found nothing.
        pose: Pose of the robot at the time of the scan.
    """
    hit = ranges < spec.max_range
    x, y, yaw = spec.poses(pose.as_array()[None])[0]
    angles = spec.angles()[hit] + yaw
    return np.stack((x + ranges[hit] * np.cos(angles), y + ranges[hit] * np.sin(angles)), axis=1)


def clear_ahead(points: Floats, pose: Pose, radius: float) -> float:
    """Return the free distance ahead of a robot's hull, metres; ``inf`` if nothing is ahead.

    Args:
        points: Points of a lidar scan, shape (N, 2), metres.
        pose: Pose of the robot.
        radius: Radius of its hull, metres.
    """
    dx, dy = points[:, 0] - pose.x, points[:, 1] - pose.y
    along = dx * cos(pose.yaw) + dy * sin(pose.yaw)
    across = dy * cos(pose.yaw) - dx * sin(pose.yaw)
    ahead = along[(np.abs(across) < radius) & (along > 0)]
    return float(ahead.min()) - radius if len(ahead) else inf


def cells_ahead(grid: GridMap, pose: Pose, goal: tuple[float, float]) -> list[int]:
    """Return the cells on the straight line to ``goal`` (metres) in order, without the robot's own."""
    away = hypot(goal[0] - pose.x, goal[1] - pose.y)
    count = max(1, ceil(away / (grid.cell_size / 8)))
    cells: list[int] = []
    for step in range(1, count + 1):
        part = step / count
        cell = grid.cell_at(pose.x + (goal[0] - pose.x) * part, pose.y + (goal[1] - pose.y) * part)
        if cell is not None and cell not in cells and cell != grid.cell_at(pose.x, pose.y):
            cells.append(cell)
    return cells


def blocked_cell(
    grid: GridMap, points: Floats, pose: Pose, goal: tuple[float, float], *, sight: float, margin: float
) -> int | None:
    """Return the first cell on the line to ``goal`` that has an obstacle inside; None if there is none.

    Args:
        grid: The map.
        points: Points of a lidar scan, shape (N, 2), metres.
        pose: Pose of the robot.
        goal: The point it drives to, metres.
        sight: Maximum distance of the points to use, metres.
        margin: Ignore points this close to a cell's edge, metres: they may belong to the next cell.
    """
    near = points[np.hypot(points[:, 0] - pose.x, points[:, 1] - pose.y) <= sight]
    reach = grid.cell_size / 2 - margin
    c, s = cos(grid.yaw), sin(grid.yaw)
    for cell in cells_ahead(grid, pose, goal):
        x, y = grid.centre(cell)
        dx, dy = near[:, 0] - x, near[:, 1] - y
        inside = (np.abs(c * dx + s * dy) < reach) & (np.abs(c * dy - s * dx) < reach)
        if np.count_nonzero(inside) >= _ENOUGH:
            return cell
    return None


_ENOUGH = 3
"""Minimum number of lidar points in a cell."""
