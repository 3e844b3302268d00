"""Planners by name, graphs, and what plans say of themselves."""

from __future__ import annotations

import tracemalloc
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from rce_fleet.exceptions import PlannerError, PlanningError
from rce_fleet.planning import planner
from rce_fleet.planning.dijkstra import distances
from rce_fleet.planning.fields import UNREACHABLE, distance_fields
from rce_fleet.planning.graph import Edge, PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.motion import Motion, Turning
from rce_fleet.planning.pibt import roll_out
from rce_fleet.planning.planner import JointPlan, PlanningProblem, load_planner, planner_names
from rce_fleet.planning.swap import OPEN


def test_both_planners_are_installed() -> None:
    assert {"dijkstra", "lacam"} <= set(planner_names())


def test_an_unknown_planner_names_the_known_ones() -> None:
    with pytest.raises(PlannerError, match=r"no planner 'best'; installed are .*dijkstra, lacam"):
        load_planner("best")


def test_an_object_that_cannot_plan_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("broken", "builtins:object", planner.PLANNER_ENTRY_POINTS)
    monkeypatch.setattr(planner, "entry_points", lambda *, group: [point] if group else [])
    with pytest.raises(PlannerError, match=r"builtins:object.* has no method 'plan'"):
        load_planner("broken")


@pytest.mark.parametrize("name", ["dijkstra", "lacam"])
def test_a_planner_avoids_walls_and_forbidden_cells(name: str) -> None:
    grid = GridMap(3, 3, blocked=frozenset({4}))
    problem = PlanningProblem.of(PlanningGraph.from_grid(grid), [0], [8], forbidden={0: frozenset({1})})
    joint = load_planner(name).plan(problem)
    assert joint.complete
    assert joint.path(0) == [0, 3, 6, 7, 8]


@pytest.mark.parametrize(("barred", "complete"), [((0,), True), ((0, 1), False)])
def test_robots_do_not_pass_in_a_forbidden_bay(barred: tuple[int, ...], complete: bool) -> None:
    """Two robots change places in an aisle with one bay, which one of them or none may enter."""
    grid, bay = GridMap(2, 3, blocked=frozenset({3, 5})), 4
    forbidden = {robot: frozenset({bay}) for robot in barred}
    problem = PlanningProblem.of(PlanningGraph.from_grid(grid), [0, 2], [2, 0], forbidden=forbidden)
    joint = load_planner("lacam").plan(problem)
    assert (joint.complete, joint.impossible) == (complete, not complete)
    assert not any(bay in joint.cells[:, robot] for robot in barred)


@pytest.mark.parametrize(("forbidden", "entered"), [({}, 5), ({1: frozenset({5})}, 6)])
def test_a_robot_is_not_pulled_into_a_forbidden_cell(
    forbidden: dict[int, frozenset[int]], entered: int
) -> None:
    """Robot 0 goes back in an aisle to get past robot 1, which stands at its goal and follows it."""
    grid = GridMap(3, 4, blocked=frozenset({1, 2, 3, 9, 10, 11}))
    graph, goals = PlanningGraph.from_grid(grid), np.array([7, 6], np.int32)
    rows, zeros = np.array([[5, 6], [0, 0]], np.int32), np.zeros((2, 2), np.int32)
    table = distance_fields(graph, goals, forbidden, rows[0])
    roll_out(
        graph.indptr, graph.neighbours, table, int(UNREACHABLE), goals, np.full(2, OPEN, np.int32), rows,
        zeros.copy(), np.arange(2, dtype=np.int32), 0, zeros.copy(), *Turning.none(2).arrays,
        np.array([1], np.int64),
    )  # fmt: skip
    assert rows[1].tolist() == [4, entered]


@pytest.mark.slow
def test_a_long_way_on_a_large_map_takes_little_memory() -> None:
    """A table of who is where and when has four bytes for each step and node, even with one robot."""
    grid = GridMap(220, 220)
    problem = PlanningProblem.of(PlanningGraph.from_grid(grid), [0], [len(grid) - 1])
    tracemalloc.start()
    try:
        joint = LacamPlanner(compiled=False).plan(problem)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert joint.cost == 438
    assert peak < 40e6


def test_dijkstra_does_not_promise_freedom_of_conflicts() -> None:
    joint = load_planner("dijkstra").plan(
        PlanningProblem.of(PlanningGraph.from_grid(GridMap(1, 3)), [0, 2], [2, 0])
    )
    assert joint.complete
    assert not joint.conflict_free
    assert joint.cost == 4


def test_one_way_edges_are_driven_in_their_direction() -> None:
    ring = PlanningGraph.from_edges(4, [Edge(node, (node + 1) % 4, 3) for node in range(4)])
    joint = load_planner("lacam").plan(PlanningProblem.of(ring, [1], [0]))
    assert joint.path(0) == [1, 2, 3, 0]
    assert distance_fields(ring, [0])[0].tolist() == [0, 9, 6, 3]


