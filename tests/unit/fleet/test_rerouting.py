"""New paths for some robots between those of the others: no collision, no circle, the others undisturbed."""

from __future__ import annotations

from dataclasses import replace
from itertools import takewhile
from random import Random

import numpy as np
import pytest

from rce_fleet.compiled import is_available
from rce_fleet.coordination.ledger import CellLedger
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.guidance import RIGHT, UP
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.motion import Motion
from rce_fleet.planning.planner import PlanningProblem
from rce_fleet.planning.rerouting import REROUTING_KERNELS, Rerouted, RoutedRobots, reroute

Route = list[tuple[int, float]]


def planned(seed: int, count: int = 12) -> tuple[GridMap, list[int], list[int], list[Route]]:
    """Return a map, the robots' starts, goals and paths."""
    rng = Random(seed)
    walls = frozenset(rng.sample(range(80), 12))
    grid = GridMap(8, 10, blocked=walls)
    free = sorted(grid.reachable(grid.free[0]))
    starts, goals = rng.sample(free, count), rng.sample(free, count)
    problem = PlanningProblem.of(PlanningGraph.from_grid(grid), starts, goals, seed=seed)
    joint = LacamPlanner(compiled=False).plan(problem)
    routes = [[(cell, float(step)) for step, cell in joint.route(robot)[1:]] for robot in range(count)]
    return grid, starts, goals, routes


def routed(starts: list[int], goals: list[int], routes: list[Route]) -> RoutedRobots:
    visits = [visit for route in routes for visit in route]
    return RoutedRobots(
        starts=np.array(starts, np.int32),
        begins=np.zeros(len(starts)),
        goals=np.array(goals, np.int32),
        rests=np.full(len(starts), -1, np.int32),
        lengths=np.array([len(route) for route in routes], np.int32),
        nodes=np.array([cell for cell, _ in visits], np.int32),
        steps=np.array([step for _, step in visits]),
        fixed=(np.empty(0, np.int32), np.empty(0)),
        clock=0.0,
    )


def name(robot: int) -> str:
    return f"Robot{robot}"


def drive(starts: list[int], routes: list[Route], seed: int) -> CellLedger:
    """Let robots drive their routes, in any order that the ledger grants, until none can drive on."""
    ledger, rng = CellLedger(), Random(seed)
    names = [name(index) for index in range(len(starts))]
    for robot, start in zip(names, starts, strict=True):
        ledger.place(robot, start)
    for robot, route in zip(names, routes, strict=True):
        ledger.insert(robot, route)
    ledger.validate()
    moved = True
    while moved:
        moved = False
        for robot in rng.sample(names, len(names)):
            ledger.grant(robot, rng.randint(1, 3))
            granted = len(ledger.granted(robot))
            if granted > 1:
                ledger.arrive(robot, rng.randint(1, granted - 1))
                moved = True
        ledger.validate()
    return ledger


def last_waited_for(ledger: CellLedger, count: int) -> list[str]:
    """Return for each robot that waits the last one of those that it waits for, one after another.

    Raises:
        AssertionError: Robots wait for each other in a circle.
    """
    waits_for = {}
    for robot in range(count):
        route = ledger.route(name(robot))
        if len(route) > 1:
            ahead = min(
                (step, other)
                for other in map(name, range(count))
                for cell, step in ledger.horizon(other)
                if cell == route[1]
            )
            waits_for[name(robot)] = ahead[1]
    ends = []
    for first in waits_for:
        last, seen = first, set()
        while last in waits_for:
            assert last not in seen, f"{last} waits for itself"
            seen.add(last)
            last = waits_for[last]
        ends.append(last)
    return ends


def find(seed: int) -> tuple[GridMap, list[int], list[int], list[Route], int, Rerouted | None]:
    """Block a cell on robots' paths; return the map, starts, goals, paths, the cell and the new paths."""
    grid, starts, goals, routes = planned(seed)
    used = sorted({cell for route in routes for cell, _ in route} - set(starts) - set(goals))
    blocked = Random(seed).choice(used)
    left = [list(takewhile(lambda visit: visit[0] != blocked, route)) for route in routes]
    members = [robot for robot, route in enumerate(routes) if len(left[robot]) < len(route)]
    graph = PlanningGraph.from_grid(grid.with_blocked(grid.blocked | {blocked}))
    found = reroute(graph, routed(starts, goals, left), members, effort=20_000, seed=seed)
    if found is not None:
        assert set(members) <= found.paths.keys()
    return grid, starts, goals, routes, blocked, found


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_robots_with_new_paths_wait_in_no_circle(seed: int) -> None:
    """Whatever the order in which robots drive, they arrive, or wait for one that is in its goal."""
    grid, starts, goals, routes, blocked, found = find(seed)
    if found is None:
        return  # A plan for all follows then.
    for robot, (cells, steps) in found.paths.items():
        routes[robot] = list(zip(cells.tolist(), steps.tolist(), strict=True))
        assert grid.is_path([starts[robot], *cells.tolist()])
        assert grid.blocked.union([blocked]).isdisjoint(cells.tolist())
        assert robot in found.unreachable or [starts[robot], *cells.tolist()][-1] == goals[robot]
    ledger = drive(starts, routes, seed)
    for first in last_waited_for(ledger, len(starts)):
        index = int(first.removeprefix("Robot"))
        assert ledger.route(first) == [goals[index]] or index in found.unreachable


