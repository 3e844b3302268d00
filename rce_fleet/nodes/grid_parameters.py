"""The parameters of the fleet's nodes, and the map that they describe."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.fleet_grid import BLOCKED_SHARE, fleet_grid
from rce_fleet.maps.ros_map import load_map
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import read_map

if TYPE_CHECKING:
    from rce.ros.node import Node


def make_grid(values: Mapping[str, Any]) -> GridMap:
    """Return the map that parameters describe.

    Args:
        values: ``map_yaml``, a ROS map, and ``blocked_share``; or ``map``, a MovingAI map; or ``rows``,
            ``columns`` and ``walls`` (cells). And ``cell_size``, ``origin_x``, ``origin_y`` (metres) and
            ``origin_yaw`` (radians). Over a ROS map, size and origin are by default those of the map.

    Raises:
        ValueError: They do not describe a map.
        MapError: The map file cannot be read.
        OSError: The map file cannot be opened.
    """
    size = float(values.get("cell_size", 1.0))
    if values.get("map_yaml"):
        return _grid_over(values, size)
    if values.get("map"):
        return read_map(Path(values["map"]), cell_size=size)
    return GridMap(
        rows=int(values.get("rows", 8)),
        columns=int(values.get("columns", 8)),
        cell_size=size,
        origin=(float(values.get("origin_x", 0.0)), float(values.get("origin_y", 0.0))),
        blocked=frozenset(int(cell) for cell in values.get("walls", [])),
        yaw=float(values.get("origin_yaw", 0.0)),
    )


def _grid_over(values: Mapping[str, Any], cell_size: float) -> GridMap:
    drawn = load_map(values["map_yaml"])
    grid = fleet_grid(
        drawn,
        cell_size,
        origin=Pose(
            float(values.get("origin_x", drawn.origin.x)),
            float(values.get("origin_y", drawn.origin.y)),
            float(values.get("origin_yaw", drawn.origin.yaw)),
        ),
        rows=int(values["rows"]) if "rows" in values else None,
        columns=int(values["columns"]) if "columns" in values else None,
        blocked_share=float(values.get("blocked_share", BLOCKED_SHARE)),
    )
    return grid.with_blocked(grid.blocked.union(int(cell) for cell in values.get("walls", [])))


async def read_fleet_parameters(node: Node) -> dict[str, Any]:
    """Return the parameters of the namespace ``/fleet``, overridden by the node's private ones."""
    values: dict[str, Any] = {}
    for namespace in ("/fleet", "~"):
        found = await node.get_param(namespace, {})
        if isinstance(found, Mapping):
            values.update(found)
    return values