def test_closed_moves_and_costs_change_the_path() -> None:
    grid = GridMap(2, 3)
    straight = PlanningGraph.from_grid(grid)
    closed = PlanningGraph.from_grid(grid, closed=[(0, 1)])
    slow = PlanningGraph.from_grid(grid, costs=np.array([1, 9, 1, 1, 1, 1]))
    assert distance_fields(straight, [2])[0, 0] == 2
    assert distance_fields(closed, [2])[0, 0] == 4
    assert distance_fields(slow, [2])[0, 0] == 4
    assert distance_fields(closed, [0])[0, 2] == 2


@pytest.mark.parametrize("planner", ["lacam", "dijkstra"])
@pytest.mark.parametrize("forbidden", [None, {1: frozenset({13})}], ids=["open", "forbidden"])
@pytest.mark.parametrize("motion", [None, Motion(1.0, 0.5)], ids=["steps", "turns"])
def test_own_costs_change_the_path_of_one_robot(
    planner: str, forbidden: dict[int, frozenset[int]] | None, motion: Motion | None
) -> None:
    """Two robots with the same short way along a wall; cells of it are dear for the first one."""
    grid = GridMap(3, 9, blocked=frozenset(range(10, 17)) - {13})
    dear = np.ones(27, np.int32)
    dear[[3, 4, 5, 13]] = 9
    graph = PlanningGraph.from_grid(grid)
    own = {0: PlanningGraph.from_grid(grid, costs=dear).costs}
    problem = PlanningProblem.of(graph, [9, 1], [8, 7], forbidden=forbidden, own_costs=own, motion=motion)
    joint = load_planner(planner).plan(problem)
    assert joint.complete
    assert 22 in joint.path(0)
    assert 4 in joint.path(1)


def test_own_costs_are_those_of_all_edges() -> None:
    graph = PlanningGraph.from_grid(GridMap(2, 2))
    with pytest.raises(PlanningError, match="robot 0 has 3 own costs for 8 edges"):
        PlanningProblem.of(graph, [0], [3], own_costs={0: np.ones(3, np.int32)})


def test_fields_are_the_distances_of_the_grid() -> None:
    rng = np.random.default_rng(3)
    grid = GridMap(9, 7, blocked=frozenset(rng.choice(63, 20, replace=False).tolist()))
    costs = rng.integers(1, 9, 63)
    plain = distance_fields(PlanningGraph.from_grid(grid), grid.free)
    weighted = distance_fields(PlanningGraph.from_grid(grid, costs=costs), grid.free)
    for row, goal in enumerate(grid.free):
        steps = distances(grid, goal)
        for cell in grid.free:
            assert plain[row, cell] == min(steps[cell], UNREACHABLE)
        leaving = distances(grid, goal, costs.tolist())  # costs of leaving; ours are of entering
        for cell in grid.free:
            if leaving[cell] < UNREACHABLE:
                assert weighted[row, cell] == leaving[cell] - costs[cell] + costs[goal]


@pytest.mark.parametrize(
    ("starts", "goals", "said"),
    [
        ([0, 0], [1, 2], "robots 0 and 1 have the same start, cell 0"),
        ([0, 1], [2, 2], "robots 0 and 1 have the same goal, cell 2"),
        ([0], [1, 2], "1 starts and 2 goals"),
        ([0], [64], "the goal of robot 0, 64, is not within 0 .. 63"),
    ],
)
def test_a_malformed_problem_says_which_robot(starts: list[int], goals: list[int], said: str) -> None:
    with pytest.raises(PlanningError, match=said):
        PlanningProblem.of(PlanningGraph.from_grid(GridMap()), starts, goals)


def test_an_edge_to_a_missing_node_is_refused() -> None:
    with pytest.raises(ValueError, match="from 0 to 5"):
        PlanningGraph.from_edges(2, [Edge(0, 5)])


def test_a_plan_counts_steps_to_the_last_arrival() -> None:
    joint = JointPlan.of([(0, 5), (1, 5), (2, 4), (1, 5), (2, 5)], complete=True)
    assert joint.arrivals.tolist() == [4, 3]
    assert (joint.cost, joint.makespan) == (7, 4)
    assert joint.path(1) == [5, 5, 4, 5]
    assert joint.route(0) == [(0, 0), (1, 1), (2, 2), (3, 1), (4, 2)]
    steps, robots, cells = joint.visits()
    assert list(zip(steps.tolist(), robots.tolist(), cells.tolist(), strict=True))[:3] == [
        (1, 0, 1), (2, 0, 2), (2, 1, 4),
    ]  # fmt: skip
