"""The parameters of the fleet's nodes, and the map that they describe."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.fleet_grid import BLOCKED_SHARE, fleet_grid
from rce_fleet.maps.ros_map import load_map
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import MAX_CELLS, read_map

if TYPE_CHECKING:
    from rce.ros.node import Node


GRID_PARAMETERS = frozenset(
    {
        *("rows", "columns", "cell_size", "origin_x", "origin_y", "origin_yaw", "walls"),
        *("map", "map_yaml", "blocked_share"),
    }
)
"""Names of the parameters that describe a grid."""


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
    size = read_number(values, "cell_size", 1.0)
    if values.get("map_yaml"):
        return _grid_over(values, size)
    origin = read_number(values, "origin_x", 0.0), read_number(values, "origin_y", 0.0)
    yaw = read_number(values, "origin_yaw", 0.0)
    if values.get("map"):
        return replace(read_map(Path(str(values["map"])), cell_size=size), origin=origin, yaw=yaw)
    rows, columns = read_count(values, "rows", 8), read_count(values, "columns", 8)
    if rows * columns > MAX_CELLS:
        raise ValueError(
            f"the parameters rows and columns, {rows} and {columns}, make {rows * columns} cells;"
            f" at most {MAX_CELLS} are possible: choose a larger cell_size"
        )
    return GridMap(
        rows=rows,
        columns=columns,
        cell_size=size,
        origin=origin,
        blocked=frozenset(read_cells(values, "walls")),
        yaw=yaw,
    )


def _grid_over(values: Mapping[str, Any], cell_size: float) -> GridMap:
    drawn = load_map(str(values["map_yaml"]))
    grid = fleet_grid(
        drawn,
        cell_size,
        origin=Pose(
            read_number(values, "origin_x", drawn.origin.x),
            read_number(values, "origin_y", drawn.origin.y),
            read_number(values, "origin_yaw", drawn.origin.yaw),
        ),
        rows=read_count(values, "rows", 0) if "rows" in values else None,
        columns=read_count(values, "columns", 0) if "columns" in values else None,
        blocked_share=read_number(values, "blocked_share", BLOCKED_SHARE),
    )
    return grid.with_blocked(grid.blocked.union(read_cells(values, "walls")))


def read_number(values: Mapping[str, Any], name: str, default: float) -> float:
    """Return a parameter that is a finite number.

    Raises:
        ValueError: It is something else; the text names it.
    """
    value = values.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ValueError(f"the parameter {name} must be a number, not {value!r}")
    return float(value)


def read_count(values: Mapping[str, Any], name: str, default: int) -> int:
    """Return a parameter that is a whole number.

    Raises:
        ValueError: It is something else; the text names it.
    """
    value = read_number(values, name, default)
    if not value.is_integer():
        raise ValueError(f"the parameter {name} must be a whole number, not {value!r}")
    return int(value)


def read_cells(values: Mapping[str, Any], name: str) -> list[int]:
    """Return a parameter that is a list of cells.

    Raises:
        ValueError: It is something else; the text names it.
    """
    value = values.get(name, [])
    if not isinstance(value, list | tuple) or any(type(cell) is not int for cell in value):
        raise ValueError(f"the parameter {name} must be a list of cells, such as [9, 20], not {value!r}")
    return list(value)


async def read_fleet_parameters(node: Node) -> dict[str, Any]:
    """Return the parameters of the namespace ``/fleet``, overridden by the node's private ones."""
    values: dict[str, Any] = {}
    for namespace in ("/fleet", "~"):
        found = await node.get_param(namespace, {})
        if isinstance(found, Mapping):
            values.update(found)
    return values


def unknown_parameters(names: Iterable[str], known: Collection[str]) -> list[str]:
    """Return a remark about each name that is not a known parameter, with the nearest known one."""
    unknown = sorted(name for name in names if name not in known)
    return [
        f"unknown parameter {name}; did you mean {difflib.get_close_matches(name, known, 1, 0.0)[0]}?"
        for name in unknown
    ]
