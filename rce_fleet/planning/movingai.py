"""Reader of the MovingAI benchmark formats, ``.map`` and ``.scen``.

Format: https://movingai.com/benchmarks/formats.html. The origin is the top left corner, x grows to the
right and y downwards, which is column and row of :class:`~rce_fleet.planning.grid.GridMap`.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_fleet.exceptions import MapError
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_FREE = frozenset(".GS")
_BLOCKED = frozenset("@OTW")
_SCEN_FIELDS = 9
_DIGITS = 20
"""More than the number of rows or columns has."""
MAX_CELLS = 4_000_000
"""Maximum size of a map, so that a wrong header does not fill the memory."""


@dataclass(frozen=True, slots=True)
class ScenarioRow:
    """One row of a ``.scen`` file: start and goal cell of a robot."""

    start: int
    goal: int


def parse_map(text: str, *, cell_size: float = 1.0) -> GridMap:
    """Read a ``.map`` file's text.

    Raises:
        MapError: The text is not such a map.
    """
    lines = text.splitlines()
    rows, columns, first = _header(lines)
    body = lines[first : first + rows]
    if len(body) < rows:
        raise MapError(f"the map has {len(body)} rows; its header says {rows}", line=len(lines))
    more = next(
        (first + rows + index for index, line in enumerate(lines[first + rows :]) if line.strip()), None
    )
    if more is not None:
        raise MapError(f"the map has more rows than the {rows} of its header", line=more + 1)
    blocked: set[int] = set()
    for row, line in enumerate(body):
        if len(line) != columns:
            raise MapError(f"the row has {len(line)} cells instead of {columns}", line=first + row + 1)
        for column, character in enumerate(line):
            if character in _BLOCKED:
                blocked.add(row * columns + column)
            elif character not in _FREE:
                raise MapError(f"unknown cell {character!r}", line=first + row + 1)
    return GridMap(rows, columns, cell_size, blocked=frozenset(blocked))


def _header(lines: list[str]) -> tuple[int, int, int]:
    """Rows, columns and the index of the first line of cells."""
    sizes: dict[str, int] = {}
    for index, line in enumerate(lines):
        key, _, value = line.strip().partition(" ")
        if key == "map":
            break
        if key in ("height", "width"):
            if not value.strip().isdecimal() or len(value) > _DIGITS:
                raise MapError(f"{key} is not a number of cells: {value[:40]!r}", line=index + 1)
            sizes[key] = int(value)
        elif key != "type":
            raise MapError(f"unknown header line {line!r}", line=index + 1)
    else:
        raise MapError("the line 'map' before the cells is missing")
    rows, columns = sizes.get("height", 0), sizes.get("width", 0)
    if not 0 < rows * columns <= MAX_CELLS:
        raise MapError(f"the size {columns} x {rows} is not within 1 .. {MAX_CELLS} cells")
    return rows, columns, index + 1


def parse_scenario(text: str, grid: GridMap, *, limit: int | None = None) -> list[ScenarioRow]:
    """Read the first ``limit`` rows (by default all) of a ``.scen`` file's text for the map ``grid``.

    Raises:
        MapError: A row is malformed, for a map of another size, or starts or ends in a blocked cell.
    """
    lines = text.splitlines()
    if not lines or not lines[0].startswith("version"):
        raise MapError("the line 'version' at the beginning is missing", line=1)
    rows: list[ScenarioRow] = []
    for number, line in enumerate(lines[1:], start=2):
        if limit is not None and len(rows) >= limit:
            break
        if line.strip():
            rows.append(_scenario_row(line, number, grid))
    return rows


def _scenario_row(line: str, number: int, grid: GridMap) -> ScenarioRow:
    fields = line.split()
    if len(fields) != _SCEN_FIELDS:
        raise MapError(f"the row has {len(fields)} fields instead of {_SCEN_FIELDS}", line=number)
    try:
        width, height, start_x, start_y, goal_x, goal_y = (int(field) for field in fields[2:8])
    except ValueError as error:
        raise MapError(str(error), line=number) from error
    if (width, height) != (grid.columns, grid.rows):
        raise MapError(
            f"the row is for a map of {width} x {height} cells; use the .scen file of this map", line=number
        )
    for x, y in ((start_x, start_y), (goal_x, goal_y)):
        if not (0 <= x < width and 0 <= y < height) or grid.cell(y, x) in grid.blocked:
            raise MapError(f"({x}, {y}) is not a free cell of the map", line=number)
    return ScenarioRow(grid.cell(start_y, start_x), grid.cell(goal_y, goal_x))


def read_map(path: Path, *, cell_size: float = 1.0) -> GridMap:
    """Read a ``.map`` file.

    Raises:
        MapError: The file is not such a map.
        OSError: The file cannot be opened.
    """
    with _named(path):
        return parse_map(_text(path), cell_size=cell_size)


def read_scenario(path: Path, grid: GridMap, *, limit: int | None = None) -> list[ScenarioRow]:
    """Read a ``.scen`` file; see :func:`parse_scenario`."""
    with _named(path):
        return parse_scenario(_text(path), grid, limit=limit)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Put the file's name before errors of its content."""
    try:
        yield
    except MapError as error:
        raise MapError(error.reason, line=error.line, file=str(path)) from error


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except UnicodeDecodeError as error:
        raise MapError("the file is not ASCII text") from error
