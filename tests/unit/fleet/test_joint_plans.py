"""PIBT and LaCAM: plans for several robots that can be carried out in any timing."""

from __future__ import annotations

from itertools import pairwise
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lacam import plan
from rce_fleet.planning.planner import JointPlan


def check(grid: GridMap, joint: JointPlan, starts: list[int]) -> None:
    """Moves are to neighbours, cells are not shared, and nobody follows others around in a circle."""
    assert joint.steps[0] == tuple(starts)
    for now, after in pairwise(joint.steps):
        assert len(set(after)) == len(after)
        robot_in = {cell: robot for robot, cell in enumerate(now)}
        for robot, (here, there) in enumerate(zip(now, after, strict=True)):
            assert here == there or there in grid.neighbours[here]
            seen, ahead = {robot}, robot
            while after[ahead] != now[ahead] and after[ahead] in robot_in:
                ahead = robot_in[after[ahead]]
                assert ahead not in seen, f"robots {seen} wait for each other at {now}"
                seen.add(ahead)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 20))
def test_plans_reach_their_goals_and_can_be_carried_out(seed: int, count: int) -> None:
    rng = Random(seed)
    grid = GridMap().with_blocked(rng.sample(range(64), 4))
    if not grid.connected():
        return
    starts, goals = rng.sample(grid.free, count), rng.sample(grid.free, count)
    joint = plan(grid, starts, goals, seed=seed)
    check(grid, joint, starts)
    assert joint.complete
    assert joint.steps[-1] == tuple(goals)


def test_two_robots_pass_where_one_can_step_aside() -> None:
    # A corridor with one bay: . . . . .
    #                           @ @ . @ @
    grid = GridMap(2, 5, blocked=frozenset({5, 6, 8, 9}))
    joint = plan(grid, [0, 4], [4, 0])
    check(grid, joint, [0, 4])
    assert joint.complete


def test_plan_without_circular_moves_leaves_robots_in_place() -> None:
    joint = plan(GridMap(2, 2), [0, 1, 3, 2], [1, 3, 2, 0], effort=2000)
    assert not joint.complete
    assert joint.steps == ((0, 1, 3, 2),)


def test_corridor_without_a_bay_gives_the_best_partial_plan() -> None:
    grid = GridMap(1, 6)
    joint = plan(grid, [0, 5], [5, 0], effort=5000)
    check(grid, joint, [0, 5])
    assert not joint.complete


def test_blocked_cell_may_be_left_but_not_entered() -> None:
    grid = GridMap(3, 3, blocked=frozenset({4}))
    joint = plan(grid, [4, 0], [0, 8])
    check(grid, joint, [4, 0])
    assert joint.complete
    assert all(4 not in cells for cells in joint.steps[1:])


def test_robot_at_its_goal_stays_if_its_cell_is_not_needed() -> None:
    joint = plan(GridMap(), [0, 63, 27], [7, 56, 27])
    assert {cells[2] for cells in joint.steps} == {27}


def test_a_single_robot_takes_the_shortest_way() -> None:
    joint = plan(GridMap(), [0], [63])
    assert len(joint.route(0)) == 15
    assert joint.route(0)[0] == (0, 0)


def test_the_same_seed_makes_the_same_plan() -> None:
    starts, goals = list(range(8)), list(range(56, 64))[::-1]
    assert plan(GridMap(), starts, goals, seed=5).steps == plan(GridMap(), starts, goals, seed=5).steps


def test_plan_without_robots_is_empty() -> None:
    assert plan(GridMap(), [], []).complete


@pytest.mark.parametrize(("starts", "goals"), [([0, 0], [1, 2]), ([0, 1], [2, 2]), ([0], [1, 2])])
def test_cells_that_are_not_all_different_are_refused(starts: list[int], goals: list[int]) -> None:
    with pytest.raises(ValueError, match=r"different|each robot"):
        plan(GridMap(), starts, goals)
