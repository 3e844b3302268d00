"""A robot with a goal that can be reached waits for a limited time, whatever the others do."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rce_fleet.coordination.events import GoalSet
from rce_fleet.coordination.fleet_state import FleetState
from rce_fleet.coordination.path_supply import PathSupply
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.planner import PlanningProblem
from rce_fleet.planning.straightening import ends_of, straighten

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

POCKET = GridMap(2, 6, blocked=frozenset({6, 7, 9, 10, 11}))
"""A corridor of cells 0 to 5, with cell 8 beside cell 2."""
STANDS_AT_MOST = 60.0
"""Seconds, of the 90 that a random fleet drives: 600 ticks."""


def test_way_that_a_silent_robot_blocked_is_used_again(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(POCKET), [0, 2], seed=1, loss=0.0)
    fleet.run(fleet.settled)
    fleet.silent = {"Robot2"}
    fleet.run(lambda: RobotState.SILENT in fleet.states())
    assert fleet.ask(GoalSet("Robot1", 5)).ok
    fleet.run(lambda: RobotState.UNREACHABLE in fleet.states())
    fleet.silent.clear()
    fleet.run(lambda: fleet.planner.snapshot().robots[0].cell == 5)


def test_short_path_is_lengthened_while_others_drive(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap(4, 6)), [0, 18], seed=2, loss=0.0)
    fleet.run(fleet.settled)
    assert fleet.ask(GoalSet("Robot1", 5)).ok
    fleet.step()
    fleet.planner.state.ledger.truncate("Robot1", keep=2)  # As an incomplete plan leaves it.
    goals = [23, 18]
    for number in range(400):
        if fleet.planner.snapshot().robots[1].state is RobotState.ARRIVED or not number:
            assert fleet.ask(GoalSet("Robot2", goals[0])).ok
            goals.reverse()
        fleet.step()
    assert fleet.planner.state.ledger.route("Robot1") == [5]


def test_goal_in_its_own_cell_ends_the_path_before(make_fleet: type[SimulatedClients]) -> None:
    """Robot1 waits for Robot2, and is sent to the cell that it stands in."""
    fleet = make_fleet(FleetPlanner(POCKET), [0, 1], seed=3, loss=0.0)
    fleet.run(fleet.settled)
    ledger = fleet.planner.state.ledger
    ledger.insert("Robot1", [(1, ledger.clock + 9.0)])
    assert fleet.ask(GoalSet("Robot1", 0)).ok
    fleet.step()
    assert ledger.route("Robot1") == [0]


def test_plan_does_not_wait_long_for_stopping_robots() -> None:
    """Robots are told to stop one after another, so that there is always one that is stopping."""
    state, chosen = FleetState(GridMap(2, 2)), FleetSettings(hold_timeout=3.0)
    paths = PathSupply(state, chosen)
    paths.outdated = True
    asked_at = None
    for now in range(60):
        state.index.stopping = {f"Robot{now}": float(now)}
        if asked_at is None and paths.supply(float(now), is_tick=True) is not None:
            asked_at = now
    assert asked_at is not None
    assert chosen.hold_timeout < asked_at <= 3 * chosen.hold_timeout


def test_most_urgent_robot_moves_in_the_first_step() -> None:
    """Two robots want through one gap: the one that is more urgent is first, whichever it is."""
    grid = GridMap(3, 5, blocked=frozenset({2, 12}))
    graph = PlanningGraph.from_grid(grid)
    for urgent in (0, 1):
        urgency = [int(robot == urgent) * 50 for robot in range(2)]
        problem = PlanningProblem.of(graph, [1, 11], [9, 4], urgency=urgency)
        plan = LacamPlanner(compiled=False).plan(problem)
        entered = [int(np.argmax(plan.cells[:, robot] == 7)) for robot in range(2)]
        assert entered[urgent] < entered[1 - urgent]


@pytest.mark.slow
@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(2, 7))
def test_every_robot_with_a_goal_advances_in_time(
    make_fleet: type[SimulatedClients], seed: int, count: int
) -> None:
    """Goals stream in, plans and messages are late, and the planner is restarted."""
    rng = Random(seed)
    grid = GridMap(5, 8, blocked=frozenset({9, 10, 11, 13, 14, 25, 26, 27, 29, 30}))
    fleet = make_fleet(FleetPlanner(grid), rng.sample(grid.free, count), seed, plan_delays=(0.0, 0.5, 2.0))
    restart = fleet.now + rng.uniform(10.0, 40.0)
    since: dict[str, tuple[tuple[int | None, int | None], float]] = {}
    for _ in range(900):
        if restart <= fleet.now:
            restart = float("inf")
            fleet.restart_planner(FleetPlanner(grid))
        fleet.step()
        for robot in fleet.planner.snapshot().robots:
            place = robot.cell, robot.goal
            if place != since.get(robot.id, (None,))[0] or robot.goal in (None, robot.cell):
                since[robot.id] = place, fleet.now
            stood = fleet.now - since[robot.id][1]
            assert stood < STANDS_AT_MOST, f"{robot} has not advanced for {stood:.0f} s"
            if robot.goal in (None, robot.cell):
                fleet.ask(GoalSet(robot.id, rng.choice(grid.free)))


def test_robot_reaches_its_goal_before_one_that_passes_later(make_fleet: type[SimulatedClients]) -> None:
    """It makes room after a while, and comes back."""
    fleet = make_fleet(FleetPlanner(GridMap(2, 6), FleetSettings(ahead=1)), [0, 5], seed=3, loss=0.0)
    fleet.run(fleet.settled)
    ledger = fleet.planner.state.ledger
    later = ledger.clock + 50.0
    ledger.insert("Robot2", [(4, later), (3, later + 1.0), (2, later + 2.0), (1, later + 3.0)])
    assert fleet.ask(GoalSet("Robot1", 2)).ok
    fleet.step()
    assert ledger.route("Robot1") == [0, 1, 2]
    places = set()
    for _ in range(600):
        fleet.step()
        places.add((ledger.route("Robot1")[0], ledger.route("Robot2")[0]))
    assert (2, 3) in places, "the other one waited"
    assert ledger.route("Robot1") == [2]
    assert ledger.route("Robot2") == [1]


def test_plans_of_a_stream_keep_the_first_visit_of_a_goal() -> None:
    cells = np.array([[1, 5], [2, 6], [1, 5], [2, 5]], np.int32)
    goals = np.array([2, 5], np.int32)
    ends = ends_of(cells, goals, lifelong=True)
    assert ends.tolist() == [1, 3], "the second robot starts in its goal"
    straighten(cells, 7, ends)
    assert cells.tolist() == [[1, 5], [2, 5], [1, 5], [2, 5]]
    straighten(cells, 7, ends_of(cells, goals, lifelong=False))
    assert cells[:, 0].tolist() == [1, 1, 1, 2]
