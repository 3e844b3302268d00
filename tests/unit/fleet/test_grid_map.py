"""Cells, metres, neighbours, files of maps."""

from __future__ import annotations

from math import inf, nan, sqrt
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.exceptions import MapError
from rce_fleet.navigation.occupancy import FREE, OCCUPIED, occupancy
from rce_fleet.planning.dijkstra import distances, shortest_path
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import parse_map, parse_scenario, read_map, read_scenario

if TYPE_CHECKING:
    from pathlib import Path

grids = st.builds(
    lambda rows, columns, size, x, y, blocked: GridMap(
        rows, columns, size, (x, y), frozenset(cell for cell in blocked if cell < rows * columns)
    ),
    st.integers(1, 9),
    st.integers(1, 9),
    st.floats(0.1, 5),
    st.floats(-50, 50),
    st.floats(-50, 50),
    st.sets(st.integers(0, 80), max_size=20),
)


def test_cells_are_numbered_row_by_row_from_the_origin() -> None:
    grid = GridMap(rows=3, columns=4, cell_size=2.0, origin=(10.0, -1.0))
    assert grid.cell(2, 1) == 9
    assert grid.place(9) == (2, 1)
    assert grid.centre(9) == (13.0, 4.0)
    assert grid.cell_at(13.9, 3.1) == 9
    assert grid.cell_at(9.9, 0.0) is None
    assert grid.cell_at(10.0, 5.0) is None


@given(grids)
def test_every_cell_is_where_its_centre_is(grid: GridMap) -> None:
    for cell in range(len(grid)):
        assert grid.cell_at(*grid.centre(cell)) == cell
        assert grid.cells_touched(*grid.centre(cell), grid.cell_size * 0.49) == {cell}


@given(grids)
def test_neighbours_share_an_edge_and_are_free(grid: GridMap) -> None:
    for cell, neighbours in enumerate(grid.neighbours):
        assert grid.blocked.isdisjoint(neighbours)
        for other in neighbours:
            (x, y), (to_x, to_y) = grid.centre(cell), grid.centre(other)
            assert sqrt((x - to_x) ** 2 + (y - to_y) ** 2) == pytest.approx(grid.cell_size)
            assert grid.adjacent(cell, other)


def test_a_disc_touches_what_it_overlaps() -> None:
    grid = GridMap()
    assert grid.cells_touched(0.5, 0.5, 0.3) == {0}
    assert grid.cells_touched(0.9, 0.5, 0.22) == {0, 1}
    assert grid.cells_touched(1.0, 1.0, 0.22) == {0, 1, 8, 9}
    assert grid.cells_touched(0.86, 0.86, 0.19) == {0, 1, 8}, "the corner is farther than both edges"
    assert grid.cells_touched(-5.0, 0.5, 0.22) == set()


@pytest.mark.parametrize(
    "arguments",
    [
        {"rows": 0},
        *({"cell_size": size} for size in (0.0, nan, inf)),
        *({"origin": origin} for origin in ((nan, 0.0), (0.0, -inf))),
        {"blocked": frozenset({64})},
    ],
)
def test_impossible_maps_are_refused(arguments: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"row|cell_size|blocked|origin"):
        GridMap(**arguments)  # type: ignore[arg-type]  # impossible ones too


def test_a_wall_parts_the_map() -> None:
    grid = GridMap(3, 3, blocked=frozenset({1, 4, 7}))
    assert not grid.connected()
    assert grid.connected((0, 6))
    assert not grid.connected((0, 4)), "a blocked cell is connected with nothing"
    assert grid.reachable(0) == {0, 3, 6}


# Paths


@given(grids, st.integers(0, 80), st.integers(0, 80))
def test_paths_are_as_long_as_their_distance(grid: GridMap, start: int, goal: int) -> None:
    start, goal = start % len(grid), goal % len(grid)
    path = shortest_path(grid, start, goal)
    if start in grid.blocked or goal in grid.blocked or goal not in grid.reachable(start):
        assert path is None
        return
    assert path is not None
    assert path[0] == start
    assert path[-1] == goal
    assert grid.is_path(path)
    assert grid.blocked.isdisjoint(path)
    assert len(path) - 1 == distances(grid, goal)[start]