def test_most_blocked_cells_need_no_plan_for_all() -> None:
    """New paths are found for most blocked cells, and most other robots keep theirs."""
    results = [find(seed) for seed in range(100, 130)]
    found = [result for *_, result in results if result is not None]
    assert len(found) > len(results) / 2


def aisle_with_a_standing_robot() -> tuple[GridMap, list[int], list[int], list[Route]]:
    """Return an aisle that Robot0 has to go through.

    Robot1 stands in it, in its goal, beside a bay. Robot2 is due in its cell much later. All others cross the
    aisle, each just when Robot0 could be there.
    """
    columns, crossings = 30, range(2, 24, 2)
    free = {columns + column for column in range(columns)} | {26, 2 * columns + 27, 2 * columns + 28}
    free |= {side + column for column in crossings for side in (0, 2 * columns)}
    grid = GridMap(3, columns, blocked=frozenset(range(3 * columns)) - free)
    starts = [columns, columns + 27, 2 * columns + 27, *crossings]
    goals = [2 * columns - 1, columns + 27, 2 * columns + 28, *(2 * columns + column for column in crossings)]
    due = [(columns + 27, 150.0), (columns + 28, 151.0), (2 * columns + 28, 152.0)]
    crossed: list[Route] = [
        [(columns + column, float(column)), (2 * columns + column, column + 1.0)] for column in crossings
    ]
    return grid, starts, goals, [[], [], due, *crossed]


def test_standing_robot_in_an_aisle_makes_way_first() -> None:
    """The robot without which there is a path makes way; those that only cross keep their paths."""
    grid, starts, goals, routes = aisle_with_a_standing_robot()
    graph = PlanningGraph.from_grid(grid)
    found = reroute(graph, routed(starts, goals, routes), [0], effort=20_000, seed=1)
    assert found is not None
    assert found.paths.keys() == {0, 1}
    for robot, (cells, steps) in found.paths.items():
        assert cells[-1] == goals[robot]
        routes[robot] = list(zip(cells.tolist(), steps.tolist(), strict=True))
    ledger = drive(starts, routes, 1)
    assert [ledger.route(name(robot)) for robot in (0, 1)] == [[goals[0]], [goals[1]]]


def test_own_costs_lead_one_robot_around() -> None:
    """Two robots with the same short way; cells of it are dear for the first one."""
    grid = GridMap(3, 9, blocked=frozenset(range(10, 17)))
    graph = PlanningGraph.from_grid(grid)
    dear = np.ones(27, np.int32)
    dear[3:6] = 5
    own = {0: PlanningGraph.from_grid(grid, costs=dear).costs}
    robots = routed([9, 1], [8, 7], [[(9, 0.0)], [(1, 0.0)]])
    found = reroute(graph, robots, (0, 1), effort=10_000, own_costs=own)
    assert found is not None
    assert 22 in found.paths[0][0]
    assert 4 in found.paths[1][0]


SLOW_TURNS = Motion(quarter_turn=1.0, stop=0.5)


@pytest.mark.parametrize("direction", [RIGHT, UP])
def test_new_path_has_few_turns(direction: int) -> None:
    """Of all shortest paths the one that begins where the robot faces, with one turn."""
    graph = PlanningGraph.from_grid(GridMap(5, 6))
    motion = replace(SLOW_TURNS, headings=(direction,))
    found = reroute(graph, routed([0], [29], [[]]), [0], effort=20_000, motion=motion)
    assert found is not None
    cells, steps = found.paths[0]
    corner = 5 if direction == RIGHT else 24
    assert corner in cells
    assert len(cells) == 9
    assert steps[-1] == pytest.approx(9 + 1.5)


def test_new_path_is_longer_to_save_turns() -> None:
    """A zigzag of 8 moves with seven turns; around it 10 moves with two."""
    zigzag = [0, 1, 7, 8, 14, 15, 21, 22, 28]
    around = [0, 6, 12, 18, 24, 30, 31, 32, 33, 34, 28]
    grid = GridMap(6, 6, blocked=frozenset(range(36)) - {*zigzag, *around})
    graph = PlanningGraph.from_grid(grid)
    for motion, expected in ((None, zigzag), (replace(SLOW_TURNS, headings=(RIGHT,)), around)):
        found = reroute(graph, routed([0], [28], [[]]), [0], effort=20_000, motion=motion)
        assert found is not None
        assert found.paths[0][0].tolist() == expected[1:]


def test_compiled_and_plain_loops_find_the_same_paths() -> None:
    """Both forms of the loops find the same paths."""
    if not is_available():
        pytest.skip("numba is not installed")
    plain = [find(seed)[-1] for seed in range(6)]
    for loop in REROUTING_KERNELS:
        loop.use_compiled()
    compiled = [find(seed)[-1] for seed in range(6)]
    for one, other in zip(plain, compiled, strict=True):
        assert (one is None) == (other is None)
        if one is None or other is None:
            continue
        assert one.paths.keys() == other.paths.keys()
        for robot, (cells, steps) in one.paths.items():
            np.testing.assert_array_equal(cells, other.paths[robot][0])
            np.testing.assert_array_equal(steps, other.paths[robot][1])
