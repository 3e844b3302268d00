"""The planner ``dijkstra``: each robot's own shortest path, cells to the robot that asks first."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rce_fleet.coordination.events import CellBlocked, Tick
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.coordination.waiting import resting_cell
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

ALONE = FleetSettings(planner="dijkstra")
RESOLVED = FleetSettings(planner="dijkstra", resolve_deadlocks=True)
LANE = GridMap(2, 6, blocked=frozenset({6, 7, 9, 10, 11}))
"""One lane with a bay beside cell 2."""


def test_paths_are_shortest_and_avoid_blocked_cells(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap(), ALONE), [0, 24], 1, loss=0.0)
    fleet.send([7, 31])
    assert [len(robot.plan) for robot in fleet.planner.snapshot().robots] == [8, 8]
    assert fleet.ask(CellBlocked(6)).ok
    fleet.tell(Tick())
    assert [len(robot.plan) for robot in fleet.planner.snapshot().robots] == [10, 8]
    fleet.run(fleet.all_arrived)


def test_many_robots_get_their_paths_with_one_tick(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap(), ALONE), list(range(8)), 1, loss=0.0)
    fleet.send(list(range(56, 64)))
    assert [len(robot.plan) for robot in fleet.planner.snapshot().robots] == [8] * 8


def test_a_large_map_leaves_robots_to_the_next_ticks(
    make_fleet: type[SimulatedClients], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The searches of a tick take no longer than a part of it."""
    monkeypatch.setattr("rce_fleet.coordination.path_supply._ALONE_CELLS", 2 * 64)
    fleet = make_fleet(FleetPlanner(GridMap(), ALONE), list(range(4)), 1, loss=0.0)
    fleet.send(list(range(56, 60)))
    assert [len(robot.plan) for robot in fleet.planner.snapshot().robots] == [8, 8, 1, 1]
    fleet.tell(Tick())
    assert [len(robot.plan) for robot in fleet.planner.snapshot().robots] == [8] * 4


def test_robots_that_meet_head_on_are_reported(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(LANE, ALONE), [0, 5], 1, loss=0.0)
    fleet.send([5, 0])
    text = "deadlock: Robot1, Robot2 wait for each other"
    fleet.run(lambda: [robot.reason for robot in fleet.planner.snapshot().robots] == [text] * 2)
    assert fleet.states() == [RobotState.WAITING] * 2
    before = fleet.planner.snapshot()
    for _ in range(100):
        fleet.step()
    assert [robot.cell for robot in fleet.planner.snapshot().robots] == [
        robot.cell for robot in before.robots
    ]


def test_a_robot_that_rests_on_a_path_is_reported(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(LANE, ALONE), [0, 3], 1, loss=0.0)
    fleet.send([5])
    text = "deadlock: Robot2 rests on its path, in cell 3"
    fleet.run(lambda: fleet.planner.snapshot().robots[0].reason == text)
    assert resting_cell(text) == 3
    assert resting_cell("deadlock: Robot1, Robot2 wait for each other") is None


@pytest.mark.slow
@pytest.mark.parametrize(("starts", "goals"), [([0, 5], [5, 0]), ([0, 3], [5])])
def test_deadlocks_are_resolved_if_asked(
    make_fleet: type[SimulatedClients], starts: list[int], goals: list[int]
) -> None:
    fleet = make_fleet(FleetPlanner(LANE, RESOLVED), starts, 1, loss=0.0)
    fleet.send(goals)
    fleet.run(lambda: fleet.states().count(RobotState.ARRIVED) == len(goals))
    fleet.run(lambda: not fleet.planner.state.ledger.ordered)
    assert all(not robot.reason for robot in fleet.planner.snapshot().robots)


@pytest.mark.slow
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), count=st.integers(1, 8))
def test_all_arrive_whatever_meets(make_fleet: type[SimulatedClients], seed: int, count: int) -> None:
    """The fleet checks after each step that no robots touch and that each is in its own cells."""
    rng = Random(seed)
    while True:
        grid = GridMap().with_blocked(rng.sample(range(64), 6))
        if grid.connected():
            break
    fleet = make_fleet(FleetPlanner(grid, RESOLVED), rng.sample(grid.free, count), seed, loss=0.1)
    fleet.send(rng.sample(grid.free, count))
    fleet.run(fleet.all_arrived)
