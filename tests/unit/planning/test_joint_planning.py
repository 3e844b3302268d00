"""Joint plans, checked by the independent checker: random and dense maps, improvement, lifelong runs."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.compiled import Kernel
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.exceptions import PlanningError
from rce_fleet.planning import fields, improvement, lacam
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.compaction import Compaction
from rce_fleet.planning.execution import execution_times
from rce_fleet.planning.graph import MAX_COST, PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.guidance import DOWN, LEFT, RIGHT, UP, aisle_factors, guided
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.lanes import Lane, LaneGraph
from rce_fleet.planning.lifelong import LIFELONG_KERNELS, LifelongPlanner, LifelongSettings
from rce_fleet.planning.motion import Motion
from rce_fleet.planning.planner import JointPlan, PlanningProblem

SHELVES = GridMap(
    9, 16, blocked=frozenset(r * 16 + c for r in (2, 3, 5, 6) for c in (*range(3, 7), *range(8, 13)))
)


AISLES = GridMap(5, 9, blocked=frozenset({*range(1, 9), *range(19, 26), *range(36, 45)}))
"""Two aisles, in the rows 1 and 3, from the first column to the last one, and a corner."""


def drawn(
    seed: int, count: int, share: float, *, rows: int = 8, columns: int = 9
) -> tuple[GridMap, list[int]]:
    """A random map, and the cells of its largest connected part, shuffled."""
    rng = Random(seed)
    total = rows * columns
    grid = GridMap(rows, columns, blocked=frozenset(rng.sample(range(total), int(share * total))))
    parts = [sorted(grid.reachable(cell)) for cell in grid.free]
    part = max(parts, key=len)
    rng.shuffle(part)
    return grid, part


def problem_of(grid: GridMap, cells: list[int], count: int, seed: int, **more: object) -> PlanningProblem:
    goals = cells[:]
    Random(seed + 1).shuffle(goals)
    return PlanningProblem.of(
        PlanningGraph.from_grid(grid),
        cells[:count],
        goals[:count],
        seed=seed,
        **more,  # type: ignore[arg-type]  # by name
    )


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 18),
    share=st.floats(0.0, 0.3),
    rotations=st.booleans(),
    improved=st.booleans(),
)
def test_plans_keep_the_rules_on_random_maps(
    seed: int, count: int, share: float, rotations: bool, improved: bool
) -> None:
    grid, cells = drawn(seed, count, share)
    count = min(count, len(cells) // 2)
    if count == 0:
        return
    seconds = 0.05 if improved else 0.0
    problem = problem_of(grid, cells, count, seed, rotations=rotations, seconds=seconds, effort=40_000)
    joint = LacamPlanner(compiled=False).plan(problem)
    paths = [joint.path(robot) for robot in range(count)]
    goals = problem.goals.tolist() if joint.complete else None
    faults = check_plan(grid, paths, starts=problem.starts.tolist(), goals=goals, rotations=rotations)
    assert faults == []


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 10), moving=st.booleans())
def test_plans_keep_to_lanes_costs_and_forbidden_cells(seed: int, count: int, moving: bool) -> None:
    """Together: one-way moves, costs of all and of one robot, cells that one may not enter, and turns."""
    grid, cells = drawn(seed, count, 0.15, rows=7, columns=8)
    rng = np.random.default_rng(seed)
    edges = [(cell, there) for cell in grid.free for there in grid.neighbours[cell] if there > cell]
    closed = [edges[index] for index in rng.choice(len(edges), len(edges) // 8, replace=False)]
    costs, own = rng.integers(1, 6, len(grid)), rng.integers(1, 6, len(grid))
    starts, goals = cells[:count], [*cells[1:count], cells[0]] if count > 1 else cells[-1:]
    barred = frozenset(cells[count : count + 4]) - set(goals)
    problem = PlanningProblem.of(
        PlanningGraph.from_grid(grid, costs=costs, closed=closed),
        starts,
        goals,
        seed=seed,
        effort=20_000,
        forbidden={0: barred},
        own_costs={count - 1: PlanningGraph.from_grid(grid, costs=own, closed=closed).costs},
        motion=Motion(0.75, 0.5, (0,) * count) if moving else None,
    )
    joint = LacamPlanner(compiled=False).plan(problem)
    paths = [joint.path(robot) for robot in range(count)]
    ends = goals if joint.complete else None
    assert check_plan(grid, paths, starts=starts, goals=ends, one_way=closed, rotations=False) == []
    assert not barred & set(paths[0])


def test_aisles_filled_with_robots_are_solved() -> None:
    cells = SHELVES.free
    starts, goals = cells[:40], cells[::-1][:40]
    problem = PlanningProblem.of(PlanningGraph.from_grid(SHELVES), starts, goals)
    joint = LacamPlanner(compiled=False).plan(problem)
    assert joint.complete
    paths = [joint.path(robot) for robot in range(40)]
    assert check_plan(SHELVES, paths, starts=starts, goals=goals, rotations=False) == []


def test_time_that_is_left_goes_into_the_search_for_a_first_plan() -> None:
    class FoundError(Exception):
        pass

    def found(joint: JointPlan) -> None:
        raise FoundError

    cells = sorted(SHELVES.free)
    problem = problem_of(SHELVES, cells, 40, 3, effort=400, rotations=True)
    planner = LacamPlanner(compiled=False, on_first=found)
    assert not planner.plan(problem).complete  # ten configurations are too few
    with pytest.raises(FoundError):
        planner.plan(replace(problem, seconds=120.0))


@pytest.mark.slow
@pytest.mark.parametrize("motion", [None, Motion(0.75, 0.5, (0,) * 40)], ids=["steps", "with turns"])
def test_a_search_is_repeated_until_a_plan_is_found(motion: Motion | None) -> None:
    """The rest of the hour is not used."""
    problem = problem_of(SHELVES, sorted(SHELVES.free), 40, 3, effort=400, motion=motion)
    planner = LacamPlanner(compiled=False)
    assert not planner.plan(problem).complete  # ten configurations are too few
    assert planner.plan(replace(problem, search_seconds=3600.0)).complete


@pytest.mark.slow
def test_robots_on_a_one_way_ring_need_a_longer_search() -> None:
    """One of 30 robots has no way past the others with the effort of a fleet without compiled loops."""
    side, across = range(12), (3, 6, 9)
    ring = [*side, *range(23, 144, 12), *range(142, 131, -1), *range(120, -1, -12)]
    lanes = LaneGraph(
        (
            Lane("ring", tuple(ring), one_way=True),
            *(Lane(f"row {row}", tuple(12 * row + column for column in side)) for row in across),
            *(Lane(f"column {column}", tuple(12 * row + column for row in side)) for column in across),
        )
    )
    grid, rng = lanes.restrict(GridMap(12, 12)), Random(0)
    starts, goals = rng.sample(grid.free, 30), rng.sample(grid.free, 30)
    problem = PlanningProblem.of(lanes.graph(grid), starts, goals, effort=FleetSettings().effort)
    planner = LacamPlanner(compiled=False)
    assert (planner.plan(problem).cells[-1] == goals).sum() == 29
    assert planner.plan(replace(problem, search_seconds=3600.0)).complete


@pytest.mark.slow
def test_improvement_lowers_the_cost() -> None:
    cells = SHELVES.free
    graph = PlanningGraph.from_grid(SHELVES)
    problem = PlanningProblem.of(graph, cells[:30], cells[::-1][:30], rotations=True)
    joint = LacamPlanner(compiled=False).plan(problem)
    table = fields.distance_fields(graph, problem.goals)
    improver = improvement.Improver(graph, table, joint.cells, problem.goals, rotations=True, seed=0)
    improver.improve(60)
    better = JointPlan(improver.cells, complete=True)
    assert improver.lower_bound <= better.cost == improver.cost < joint.cost
    paths = [better.path(robot) for robot in range(30)]
    assert check_plan(SHELVES, paths, goals=problem.goals.tolist()) == []


def test_a_forbidden_cell_is_entered_by_other_robots_only() -> None:
    grid = GridMap(3, 5)
    problem = PlanningProblem.of(
        PlanningGraph.from_grid(grid),
        [5, 9],
        [9, 5],
        forbidden={0: frozenset({7}), 1: frozenset({2})},
        seconds=0.1,
    )
    joint = LacamPlanner(compiled=False).plan(problem)
    assert joint.complete
    assert 7 not in joint.path(0)
    assert 2 not in joint.path(1)


def test_an_unreachable_goal_gives_an_incomplete_plan() -> None:
    grid = GridMap(1, 5, blocked=frozenset({2}))
    joint = LacamPlanner(compiled=False).plan(
        PlanningProblem.of(PlanningGraph.from_grid(grid), [0, 3], [4, 3], effort=500)
    )
    assert not joint.complete


def test_parallel_aisles_get_opposite_directions() -> None:
    free = np.ones((9, 16), dtype=bool)
    free.reshape(-1)[list(SHELVES.blocked)] = False
    factors = aisle_factors(free, against=3)
    assert factors[4, 5].tolist() == [1, 3, 1, 1]
    assert factors[2, 7].tolist() == [1, 1, 1, 1]  # two cells are not an aisle
    wide = np.zeros((7, 9), dtype=bool)
    wide[[1, 3, 5]] = True
    turned = aisle_factors(wide, against=2)
    assert [turned[row, 4, [LEFT, RIGHT]].tolist() for row in (1, 3, 5)] == [[2, 1], [1, 2], [2, 1]]
    assert (turned[..., [DOWN, UP]] == 1).all()


def test_guidance_keeps_graphs_without_aisles() -> None:
    graph = PlanningGraph.from_grid(GridMap())
    assert guided(graph) is graph
    assert not guided(PlanningGraph.from_grid(SHELVES)).is_unweighted


@pytest.mark.parametrize("of_one_robot", [False, True], ids=["of all", "of one robot"])
@pytest.mark.parametrize(("start", "goal", "row"), [(18, 26, 1), (26, 18, 3)], ids=["right", "left"])
def test_costs_somewhere_leave_the_guidance(of_one_robot: bool, start: int, goal: int, row: int) -> None:
    """Of two aisles of the same length a robot takes the one of its direction, though a corner is dear."""
    costs = np.ones(len(AISLES), np.int32)
    costs[0] = 5
    plain, dear = PlanningGraph.from_grid(AISLES), PlanningGraph.from_grid(AISLES, costs=costs)
    graph, own = (plain, {0: dear.costs}) if of_one_robot else (dear, None)
    for seed in range(6):
        problem = PlanningProblem.of(graph, [start], [goal], own_costs=own, seed=seed)
        assert 9 * row + 4 in LacamPlanner(compiled=False).plan(problem).path(0)


def test_own_costs_get_the_factors_of_guidance() -> None:
    own = np.full(len(PlanningGraph.from_grid(AISLES).costs), 3, np.int32)
    part = Compaction(PlanningProblem.of(PlanningGraph.from_grid(AISLES), [0], [9], own_costs={0: own}))
    guide = part.compact(guided(PlanningGraph.from_grid(AISLES)))
    assert part.own_costs_on(part.graph) is part.own_costs
    assert (part.own_costs_on(guide)[0] == 3 * guide.costs).all()
    assert guide.costs.max() == 2


def test_guidance_leaves_moves_without_an_opposite() -> None:
    """An operator's one-way aisle stays as cheap as it is, whatever its direction."""
    grid = GridMap(1, 9)
    costs = [guided(PlanningGraph.from_grid(grid)).costs]
    for offset in (-1, 1):
        closed = [(cell, cell + offset) for cell in range(9) if 0 <= cell + offset < 9]
        costs.append(guided(PlanningGraph.from_grid(grid, closed=closed)).costs)
    assert [each.max() for each in costs] == [2, 1, 1]


