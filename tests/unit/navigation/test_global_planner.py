"""The global planner: cheapest ways that never lead through obstacles, and reasons where there is none."""

from __future__ import annotations

from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.cost_grid import CostGrid
from rce_fleet.navigation.costmap.costs import FREE, INSCRIBED, LETHAL, UNKNOWN
from rce_fleet.navigation.planners import global_planner
from rce_fleet.navigation.planners.cost_to_go import UNREACHED, spread, steps_of
from rce_fleet.navigation.planners.global_planner import GlobalPlannerParameters, make_plan
from rce_fleet.navigation.planners.shortcuts import line_cells, line_cost

ROWS, COLUMNS = 24, 30


def grid_of(costs: np.ndarray, resolution: float = 0.1) -> CostGrid:
    grid = CostGrid(costs.shape[0], costs.shape[1], resolution)
    grid.values = costs.astype(np.uint8)
    return grid


def empty() -> np.ndarray:
    return np.full((ROWS, COLUMNS), FREE, np.uint8)


costmaps = st.lists(
    st.tuples(
        st.integers(0, ROWS - 1), st.integers(0, COLUMNS - 1), st.sampled_from((60, 200, 253, 254, 255))
    ),
    max_size=160,
)
places = st.tuples(st.floats(0.05, COLUMNS / 10 - 0.05), st.floats(0.05, ROWS / 10 - 0.05))


def painted(cells: list[tuple[int, int, int]]) -> np.ndarray:
    costs = empty()
    for row, column, cost in cells:
        costs[row, column] = cost
    return costs


@given(costmaps, places, places)
def test_a_path_never_enters_an_obstacle(
    cells: list[tuple[int, int, int]], start: tuple[float, float], goal: tuple[float, float]
) -> None:
    """Every cell that the straight lines between its poses cross can be entered, but the start's."""
    costs = painted(cells)
    costs[int(start[1] * 10), int(start[0] * 10)] = FREE
    grid = grid_of(costs)
    plan = make_plan(grid, Pose(*start, 0.0), Pose(*goal, 1.0), GlobalPlannerParameters(allow_unknown=False))
    if not plan.found:
        return
    assert plan.path[0, :2].tolist() == pytest.approx(list(start))
    assert plan.path[-1].tolist() == pytest.approx([*goal, 1.0])
    fine = np.linspace(0, len(plan.path) - 1, 20 * len(plan.path))
    points = np.stack(
        [np.interp(fine, np.arange(len(plan.path)), plan.path[:, axis]) for axis in (0, 1)], axis=1
    )
    edges = np.abs(points * 10 - np.round(points * 10)).min(axis=1) < 1e-6
    assert (grid.costs_at(points[~edges]) < INSCRIBED).all()


@given(costmaps, places, places)
@settings(max_examples=60)
def test_a_path_is_found_exactly_if_there_is_one(
    cells: list[tuple[int, int, int]], start: tuple[float, float], goal: tuple[float, float]
) -> None:
    """Flooding the free cells from the goal, with no diagonal between obstacles, tells whether there is."""
    costs = painted(cells)
    first, last = ((int(y * 10), int(x * 10)) for x, y in (start, goal))
    costs[first], costs[last] = FREE, FREE
    free = costs < INSCRIBED
    flooded = {last}
    waiting = [last]
    while waiting:
        row, column = waiting.pop()
        for dr, dc in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            r, c = row + dr, column + dc
            if 0 <= r < ROWS and 0 <= c < COLUMNS and free[r, c] and (r, c) not in flooded:
                flooded.add((r, c))
                waiting.append((r, c))
    parameters = GlobalPlannerParameters(allow_unknown=False)
    plan = make_plan(grid_of(costs), Pose(*start, 0.0), Pose(*goal, 0.0), parameters)
    assert plan.found == (first in flooded)


@given(costmaps, st.booleans())
@settings(max_examples=40)
def test_the_compiled_field_equals_the_numpy_one(cells: list[tuple[int, int, int]], early: bool) -> None:
    pytest.importorskip("numba")
    costs = painted(cells)
    costs[3, 3], costs[20, 25] = FREE, FREE
    steps = steps_of(costs)
    width = COLUMNS + 2
    goal, stop = 4 * width + 4, 21 * width + 26 if early else -1
    assert (spread.compile()(steps, goal, stop) == spread.numpy(steps, goal, stop)).all()


