"""The worlds that ship with the demo, by name.

``floor``: the demo's own 8 x 8 cells (:mod:`rce_fleet.demo.floor`).

``warehouse``: 62 x 104 cells of 1 m, with room for 1000 robots. Eight columns of shelves stand between aisles
that are two cells wide; docks are along the southern wall, chargers along the western one::

    ..............................        .: way
    C...##########..##########....        #: shelf
    ....##########..##########....        C: charger
    C.............................
    ..............................
    ....##########..##########....
    C...##########..##########....
    ..............................
    ..............................
    ...D..D..D..D..D..D..D..D.....        D: dock
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.floor import FLOOR
from rce_fleet.exceptions import FleetError, MapError
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import LaneGraph
from rce_fleet.planning.movingai import read_map

_SHELF_COLUMNS, _SHELF_ROWS = 10, 2
_AISLE = 2
_SIDE = 4
"""Columns west and east of the shelves."""
_SOUTH = 4
"""Rows south of the shelves, where the docks are."""
_BLOCKS_EAST, _BLOCKS_NORTH = 8, 14
_DOCK_EVERY = 3
_CHARGER_EVERY = 2


@dataclass(frozen=True, slots=True)
class NamedWorld:
    """A world of the demo.

    Attributes:
        grid: The cells.
        docks: Cells at which loads are brought in and out.
        shelves: Cells beside shelves, at which loads are picked and put.
        chargers: Cells with a charger.
    """

    grid: GridMap
    docks: tuple[int, ...] = ()
    shelves: tuple[int, ...] = ()
    chargers: tuple[int, ...] = ()


def on_lanes(world: NamedWorld, lanes: LaneGraph) -> NamedWorld:
    """Return a world with those of its docks, shelves and chargers from which lanes lead to all others."""
    part = lanes.connected_part()

    def kept(cells: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(cell for cell in cells if cell in part)

    return NamedWorld(world.grid, kept(world.docks), kept(world.shelves), kept(world.chargers))


def warehouse() -> NamedWorld:
    """Return the world ``warehouse``."""
    rows = _SOUTH + _BLOCKS_NORTH * (_SHELF_ROWS + _AISLE) + _AISLE
    columns = 2 * _SIDE + _BLOCKS_EAST * (_SHELF_COLUMNS + _AISLE)
    empty = GridMap(rows, columns)
    solid = frozenset(
        empty.cell(row, column)
        for row in range(_SOUTH, rows - _AISLE)
        for column in range(_SIDE, columns - _SIDE)
        if (row - _SOUTH) % (_SHELF_ROWS + _AISLE) < _SHELF_ROWS
        and (column - _SIDE) % (_SHELF_COLUMNS + _AISLE) < _SHELF_COLUMNS
    )
    grid = empty.with_blocked(solid)
    beside = {
        other
        for cell in solid
        for other in (cell - columns, cell + columns)
        if other in grid and other not in solid
    }
    return NamedWorld(
        grid,
        docks=tuple(grid.cell(0, column) for column in range(_SIDE, columns - _SIDE, _DOCK_EVERY)),
        shelves=tuple(sorted(beside)),
        chargers=tuple(grid.cell(row, 0) for row in range(_SOUTH, rows - _AISLE, _CHARGER_EVERY)),
    )


_WORLDS = {"floor": lambda: NamedWorld(FLOOR), "warehouse": warehouse}


def find_world(name: str) -> NamedWorld:
    """Return a world by its name, or by a file in MovingAI's format.

    Args:
        name: A name, or the path of a ``.map`` file; empty: the demo's own floor.

    Raises:
        DemoError: There is no such world, or the file cannot be read.
    """
    made = _WORLDS.get(name or "floor")
    if made is not None:
        return made()
    path = Path(name)
    if not path.is_file():
        known = ", ".join(sorted(_WORLDS))
        raise DemoError(f"--world: there is no world {name!r} ({known}), and no file of this name")
    try:
        return NamedWorld(read_map(path))
    except MapError as error:  # it names the file
        raise DemoError(str(error)) from error
    except (FleetError, OSError) as error:
        raise DemoError(f"{name}: {error}") from error
