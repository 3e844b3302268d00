"""A fleet's grid over an occupancy map."""

from __future__ import annotations

from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.fleet_grid import fleet_grid
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ros_map import save_map
from rce_fleet.navigation.occupancy import occupancy
from rce_fleet.nodes.grid_messages import wants_old_topic
from rce_fleet.nodes.grid_parameters import make_grid
from rce_fleet.planning.grid import GridMap


def drawn(origin: Pose | None = None) -> OccupancyMap:
    """Return a map of 3 x 2 m: a wall fills the second square metre, a corner is unknown."""
    data = np.zeros((40, 60), np.int8)
    data[:20, 20:40] = 100
    data[36:, 56:] = -1  # 4 % of the last square metre
    return OccupancyMap(data, 0.05, origin or Pose(-1.0, 2.0, 0.0))


def test_cells_are_blocked_by_their_share() -> None:
    grid = fleet_grid(drawn())
    assert (grid.rows, grid.columns, grid.origin, grid.yaw) == (2, 3, (-1.0, 2.0), 0.0)
    assert grid.blocked == {1}
    assert fleet_grid(drawn(), blocked_share=0.03).blocked == {1, 5}
    assert fleet_grid(drawn(), blocked_share=0.05).blocked == {1}
    assert fleet_grid(drawn(), 0.5).blocked == {2, 3, 8, 9, 23}


def test_a_line_of_large_pixels_blocks_its_cells() -> None:
    """It lies within 1.2 .. 1.5 m, where a cell of 1 m is blocked by a tenth."""
    data = np.zeros((10, 10), np.int8)
    data[:, 4] = 100
    assert fleet_grid(OccupancyMap(data, 0.3)).blocked == {1, 4, 7}


def walled(line: np.ndarray, **options: object) -> GridMap:
    """Return the grid of 3 x 3 m with a wall, given by its occupied pixels of 5 cm."""
    data = np.zeros((60, 60), np.int8)
    data[line] = 100
    return fleet_grid(OccupancyMap(data, 0.05), **options)  # type: ignore[arg-type]


ROW, COLUMN = np.indices((60, 60))


def test_a_wall_of_one_pixel_blocks_the_cells_that_it_cuts() -> None:
    assert walled(COLUMN == 30).blocked == {1, 4, 7}
    assert walled((COLUMN == 30) & (ROW > 10)).blocked == {4, 7}
    assert walled(ROW == COLUMN).blocked == {0, 4, 8}
    assert walled(ROW + COLUMN == 59).blocked == {2, 4, 6}


def test_what_does_not_cut_a_cell_leaves_it_free() -> None:
    assert walled((COLUMN == 30) & (ROW != 30)).blocked == {1, 7}  # a gap
    assert walled((ROW % 10 == 5) & (COLUMN % 10 == 5)).blocked == set()  # single pixels
    assert walled(ROW + COLUMN == 5).blocked == set()  # it cuts a corner off


