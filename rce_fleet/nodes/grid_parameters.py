"""The map that the fleet's nodes get by parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import read_map

if TYPE_CHECKING:
    from collections.abc import Mapping


def make_grid(values: Mapping[str, Any]) -> GridMap:
    """Return the map that parameters describe.

    Args:
        values: ``map``, a file, or ``rows``, ``columns``, ``origin_x``, ``origin_y`` (metres) and ``walls``
            (cells); and ``cell_size`` (metres).

    Raises:
        ValueError: They do not describe a map.
        MapError: The map file cannot be read.
        OSError: The map file cannot be opened.
    """
    size = float(values.get("cell_size", 1.0))
    if values.get("map"):
        return read_map(Path(values["map"]), cell_size=size)
    return GridMap(
        rows=int(values.get("rows", 8)),
        columns=int(values.get("columns", 8)),
        cell_size=size,
        origin=(float(values.get("origin_x", 0.0)), float(values.get("origin_y", 0.0))),
        blocked=frozenset(int(cell) for cell in values.get("walls", [])),
    )