def test_guidance_keeps_the_largest_costs_possible() -> None:
    graph = PlanningGraph.from_grid(GridMap(1, 9), costs=np.full(9, MAX_COST))
    assert guided(graph).costs.max() == MAX_COST


@pytest.mark.slow
@pytest.mark.parametrize("rotations", [False, True])
def test_lifelong_robots_visit_their_goals_in_order(rotations: bool) -> None:
    rng = np.random.default_rng(4)
    cells = np.array(SHELVES.free, np.int32)
    asked: dict[int, list[int]] = {robot: [] for robot in range(12)}

    def next_goal(robot: int, before: int) -> int:
        goal = int(rng.choice(cells[cells != before]))
        asked[robot].append(goal)
        return goal

    planner = LifelongPlanner(
        PlanningGraph.from_grid(SHELVES),
        rng.choice(cells, 12, replace=False),
        next_goal,
        settings=LifelongSettings(window=8, tries=1, rotations=rotations),
    )
    rows = [planner.cells]
    reached = 0
    for _ in range(40):
        reached += planner.step()
        rows.append(planner.cells)
    paths = np.stack(rows, axis=1).tolist()
    assert check_plan(SHELVES, paths, rotations=rotations) == []
    assert reached == sum(map(len, planner.goals)) > 12
    for robot, goals in enumerate(planner.goals):
        assert goals == asked[robot][: len(goals)]
        at = 0
        for goal in goals:
            at = paths[robot].index(goal, at)


