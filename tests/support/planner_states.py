"""States and changes of a fleet as the planner sends them."""

from __future__ import annotations

from math import cos, sin
from typing import Any


def robot(name: str, **changes: object) -> dict[str, Any]:
    """A robot that stands in cell 3, if nothing else is given."""
    known = {
        "id": name,
        "state": "idle",
        "reason": "",
        "cell": 3,
        "goal": -1,
        "plan": [],
        "granted": [],
        "replans": 0,
    }
    return known | changes


def state(*robots: dict[str, Any], **changes: object) -> dict[str, Any]:
    """The whole state of a fleet in a hall of 8 x 8 cells of 1 m."""
    grid = {"rows": 8, "columns": 8, "cell_size": 1.0, "origin_x": 0.0, "origin_y": 0.0}
    return {**grid, "blocked": [], "walls": [], "pending": [], "robots": list(robots), **changes}


def pose(x: float, y: float, yaw: float) -> dict[str, Any]:
    """A robot's pose in the map (m, rad), as a `PoseWithCovarianceStamped`."""
    orientation = {"x": 0.0, "y": 0.0, "z": sin(yaw / 2), "w": cos(yaw / 2)}
    return {"pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": orientation}}}


def changes(*robots: dict[str, Any], **parts: object) -> dict[str, Any]:
    """What has changed since the state or changes before."""
    return {"robots": list(robots), "removed": [], "blocked": [], "pending": [], "freed": [], **parts}


def block(cell: int, by: str, **more: object) -> dict[str, Any]:
    """A blocked cell, and who blocked it."""
    return {"cell": cell, "sensed": False, "by": by, "reason": "", "age": 10.0, "lifetime": 0.0, **more}
