"""What a robot's lidar says about the way ahead."""

from __future__ import annotations

from math import ceil, cos, hypot, inf, sin
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rce_fleet.navigation.navigation import Pose
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.simulation.lidar import Floats, LidarSpec


def hit_points(spec: LidarSpec, ranges: Floats, pose: Pose) -> Floats:
    """Places where beams hit something, shape (N, 2), metres in the map.

    Args:
        spec: The lidar.
        ranges: One scan, shape (beams,).
        pose: Where the robot was.
    """
    hit = ranges < spec.max_range
    angles = spec.angles()[hit] + pose.yaw
    return np.stack((pose.x + ranges[hit] * np.cos(angles), pose.y + ranges[hit] * np.sin(angles)), axis=1)


def clear_ahead(points: Floats, pose: Pose, radius: float) -> float:
    """Free distance ahead of a robot's hull, metres; ``inf`` if nothing lies ahead.

    Args:
        points: What the lidar hit, shape (N, 2), metres.
        pose: Where the robot is.
        radius: Of its hull.
    """
    dx, dy = points[:, 0] - pose.x, points[:, 1] - pose.y
    along = dx * cos(pose.yaw) + dy * sin(pose.yaw)
    across = dy * cos(pose.yaw) - dx * sin(pose.yaw)
    ahead = along[(np.abs(across) < radius) & (along > 0)]
    return float(ahead.min()) - radius if len(ahead) else inf


def cells_ahead(grid: GridMap, pose: Pose, goal: tuple[float, float]) -> list[int]:
    """Cells on the straight way to ``goal`` (metres), without the robot's own, in order."""
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
    """The first cell on the way to ``goal`` with an obstacle well inside.

    Args:
        grid: The map.
        points: What the lidar hit, shape (N, 2), metres.
        pose: Where the robot is.
        goal: Where it drives, metres.
        sight: How far ahead it looks, metres.
        margin: Hits nearer than this to a cell's edge, metres, may belong to what stands beside it.
    """
    near = points[np.hypot(points[:, 0] - pose.x, points[:, 1] - pose.y) <= sight]
    reach = grid.cell_size / 2 - margin
    for cell in cells_ahead(grid, pose, goal):
        x, y = grid.centre(cell)
        inside = (np.abs(near[:, 0] - x) < reach) & (np.abs(near[:, 1] - y) < reach)
        if np.count_nonzero(inside) >= _ENOUGH:
            return cell
    return None


_ENOUGH = 3
"""Beams that have to agree."""