@pytest.mark.parametrize("at", range(2, 58))
def test_a_wall_blocks_cells_wherever_it_stands(at: int) -> None:
    """Also on an edge, or so near to it that it cuts off less than the share: then cells of one side."""
    near = {(at - 2) // 20, (at + 2) // 20}
    columns = [frozenset({place, place + 3, place + 6}) for place in near]
    rows = [frozenset({3 * place, 3 * place + 1, 3 * place + 2}) for place in near]
    assert walled(np.equal(COLUMN, at)).blocked in columns
    assert walled(np.equal(ROW, at)).blocked in rows


def test_a_thick_wall_across_an_edge_blocks_one_side() -> None:
    grid = walled((COLUMN >= 38) & (COLUMN < 42))
    assert grid.blocked in ({1, 4, 7}, {2, 5, 8})


def test_cells_with_a_gap_between_them_are_joined() -> None:
    assert walled((COLUMN == 20) & (ROW % 20 > 9)).blocked == set()


def test_a_greater_share_leaves_cells_free_that_are_cut() -> None:
    assert walled(COLUMN == 30, blocked_share=0.6).blocked == set()


@pytest.mark.parametrize("yaw", [0.3, pi / 4, 1.2, -0.7])
@pytest.mark.parametrize("line", [COLUMN == 30, ROW == COLUMN, ROW == COLUMN // 2 + 15])
def test_a_turned_grid_has_no_leak_in_a_thin_wall(line: np.ndarray, yaw: float) -> None:
    """The only cell is turned about its centre, through which the wall leads."""
    half = 0.5 * 2**0.5
    x, y = (1.525 + half * turn(yaw - 3 * pi / 4) for turn in (cos, sin))
    with pytest.raises(MapError, match="all 1 cells"):
        walled(line, origin=Pose(x, y, yaw), rows=1, columns=1, blocked_share=0.3)


def test_cells_beyond_the_map_are_blocked() -> None:
    grid = fleet_grid(drawn(), origin=Pose(-2.0, 2.0, 0.0), rows=3, columns=5)
    assert grid.blocked == {0, 2, 4, 5, 9, 10, 11, 12, 13, 14}


@pytest.mark.parametrize("yaw", [pi / 2, 0.5, -2.0])
def test_a_turned_map_gives_a_turned_grid(yaw: float) -> None:
    grid = fleet_grid(drawn(Pose(4.0, -3.0, yaw)))
    assert (grid.rows, grid.columns, grid.yaw) == (2, 3, yaw)
    assert grid.blocked == {1}
    x, y = grid.centre(4)
    assert (x, y) == pytest.approx(
        (4.0 + 1.5 * cos(yaw) - 1.5 * sin(yaw), -3.0 + 1.5 * sin(yaw) + 1.5 * cos(yaw))
    )


@given(st.integers(0, 14), st.floats(-4, 4), st.floats(-0.49, 0.49), st.floats(-0.49, 0.49))
def test_cells_of_a_turned_grid_are_found(cell: int, yaw: float, along: float, up: float) -> None:
    grid = GridMap(3, 5, 2.0, (1.0, -2.0), yaw=yaw)
    x, y = grid.centre(cell)
    c, s = 2 * cos(yaw), 2 * sin(yaw)
    inside = x + c * along - s * up, y + s * along + c * up
    assert grid.cell_at(*inside) == cell
    assert grid.cells_touched(*inside, 0.001) == {cell}
    straight = GridMap(3, 5, 2.0)
    assert len(grid.cells_touched(x, y, 1.2)) == len(straight.cells_touched(*straight.centre(cell), 1.2))
    assert occupancy(grid).yaw == yaw


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"cell_size": 0.0}, "must be a positive number of metres"),
        ({"cell_size": 0.001}, "is not within 1"),
        ({"cell_size": 1e-320}, r"within 0\.001 \.\. 1000 m"),
        ({"cell_size": 1e12}, r"within 0\.001 \.\. 1000 m"),
        ({"origin": Pose(1e308, 0.0, 0.0)}, r"within -1e\+09 \.\. 1e\+09"),
        ({"blocked_share": 1.5}, r"within 0 \.\. 1"),
        ({"origin": Pose(50.0, 0.0, 0.0)}, "is not within 1"),
        ({"rows": -2}, "is not within 1"),
        ({"origin": Pose(9.0, 9.0, 0.0), "rows": 2, "columns": 2}, "all 4 cells of 1.0 m are blocked"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(options: dict[str, float], fault: str) -> None:
    with pytest.raises(MapError, match=fault):
        fleet_grid(drawn(), **options)  # type: ignore[arg-type]


def test_the_planner_reads_a_map_by_its_parameters(tmp_path: Path) -> None:
    file = str(save_map(drawn(), tmp_path / "hall"))
    assert make_grid({"map_yaml": file}).blocked == {1}
    grid = make_grid({"map_yaml": file, "cell_size": 0.5, "columns": 2, "origin_yaw": 0.1, "walls": [0]})
    assert (grid.columns, grid.rows, grid.yaw) == (2, 4, 0.1)
    assert 0 in grid.blocked
    assert make_grid({"rows": 2, "columns": 2, "origin_yaw": 0.2}).yaw == 0.2
    with pytest.raises(ValueError, match=r"rows and columns, 3000 and 2000, .* at most 4000000"):
        make_grid({"rows": 3000, "columns": 2000})


def test_a_movingai_map_lies_where_the_parameters_say(tmp_path: Path) -> None:
    (tmp_path / "hall.map").write_text("type octile\nheight 1\nwidth 3\nmap\n..@\n")
    place = {"origin_x": -4.0, "origin_y": 2, "origin_yaw": 0.2}
    grid = make_grid({"map": str(tmp_path / "hall.map"), "cell_size": 0.5, **place})
    assert grid == GridMap(1, 3, 0.5, (-4.0, 2.0), frozenset({2}), 0.2)


def test_the_old_topic_is_for_robot_files_only() -> None:
    environment, planner = "/rce_environment", "/fleet_planner"
    assert wants_old_topic({}, {"/map": [environment]}, planner)
    assert wants_old_topic({"/map": [planner]}, {"/map": [environment]}, planner)
    assert not wants_old_topic({"/map": ["/map_server"]}, {"/map": [environment]}, planner)
    assert not wants_old_topic({}, {"/map": [environment, "/amcl"]}, planner)
    assert not wants_old_topic({}, {}, planner)