def test_a_path_avoids_what_costs_more() -> None:
    grid = GridMap(3, 3)
    weights = [1.0] * 9
    weights[4] = 10.0
    assert shortest_path(grid, 3, 5, weights) in ([3, 0, 1, 2, 5], [3, 6, 7, 8, 5])
    assert distances(grid, 5, weights)[3] == 4.0


def test_a_path_turns_as_seldom_as_it_can_at_each_step() -> None:
    assert shortest_path(GridMap(), 0, 18) in ([0, 1, 2, 10, 18], [0, 8, 16, 17, 18])


def test_blocked_goal_is_unreachable() -> None:
    assert distances(GridMap(2, 2, blocked=frozenset({3})), 3) == [inf] * 4


# Files

MAP = "type octile\nheight 2\nwidth 3\nmap\n..@\nT.G\n"


def test_a_map_file_is_read_from_its_top_left() -> None:
    grid = parse_map(MAP)
    assert (grid.rows, grid.columns, grid.blocked) == (2, 3, frozenset({2, 3}))


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", 0),
        ("type octile\nheight 2\nwidth 3\n", 0),
        (MAP.replace("height 2", "height two"), 2),
        (MAP.replace("height 2", "height 3"), 6),
        (MAP.replace("height 2", "height 99999999"), 4),
        (MAP.replace("height 2", "height " + "9" * 5000), 2),
        (MAP.replace("height 2", "height 1"), 6),
        (f"{MAP}\n\n...\n", 9),
        (MAP.replace("..@", "..x"), 5),
        (MAP.replace("..@", ".."), 5),
        (MAP.replace("type octile", "colour red"), 1),
    ],
)
def test_a_broken_map_file_names_its_line(text: str, line: int) -> None:
    with pytest.raises(MapError) as caught:
        parse_map(text)
    assert caught.value.line in (line, 0) if "99999999" in text else caught.value.line == line


def test_scenario_rows_give_cells() -> None:
    rows = parse_scenario("version 1\n0\tm\t3\t2\t0\t0\t1\t1\t2.0\n\n1 m 3 2 2 1 1 0 2.0\n", parse_map(MAP))
    assert [(row.start, row.goal) for row in rows] == [(0, 4), (5, 1)]


@pytest.mark.parametrize(
    "row",
    ["0 m 3 2 0 0 1", "0 m 9 2 0 0 1 1 2.0", "0 m 3 2 2 0 1 1 2", "0 m 3 2 0 5 1 1 2", "0 m 3 2 a 0 1 1 2"],
)
def test_a_broken_scenario_row_is_named(row: str) -> None:
    with pytest.raises(MapError, match="line 3"):
        parse_scenario(f"version 1\n0 m 3 2 0 0 1 1 2.0\n{row}\n", parse_map(MAP))


def test_binary_map_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.map").write_bytes(b"\xff\xfe")
    with pytest.raises(MapError, match=r"x\.map"):
        read_map(tmp_path / "x.map")


@pytest.mark.needs("data")
def test_public_maps_are_read(rce_data: Path) -> None:
    grid = read_map(rce_data / "maps" / "random-32-32-20.map")
    assert (grid.rows, grid.columns, len(grid.blocked)) == (32, 32, 205)
    rows = read_scenario(rce_data / "maps" / "random-32-32-20-random-1.scen", grid, limit=4)
    assert grid.place(rows[0].start) == (16, 5)
    assert all(grid.connected((row.start, row.goal)) for row in rows)


# Occupancy


@given(grids, st.integers(1, 4))
def test_every_pixel_shows_its_cell(grid: GridMap, pixels: int) -> None:
    picture = occupancy(grid, pixels_per_cell=pixels)
    assert picture.data.dtype == np.int8
    data = picture.data.reshape(picture.height, picture.width)
    for row, column in np.ndindex(data.shape):
        cell = grid.cell(row // pixels, column // pixels)
        assert data[row, column] == (OCCUPIED if cell in grid.blocked else FREE)


def test_blocked_cells_are_drawn_over_the_map() -> None:
    picture = occupancy(GridMap(1, 3, blocked=frozenset({0})), [2])
    assert picture.data.tolist() == [OCCUPIED, FREE, OCCUPIED]
