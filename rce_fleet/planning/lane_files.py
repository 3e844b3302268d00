"""Files with lane graphs, in YAML or JSON.

::

    nodes:                       # names for cells: a cell's number, or a point in it (metres on the map)
      dock: {cell: 0}
      shelf: {x: 6.5, y: 0.5}
    lanes:
      - {name: out, path: [dock, shelf], one_way: true, speed: 0.8, width: 1.2}
      - {name: back, path: [shelf, 62, 56, dock], one_way: true, cost: 2}

A path leads straight, along a row or a column of the grid, from each of its nodes to the next one.
"""

from __future__ import annotations

import json
from itertools import pairwise
from math import isfinite
from typing import TYPE_CHECKING, Any

import yaml

from rce_fleet.exceptions import LanesError
from rce_fleet.limits import LEAST_SPEED, MOST_SPEED
from rce_fleet.planning.lanes import MOST_COST, Lane, LaneGraph

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.planning.grid import GridMap

_KEYS = ("name", "path", "one_way", "speed", "width", "cost")
_MOST_WIDTH = 1000.0


def read_lanes(path: Path, grid: GridMap) -> LaneGraph:
    """Read a file of lanes.

    Args:
        path: The file.
        grid: The grid that the lanes lie on.

    Raises:
        LanesError: The file cannot be read, or its lanes cannot be driven on the grid; the text names file
            and place.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise LanesError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise LanesError(f"{path}: not a text in UTF-8: {error}") from error
    return read_lane_text(text, grid, str(path))


def read_lane_text(text: str, grid: GridMap, source: str) -> LaneGraph:
    """Read the text of a file of lanes.

    Args:
        text: The text.
        grid: The grid that the lanes lie on.
        source: Where it is from, for errors.

    Raises:
        LanesError: It is not YAML or JSON, or its lanes cannot be driven on the grid.
    """
    try:
        found = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        raise LanesError(f"{source}{where}: not YAML or JSON: {getattr(error, 'problem', error)}") from error
    return parse_lanes(found, grid, source)


def parse_lanes(found: object, grid: GridMap, source: str = "") -> LaneGraph:
    """Return the lane graph of a file's contents.

    Args:
        found: The contents, as YAML or JSON have them.
        grid: The grid that the lanes lie on.
        source: Where they are from, for errors.

    Raises:
        LanesError: They are not those of lanes on this grid; the text names the place.
    """
    try:
        return _parse(found, grid)
    except LanesError as error:
        if not source:
            raise
        raise LanesError(f"{source}: {error}") from error


def lane_text(lanes: LaneGraph) -> str:
    """Return the text of a file with these lanes, as JSON."""
    found = []
    for lane in lanes.lanes:
        entry: dict[str, object] = {"name": lane.name, "path": lane.cells, "one_way": lane.one_way}
        limits = {"speed": lane.speed, "width": lane.width, "cost": lane.cost}
        found.append(entry | {name: value for name, value in limits.items() if value})
    return json.dumps({"lanes": found})


def _parse(found: object, grid: GridMap) -> LaneGraph:
    content = _mapping(found, "the file", ("nodes", "lanes"))
    nodes = {
        str(name): _node(node, f"nodes.{name}", grid)
        for name, node in _mapping(content.get("nodes") or {}, "nodes").items()
    }
    listed = content.get("lanes")
    if not isinstance(listed, list) or not listed:
        raise LanesError("lanes: expected a list of lanes, such as [{path: [dock, shelf]}]")
    lanes = [_lane(lane, f"lanes[{index}]", nodes, grid) for index, lane in enumerate(listed)]
    made = LaneGraph(tuple(lanes))
    made.check(grid)
    return made


def _lane(found: object, where: str, nodes: dict[str, int], grid: GridMap) -> Lane:
    lane = _mapping(found, where, _KEYS)
    name = str(lane.get("name", where))
    where = f"{where} ({name})" if "name" in lane else where
    path = lane.get("path")
    if not isinstance(path, list) or len(path) < 2:  # noqa: PLR2004 - a way has two ends
        raise LanesError(f"{where}.path: expected a list of two or more nodes or cells, found {path!r}")
    ends = [_end(end, f"{where}.path[{index}]", nodes, grid) for index, end in enumerate(path)]
    cells = ends[:1]
    for index, (start, end) in enumerate(pairwise(ends), start=1):
        cells += _straight(start, end, f"{where}.path[{index}]", grid)
    one_way = lane.get("one_way", False)
    if not isinstance(one_way, bool):
        raise LanesError(f"{where}.one_way: expected true or false, found {one_way!r}")
    cost = _number(lane, "cost", where, 1, MOST_COST, 1)
    if not cost.is_integer():
        raise LanesError(f"{where}.cost: expected a whole number of 1 .. {MOST_COST}, found {cost:g}")
    return Lane(
        name=name,
        cells=tuple(cells),
        one_way=one_way,
        speed=_number(lane, "speed", where, LEAST_SPEED, MOST_SPEED, 0),
        width=_number(lane, "width", where, LEAST_SPEED, _MOST_WIDTH, 0),
        cost=int(cost),
    )


def _straight(start: int, end: int, where: str, grid: GridMap) -> range:
    """Return the cells after one cell up to another one in its row or column.

    Raises:
        LanesError: It is in neither, or the same cell.
    """
    (row, column), (to_row, to_column) = grid.place(start), grid.place(end)
    if start == end:
        raise LanesError(f"{where}: cell {end} is the one before it; leave it out")
    if row != to_row and column != to_column:
        corners = sorted((grid.cell(row, to_column), grid.cell(to_row, column)))
        raise LanesError(
            f"{where}: cell {end} is neither in the row nor in the column of cell {start}, the one before it;"
            f" name the corner between them too, cell {corners[0]} or {corners[1]}"
        )
    step = (1 if end > start else -1) * (1 if row == to_row else grid.columns)
    return range(start + step, end + step, step)


def _end(found: object, where: str, nodes: dict[str, int], grid: GridMap) -> int:
    """Return the cell of an entry of a path.

    Raises:
        LanesError: It is neither a node nor a cell.
    """
    if isinstance(found, str) and found in nodes:
        return nodes[found]
    if isinstance(found, str):
        known = ", ".join(sorted(nodes)) or "none"
        raise LanesError(f"{where}: unknown node {found!r}; nodes are {known}")
    return _cell(found, where, grid)


def _node(found: object, where: str, grid: GridMap) -> int:
    node = _mapping(found, where, ("cell", "x", "y"))
    if node.keys() == {"cell"}:
        return _cell(node["cell"], f"{where}.cell", grid)
    if node.keys() != {"x", "y"}:
        raise LanesError(f"{where}: expected {{cell: NUMBER}} or {{x: METRES, y: METRES}}, found {found!r}")
    x, y = (_number(node, name, where, -1e9, 1e9, 0) for name in ("x", "y"))
    cell = grid.cell_at(x, y)
    if cell is None:
        raise LanesError(f"{where}: the point ({x:g}, {y:g}) is outside the map")
    return cell


def _cell(found: object, where: str, grid: GridMap) -> int:
    if type(found) is not int or found not in grid:
        raise LanesError(f"{where}: expected a cell, 0 .. {len(grid) - 1}, found {found!r}")
    return found


def _number(found: dict[Any, Any], name: str, where: str, least: float, most: float, default: float) -> float:
    value = found.get(name, default)
    if name not in found:
        return float(value)
    is_number = not isinstance(value, bool) and isinstance(value, int | float) and isfinite(value)
    if not is_number or not least <= value <= most:
        raise LanesError(f"{where}.{name}: expected a number of {least:g} .. {most:g}, found {value!r}")
    return float(value)


def _mapping(found: object, where: str, known: tuple[str, ...] = ()) -> dict[Any, Any]:
    """Return keys and values.

    Raises:
        LanesError: It has none, or one that is not known.
    """
    if not isinstance(found, dict):
        raise LanesError(f"{where}: expected keys and values, found {found!r:.60}")
    unknown = [key for key in found if known and key not in known]
    if unknown:
        raise LanesError(f"{where}: unknown key {unknown[0]!r}; keys are {', '.join(known)}")
    return found