@pytest.mark.slow
@given(costmaps, places, places, st.sampled_from((0.0, 0.35)), st.integers(0, 40))
@settings(max_examples=60)
def test_a_growing_window_finds_what_the_whole_map_has(
    cells: list[tuple[int, int, int]],
    start: tuple[float, float],
    goal: tuple[float, float],
    tolerance: float,
    gap: int,
) -> None:
    """The map is four times as wide; a wall with one gap makes some ways lead far around."""
    costs = np.tile(painted(cells), (4, 4))
    costs[:, 4 * COLUMNS // 3] = LETHAL
    costs[gap, 4 * COLUMNS // 3] = FREE
    ends = (Pose(*start, 0.0), Pose(2 * goal[0], goal[1], 1.0))
    with pytest.MonkeyPatch.context() as patch:
        plans = []
        for radius in (0, 1000):
            patch.setattr(global_planner, "FIRST_RADIUS", radius)
            plans.append(make_plan(grid_of(costs), *ends, tolerance=tolerance))
    assert plans[0].reason == plans[1].reason
    np.testing.assert_array_equal(plans[0].path, plans[1].path)


def test_a_short_way_on_a_large_map_looks_at_few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at = []

    def counting(costs: np.ndarray, *, allow_unknown: bool) -> np.ndarray:
        looked_at.append(costs.size)
        return steps_of(costs, allow_unknown=allow_unknown)

    monkeypatch.setattr(global_planner, "steps_of", counting)
    large = grid_of(np.zeros((1200, 2000), np.uint8), 0.05)
    assert make_plan(large, Pose(50.0, 30.0, 0.0), Pose(52.0, 30.0, 0.0)).found
    assert sum(looked_at) < 100_000


def test_the_path_in_the_open_is_the_straight_line() -> None:
    plan = make_plan(grid_of(empty()), Pose(0.23, 0.31, 0.0), Pose(2.77, 1.94, pi / 2))
    x, y = plan.path[:, 0], plan.path[:, 1]
    assert y == pytest.approx(0.31 + (x - 0.23) * (1.94 - 0.31) / (2.77 - 0.23), abs=1e-9)
    assert plan.path[:-1, 2] == pytest.approx(np.arctan2(1.94 - 0.31, 2.77 - 0.23))
    assert np.hypot(*np.diff(plan.path[:, :2], axis=0).T).max() <= 0.1 + 1e-9


def test_the_path_keeps_away_from_costly_cells() -> None:
    costs = empty()
    costs[5:15, 10:20] = 252
    plan = make_plan(grid_of(costs), Pose(0.5, 1.0, 0.0), Pose(2.5, 1.0, 0.0))
    assert (grid_of(costs).costs_at(plan.path[:, :2]) == FREE).all()


def test_no_way_is_a_reason_with_both_places() -> None:
    costs = empty()
    costs[:, 15] = LETHAL
    plan = make_plan(grid_of(costs), Pose(0.5, 1.0, 0.0), Pose(2.5, 1.0, 0.0))
    assert not plan.found
    assert len(plan.path) == 0
    assert plan.reason == "no way leads from (0.50, 1.00) to (2.50, 1.00)"


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        (Pose(1.55, 1.05, 0.0), "is in an obstacle; no free cell is within the tolerance of 0.00 m"),
        (Pose(1.45, 1.05, 0.0), "so near to an obstacle that the robot would touch it"),
        (Pose(0.05, 0.05, 0.0), "is in unknown space"),
        (Pose(9.0, 1.0, 0.0), r"off the costmap \(x 0.00 to 3.00 m, y 0.00 to 2.40 m\)"),
        (Pose(nan, 1.0, 0.0), "not finite"),
        (Pose(1.0, inf, 0.0), "not finite"),
    ],
)
def test_a_goal_that_cannot_be_reached_has_a_reason(goal: Pose, reason: str) -> None:
    costs = empty()
    costs[10, 15], costs[10, 14], costs[0, 0] = LETHAL, INSCRIBED, UNKNOWN
    plan = make_plan(grid_of(costs), Pose(0.5, 1.0, 0.0), goal, GlobalPlannerParameters(allow_unknown=False))
    with pytest.raises(AssertionError, match=reason):
        assert plan.found, plan.reason


def test_a_goal_in_an_obstacle_ends_within_the_tolerance() -> None:
    costs = empty()
    costs[8:13, 13:18] = LETHAL
    grid, goal = grid_of(costs), Pose(1.55, 1.05, 0.7)
    assert not make_plan(grid, Pose(0.5, 1.0, 0.0), goal, tolerance=0.2).found
    plan = make_plan(grid, Pose(0.5, 1.0, 0.0), goal, tolerance=0.5)
    x, y, yaw = plan.path[-1]
    assert np.hypot(x - goal.x, y - goal.y) <= 0.5
    assert grid.cost_at(x, y) == FREE
    assert yaw == pytest.approx(0.7)


