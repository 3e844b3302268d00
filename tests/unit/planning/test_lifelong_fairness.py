"""Lifelong runs: each robot gets its turn, steps end in time, and congestion raises costs."""

from __future__ import annotations

import numpy as np
import pytest

from rce_fleet.exceptions import PlanningError
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.congestion import Congestion, CongestionSettings
from rce_fleet.planning.fields import distance_fields
from rce_fleet.planning.graph import Edge, PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lifelong import LifelongPlanner, LifelongSettings

SIDE, WINDOW = 5, 4
FLOOR = GridMap(SIDE, SIDE)
TORUS = PlanningGraph.from_edges(
    SIDE * SIDE,
    [
        Edge(row * SIDE + column, (row + up) % SIDE * SIDE + (column + right) % SIDE)
        for row in range(SIDE)
        for column in range(SIDE)
        for up, right in ((0, 1), (1, 0), (0, -1), (-1, 0))
    ],
)


def lifelong(robots: int, seed: int, graph: PlanningGraph | None = None, **more: float) -> LifelongPlanner:
    rng = np.random.default_rng(seed)
    cells = np.array(FLOOR.free, np.int32)
    return LifelongPlanner(
        graph or PlanningGraph.from_grid(FLOOR),
        rng.choice(cells, robots, replace=False),
        lambda _, before: int(rng.choice(cells[cells != before])),
        seed=seed,
        settings=LifelongSettings(window=WINDOW, tries=1, **more),  # type: ignore[arg-type]  # by name
    )


@pytest.mark.slow
def test_the_robot_without_a_goal_for_longest_arrives() -> None:
    """Once it is the most urgent, it needs at most its distance and two windows, in a crowd.

    The floor has no edge, so every robot can give way, and PIBT needs no swap, which makes way for others.
    """
    robots = 20
    planner = lifelong(robots, 1, TORUS)
    table = distance_fields(TORUS, range(SIDE * SIDE))
    waited = np.zeros(robots, int)
    urgent, until = -1, 0
    for step in range(50):
        if urgent != int(np.argmax(waited)):
            urgent = int(np.argmax(waited))
            until = step + int(table[planner.target(urgent), planner.cells[urgent]]) + 2 * WINDOW
        before = [len(goals) for goals in planner.goals]
        planner.step()
        assert len(set(planner.cells.tolist())) == robots
        arrived = np.array([len(goals) for goals in planner.goals]) > before
        waited = np.where(arrived, 0, waited + 1)
        assert arrived[urgent] or step < until, f"step {step}: robot {urgent} should be at its goal"
    assert min(map(len, planner.goals)) > 0


def test_planning_anew_never_delays_the_most_urgent_robot() -> None:
    """Two robots cross in one cell. By the sum either may wait; the urgent one goes first."""
    cross = GridMap(3, 3, blocked=frozenset({0, 2, 6, 8}))
    opposite = {3: 5, 5: 3, 1: 7, 7: 1}
    planner = LifelongPlanner(
        PlanningGraph.from_grid(cross), np.array([3, 1], np.int32), lambda _, before: opposite[before],
        settings=LifelongSettings(window=8),
    )  # fmt: skip
    planner._improve(0, 0, 0, 40)
    for urgent, arrivals in ((0, (2, 3)), (1, (3, 2)), (0, (2, 3))):
        for _ in range(40):
            planner._improve(urgent, 0, 2, 12)
            found = tuple(planner._paths[robot].tolist().index(goal) for robot, goal in ((0, 5), (1, 7)))
            if found == arrivals:
                break
        for _ in range(20):
            planner._improve(urgent, 0, 2, 12)
            assert planner._paths[urgent].tolist().index((5, 7)[urgent]) == 2


def test_limited_time_leaves_a_plan_without_conflicts() -> None:
    """Without time for any improvement robots still drive, by PIBT alone."""
    planner = lifelong(15, 3, seconds=1e-9)
    rows = [planner.cells]
    for _ in range(40):
        planner.step()
        rows.append(planner.cells)
    assert check_plan(FLOOR, np.stack(rows, axis=1).tolist()) == []
    assert sum(map(len, planner.goals)) > 20


def test_ample_time_gives_the_same_quality() -> None:
    """The parts that are planned between two looks at the clock add up to the whole work."""
    reached = []
    for seconds in (0.0, 60.0):
        planner = lifelong(10, 4, seconds=seconds)
        reached.append(sum(planner.step() for _ in range(25)))
    assert reached[1] > 0.9 * reached[0]


def test_waits_raise_costs_to_a_bound_and_fade() -> None:
    graph = PlanningGraph.from_grid(GridMap(1, 4))
    congestion = Congestion(graph, CongestionSettings(half_life=4, most=1.5, weight=2.0))
    assert congestion.graph().costs.tolist() == [4] * 6
    for _ in range(8):
        congestion.observe(waiting=[1, 1, 2], wanted=[2, 2, 2])
    edge = int(graph.indptr[1]) + graph.edges_from(1).tolist().index(2)
    assert congestion.waits[edge] == pytest.approx(2 * (1 - 0.25))
    assert np.flatnonzero(congestion.graph().costs != 4).tolist() == [edge]
    assert congestion.graph().costs[edge] == 6
    for _ in range(40):
        congestion.observe(waiting=[], wanted=[])
    assert congestion.graph().costs.tolist() == [4] * 6


def test_lifelong_robots_drive_by_learned_costs() -> None:
    planner = lifelong(15, 5)
    congestion = Congestion(PlanningGraph.from_grid(FLOOR))
    rows = [planner.cells]
    for step in range(25):
        congestion.observe(*planner.waiting())
        if step % 10 == 9:
            planner.guide(congestion.graph())
        planner.step()
        rows.append(planner.cells)
    assert congestion.waits.sum() > 0
    assert check_plan(FLOOR, np.stack(rows, axis=1).tolist()) == []
    assert sum(map(len, planner.goals)) > 20
    with pytest.raises(PlanningError, match="must have the same nodes and edges"):
        planner.guide(PlanningGraph.from_grid(GridMap(2, 2)))


def test_later_goals_may_be_out_of_reach() -> None:
    """Two of them in a row: the way over them is as far as can be said, and the first goal is reached."""
    parts = PlanningGraph.from_edges(4, [Edge(0, 1), Edge(1, 0), Edge(2, 3), Edge(3, 2)])
    goals = iter([1, 2, 0, 3] * 10)
    planner = LifelongPlanner(
        parts, np.array([0], np.int32), lambda *_: next(goals), settings=LifelongSettings(window=WINDOW)
    )
    for _ in range(2 * WINDOW):
        planner.step()
    assert planner.goals == [[1]]
