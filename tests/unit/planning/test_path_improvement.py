"""Better paths for robots that drive: they arrive earlier in all, no robot waits in a circle."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from unit.fleet.test_rerouting import Route, drive, last_waited_for, name, planned, routed

from rce_fleet.compiled import is_available
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.path_improvement import PATH_IMPROVEMENT_KERNELS, ImprovedPaths, improved

EFFORT = 15_000


def find(seed: int, urgent: tuple[int, ...] = ()) -> tuple[list[int], list[int], list[Route], ImprovedPaths]:
    """Return the robots' starts, goals and paths on a crowded map, and better paths."""
    grid, starts, goals, routes = planned(seed, count=16)
    robots = routed(starts, goals, routes)
    graph = PlanningGraph.from_grid(grid)
    found = improved(graph, robots, seconds=inf, effort=EFFORT, seed=seed, urgent=urgent)
    for robot, (cells, _) in found.paths.items():
        assert grid.is_path([starts[robot], *cells.tolist()])
        assert cells[-1] == goals[robot]
    return starts, goals, routes, found


def arrivals(routes: list[Route]) -> list[float]:
    return [route[-1][1] if route else 0.0 for route in routes]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_better_paths_arrive_earlier_and_in_no_circle(seed: int) -> None:
    """Robots drive in any order; who does not arrive waits for one that is in its goal."""
    starts, goals, routes, found = find(seed)
    before = sum(arrivals(routes))
    for robot, (cells, steps) in found.paths.items():
        routes[robot] = list(zip(cells.tolist(), steps.tolist(), strict=True))
    assert sum(arrivals(routes)) == pytest.approx(before - found.gain)
    assert found.gain >= 1
    ledger = drive(starts, routes, seed)
    for last in last_waited_for(ledger, len(starts)):
        assert last in [
            name(robot) for robot in range(len(starts)) if ledger.route(name(robot)) == [goals[robot]]
        ]


@pytest.mark.slow
def test_urgent_robots_arrive_no_later() -> None:
    later = dict[bool, int]()
    for is_urgent in (False, True):
        urgent = tuple(range(16)) if is_urgent else ()
        results = [find(seed, urgent) for seed in range(6)]
        later[is_urgent] = sum(
            steps[-1] > arrivals(routes)[robot]
            for *_, routes, found in results
            for robot, (_, steps) in found.paths.items()
        )
    assert later[True] == 0
    assert later[False] > 0


def test_paths_that_cannot_be_better_are_kept() -> None:
    """One robot on its shortest path, one that waits in vain: only the second gets another path."""
    grid = GridMap(2, 8)
    straight = [(cell, float(cell)) for cell in range(1, 8)]
    late = [(cell, cell + 10.0) for cell in range(9, 15)]
    robots = routed([0, 8], [7, 14], [straight, late])
    found = improved(PlanningGraph.from_grid(grid), robots, seconds=inf, effort=EFFORT)
    assert found.is_done
    assert list(found.paths) == [1]
    assert found.paths[1][1].tolist() == [1, 2, 3, 4, 5, 6]


def test_forbidden_nodes_are_not_entered() -> None:
    grid = GridMap(3, 5)
    around = [(5, 20.0), (10, 21.0), (11, 22.0), (12, 23.0), (13, 24.0), (14, 25.0), (9, 26.0), (4, 27.0)]
    robots = routed([0], [4], [around])
    found = improved(
        PlanningGraph.from_grid(grid), robots, seconds=inf, effort=EFFORT, forbidden={0: frozenset({2})}
    )
    assert found.paths[0][0].tolist() == [1, 6, 7, 8, 3, 4]


def test_no_time_or_no_effort_changes_nothing() -> None:
    grid, starts, goals, routes = planned(1)
    graph, robots = PlanningGraph.from_grid(grid), routed(starts, goals, routes)
    assert improved(graph, robots, seconds=0, effort=EFFORT).paths == {}
    assert improved(graph, robots, seconds=inf, effort=0).paths == {}


@pytest.mark.slow
def test_compiled_and_plain_loops_find_the_same() -> None:
    if not is_available():
        pytest.skip("numba is not installed")
    plain = [find(seed)[-1] for seed in range(3)]
    for loop in PATH_IMPROVEMENT_KERNELS:
        loop.use_compiled()
    for seed, one in enumerate(plain):
        other = find(seed)[-1]
        assert one.gain == pytest.approx(other.gain)
        assert one.paths.keys() == other.paths.keys()
        for robot, (cells, steps) in one.paths.items():
            np.testing.assert_array_equal(cells, other.paths[robot][0])
            np.testing.assert_array_equal(steps, other.paths[robot][1])


def test_a_node_that_another_robot_never_leaves_is_not_entered() -> None:
    grid = GridMap(2, 3)
    late = [(3, 20.0), (4, 21.0), (5, 22.0), (2, 23.0)]
    fixed = (np.array([1], np.int32), np.array([inf]))
    robots = replace(routed([0], [2], [late]), fixed=fixed)
    found = improved(PlanningGraph.from_grid(grid), robots, seconds=inf, effort=EFFORT)
    assert found.paths[0][0].tolist() == [3, 4, 5, 2]
    assert found.paths[0][1][-1] < 23