def test_a_start_that_touches_an_obstacle_leads_out() -> None:
    costs = empty()
    costs[8:13, 0:6] = INSCRIBED
    costs[10, 0:3] = LETHAL
    plan = make_plan(grid_of(costs), Pose(0.45, 1.05, 0.0), Pose(2.5, 1.0, 0.0))
    assert plan.found
    assert (grid_of(costs).costs_at(plan.path[:, :2]) != LETHAL).all()


def test_unknown_cells_are_entered_if_allowed() -> None:
    costs = empty()
    costs[:, 15] = UNKNOWN
    ends = Pose(0.5, 1.0, 0.0), Pose(2.5, 1.0, 0.0)
    assert make_plan(grid_of(costs), *ends).found
    assert not make_plan(grid_of(costs), *ends, GlobalPlannerParameters(allow_unknown=False)).found


def test_start_and_goal_in_one_place_are_one_pose() -> None:
    plan = make_plan(grid_of(empty()), Pose(1.0, 1.0, 0.0), Pose(1.0, 1.0, 1.5))
    assert plan.path.tolist() == [[1.0, 1.0, 1.5]]


def test_cells_beyond_the_start_are_not_computed() -> None:
    field = spread.numpy(steps_of(empty()), 4 * (COLUMNS + 2) + 4, 4 * (COLUMNS + 2) + 8)
    assert field[4, 8] == 200
    assert field[4, 9] == UNREACHED


@given(st.tuples(st.floats(0, 9), st.floats(0, 9)), st.tuples(st.floats(0, 9), st.floats(0, 9)))
def test_a_line_is_split_into_the_cells_it_crosses(
    start: tuple[float, float], end: tuple[float, float]
) -> None:
    a, b = np.array(start), np.array(end)
    rows, columns, lengths = line_cells(a, b)
    assert lengths.sum() == pytest.approx(np.hypot(*(b - a)), abs=1e-9)
    at = a + (b - a) * np.linspace(0.0005, 0.9995, 200)[:, None]
    crossed = set(zip(rows.tolist(), columns.tolist(), strict=True))
    off_edges = np.abs(at - np.round(at)).min(axis=1) > 1e-6
    assert {(int(r), int(c)) for r, c in np.floor(at[off_edges])} <= crossed


def test_no_line_leads_through_a_corner_of_two_walls() -> None:
    steps = np.full((8, 8), 50, np.int16)
    start, end = np.array((2.5, 2.5)), np.array((4.5, 4.5))
    assert line_cost(steps, start, end) == pytest.approx(50 * np.hypot(2, 2))
    for wall in ((3, 4), (4, 3)):
        steps[wall] = 0
        assert line_cost(steps, start, end) == inf
        assert line_cost(steps, end, start) == inf
        steps[wall] = 50


def test_straight_parts_of_a_way_pass_no_corner_of_walls() -> None:
    """The straight line from start to goal leads through a wall's corner."""
    costs = empty()
    costs[12:, 15] = LETHAL
    costs[11, :15] = LETHAL
    costs[11, 14] = FREE
    start, goal = Pose(1.45, 1.25, 0.0), Pose(1.55, 1.15, 0.0)
    plan = make_plan(grid_of(costs), start, goal)
    assert plan.found
    assert len(plan.path) > 2


def test_a_goal_beyond_all_numbers_has_a_reason() -> None:
    far = Pose(1e308, -1e308, 0.0)
    grid = grid_of(empty())
    for start, goal in ((Pose(1.0, 1.0, 0.0), far), (far, Pose(1.0, 1.0, 0.0))):
        assert "is off the costmap" in make_plan(grid, start, goal).reason


def test_a_tolerance_may_be_infinite_but_not_nan() -> None:
    grid = CostGrid(20, 30, 0.1)
    grid.values[:, 25:] = LETHAL
    goal = Pose(2.8, 1.0, 0.0)
    plan = make_plan(grid, Pose(0.5, 1.0, 0.0), goal, tolerance=inf)
    assert plan.found
    assert plan.path[-1, 0] == pytest.approx(2.45)
    assert not make_plan(grid, Pose(0.5, 1.0, 0.0), goal, tolerance=nan).found
