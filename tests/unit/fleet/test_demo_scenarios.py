"""Scenarios drawn from a seed."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.exceptions import ScenarioError
from rce_fleet.planning.dijkstra import shortest_path
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.scenario import given_scenario, make_scenario, midway_cell, solvable, spread_scenario


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 2**32), robots=st.integers(1, 12))
def test_all_robots_can_reach_their_goals(seed: int, robots: int) -> None:
    scenario = make_scenario(GridMap(), robots, seed=seed)
    assert len(scenario.known_boxes) == 2
    assert len(scenario.hidden_boxes) == 1
    assert len(set(scenario.starts)) == len(set(scenario.goals)) == len(scenario.robots) == robots
    assert scenario.boxes.isdisjoint((*scenario.starts, *scenario.goals))
    assert all(start != goal for start, goal in zip(scenario.starts, scenario.goals, strict=True))
    assert GridMap().with_blocked(scenario.boxes).connected()
    assert scenario == make_scenario(GridMap(), robots, seed=seed)


def test_hidden_box_stands_on_a_robots_path() -> None:
    found = 0
    for seed in range(20):
        scenario = make_scenario(GridMap(), 3, seed=seed)
        told = GridMap().with_blocked(scenario.known_boxes)
        for start, goal in zip(scenario.starts, scenario.goals, strict=True):
            found += scenario.hidden_boxes[0] in (shortest_path(told, start, goal) or ())
    assert found >= 18


def test_a_map_in_parts_is_used_in_its_largest_part_only() -> None:
    grid = GridMap(5, 8, blocked=frozenset(range(8, 16)))
    scenario = make_scenario(grid, 3, seed=1)
    assert min(*scenario.starts, *scenario.goals, *scenario.boxes) >= 16


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_boxes_on_one_lane_leave_robots_room_to_pass(seed: int) -> None:
    ring = GridMap(3, 6, blocked=frozenset({7, 8, 9, 10}))
    scenario = make_scenario(ring, 2, seed=seed)
    assert set(scenario.known_boxes).isdisjoint(scenario.hidden_boxes)
    assert solvable(ring.with_blocked(ring.blocked | scenario.boxes), scenario.starts, scenario.goals)


@pytest.mark.slow
def test_robots_that_can_never_pass_are_not_drawn() -> None:
    scenario = make_scenario(GridMap(1, 9), 3, seed=1)
    order = sorted(range(3), key=lambda robot: scenario.starts[robot])
    assert [scenario.goals[robot] for robot in order] == sorted(scenario.goals)


@pytest.mark.parametrize("robots", [0, 31, 100])
def test_too_many_robots_are_refused(robots: int) -> None:
    with pytest.raises(ScenarioError):
        make_scenario(GridMap(), robots)


def test_given_pairs_are_checked() -> None:
    grid = GridMap(1, 3, blocked=frozenset({1}))
    assert given_scenario(GridMap(), [(0, 63), (63, 0)]).goals == (63, 0)
    with pytest.raises(ScenarioError, match="no path"):
        given_scenario(grid, [(0, 2)])
    with pytest.raises(ScenarioError, match="same"):
        given_scenario(GridMap(), [(0, 5), (0, 6)])
    with pytest.raises(ScenarioError, match="of one robot at least"):
        given_scenario(GridMap(), [])


def test_a_map_of_many_parts_has_a_scenario() -> None:
    """Single free cells around a hall; the search for the largest part took minutes."""
    side = 400
    apart = {cell for cell in range(side * side) if (cell // side + cell % side) % 2}
    hall = {row * side + column for row in range(190, 194) for column in range(190, 194)}
    scenario = spread_scenario(GridMap(side, side, blocked=frozenset(apart - hall)), 3)
    for cell in (*scenario.starts, *scenario.goals):
        row, column = divmod(cell, side)
        assert 189 <= row <= 194
        assert 189 <= column <= 194


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_midway_cell_cuts_off_no_goal(seed: int) -> None:
    scenario = make_scenario(GridMap(), 3, seed=seed)
    grid = GridMap().with_blocked(scenario.boxes)
    goals = dict(zip(scenario.robots, scenario.goals, strict=True))
    plans = {
        robot: shortest_path(grid, start, goals[robot]) or []
        for robot, start in zip(scenario.robots, scenario.starts, strict=True)
    }
    cell = midway_cell(grid, plans, goals, avoid={20})
    if cell is None:
        assert max(map(len, plans.values())) <= 4
        return
    assert cell not in {20, *scenario.goals, *scenario.starts}
    assert any(cell in plan for plan in plans.values())
    assert all(grid.with_blocked(grid.blocked | {cell}).connected((plans[r][0], goals[r])) for r in goals)


def test_a_corridor_has_no_cell_to_block() -> None:
    grid = GridMap(1, 6)
    assert midway_cell(grid, {"R": [0, 1, 2, 3, 4, 5]}, {"R": 5}) is None