def test_lifelong_robot_without_a_way_is_named() -> None:
    grid = GridMap(1, 5, blocked=frozenset({2}))
    with pytest.raises(PlanningError, match="robot 0 cannot reach its goal 4 from its start 0"):
        LifelongPlanner(PlanningGraph.from_grid(grid), np.array([0], np.int32), lambda *_: 4)


@pytest.mark.slow
def test_compiled_loops_equal_plain_ones() -> None:
    """The same problem with all loops compiled, and with all of them plain, gives the same plans."""
    pytest.importorskip("numba")
    grid, cells = drawn(5, 12, 0.2)
    kernels: list[Kernel[..., Any]] = [*lacam.KERNELS, *LIFELONG_KERNELS]
    answers = []
    for compiled in (False, True):
        for each in kernels:
            if compiled:
                each.use_compiled()
            else:
                each.use_numpy()
        answers.append(_everything(grid, cells))
    assert answers[0] == answers[1]


def _everything(grid: GridMap, cells: list[int]) -> list[object]:
    graph = PlanningGraph.from_grid(grid)
    costs = np.random.default_rng(1).integers(1, 40, len(grid))
    heavy = PlanningGraph.from_grid(grid, costs=costs)
    light = PlanningGraph.from_grid(grid, costs=costs % 7 + 1)
    answers: list[object] = [
        fields.distance_fields(each, cells[:count]).tolist()
        for each in (graph, heavy, light)
        for count in (6, fields.LANES + 9)
    ]
    problem = problem_of(grid, cells, 12, 3)
    joint = LacamPlanner(compiled=False).plan(problem)
    answers.append(joint.steps)
    motion = Motion(0.75, 0.5, tuple(robot % 5 for robot in range(12)))
    moving = LacamPlanner(compiled=False).plan(problem_of(grid, cells, 12, 3, motion=motion, effort=8000))
    answers += [moving.steps, execution_times(moving.cells, grid.columns, motion).tolist()]
    table = fields.distance_fields(graph, problem.goals)
    improver = improvement.Improver(graph, table, joint.cells, problem.goals, rotations=True, seed=2)
    improver.improve(25)
    answers.append(improver.cells.tolist())
    rng = np.random.default_rng(2)
    lifelong = LifelongPlanner(
        graph, problem.starts, lambda _, before: int(rng.choice([c for c in cells if c != before])),
        settings=LifelongSettings(window=6, tries=1),
    )  # fmt: skip
    for _ in range(8):
        lifelong.step()
        answers.append(lifelong.cells.tolist())
    return answers
