"""Robots that the planner does not drive: paused, stopped, driven by hand, out of service, dead."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import GoalSet, ModeSet, SendCancel, Tick
from rce_fleet.coordination.modes import RobotMode, effective_mode, read_mode
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.snapshot import RobotSnapshot, RobotState
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from collections.abc import Callable

    from unit.fleet.conftest import SimulatedClients

    Make = Callable[[GridMap, list[int], list[int]], SimulatedClients]

CORRIDOR = GridMap(3, 9, blocked=frozenset({10, 11, 12, 14, 15, 16}))
"""Two ways from column 0 to column 8: rows 0 and 2, with a passage between them in the middle."""


@pytest.fixture
def make(make_fleet: type[SimulatedClients]) -> Make:
    def of(grid: GridMap, starts: list[int], goals: list[int]) -> SimulatedClients:
        fleet = make_fleet(FleetPlanner(grid), starts, 1, loss=0.0)
        fleet.send(goals)
        return fleet

    return of


def robot(fleet: SimulatedClients, number: int = 1) -> RobotSnapshot:
    return fleet.planner.snapshot().robots[number - 1]


def set_mode(
    fleet: SimulatedClients, name: str | None, mode: RobotMode, reason: str = "", by: str = ""
) -> str:
    reply = fleet.ask(ModeSet(name, mode, reason, by))
    assert reply.ok, reply.message
    return reply.message


def test_a_paused_robot_stops_and_drives_on_when_resumed(make: Make) -> None:
    fleet = make(GridMap(), [0], [63])
    fleet.run(lambda: robot(fleet).cell != 0)
    set_mode(fleet, "Robot1", RobotMode.PAUSED, "spill in aisle 3", "anna")
    fleet.run(lambda: robot(fleet).state is RobotState.PAUSED)
    assert robot(fleet).reason == "paused (spill in aisle 3, by anna)"
    here = robot(fleet).plan
    for _ in range(50):
        fleet.step()
    assert robot(fleet).plan == here == (robot(fleet).cell,)
    set_mode(fleet, "Robot1", RobotMode.AUTOMATIC)
    fleet.tell(Tick())
    assert len(robot(fleet).plan) > 1, "it has a path within one tick"
    fleet.run(fleet.all_arrived)


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode", [RobotMode.PAUSED, RobotMode.OUT_OF_SERVICE, RobotMode.DEAD, RobotMode.MANUAL]
)
def test_others_plan_around_a_robot_that_is_not_driven(make: Make, mode: RobotMode) -> None:
    fleet = make(CORRIDOR, [4, 0], [])
    set_mode(fleet, "Robot1", mode)
    assert fleet.ask(GoalSet("Robot2", 8)).ok
    fleet.run(lambda: robot(fleet, 2).state is RobotState.ARRIVED)
    assert robot(fleet).cell in (4, None)
    assert robot(fleet).mode == mode.value


@pytest.mark.parametrize("mode", [RobotMode.PAUSED, RobotMode.DEAD])
def test_others_have_another_path_within_one_tick(make: Make, mode: RobotMode) -> None:
    """Robot 2 follows robot 1 through row 0, when robot 1 falls out."""
    fleet = make(CORRIDOR, [3, 0], [7, 8])
    assert 4 in robot(fleet, 2).plan
    fleet.run(lambda: robot(fleet).cell == 5 and robot(fleet, 2).state is RobotState.DRIVING)
    set_mode(fleet, "Robot1", mode)
    fleet.tell(Tick())
    claimed = fleet.planner.state.ledger.claims("Robot1")
    assert claimed
    assert claimed.isdisjoint(robot(fleet, 2).plan)
    fleet.run(lambda: robot(fleet, 2).state is RobotState.ARRIVED)


def test_a_robot_driven_by_hand_stops_those_in_its_way(make: Make) -> None:
    """Its cells follow its pose; it joins again where it stands."""
    fleet = make(GridMap(), [24, 60], [31])
    set_mode(fleet, "Robot2", RobotMode.MANUAL)
    fleet.run(lambda: robot(fleet).cell == 25)
    hand, driven = fleet.robots["Robot2"], robot(fleet).granted[-1]
    hand.x, hand.y = fleet.grid.centre(driven)
    fleet.run(lambda: robot(fleet).state is RobotState.STOPPING)
    fleet.run(lambda: driven in fleet.planner.state.ledger.claims("Robot2"))
    fleet.run(lambda: robot(fleet).state is RobotState.ARRIVED)
    set_mode(fleet, "Robot2", RobotMode.AUTOMATIC)
    fleet.run(lambda: robot(fleet, 2).state is RobotState.IDLE)
    assert robot(fleet, 2).cell == driven


def test_a_dead_robot_frees_the_cells_it_will_not_reach(make: Make) -> None:
    fleet = make(GridMap(), [24], [31])
    fleet.run(lambda: len(robot(fleet).granted) > 3)
    fleet.silent.add("Robot1")
    fleet.run(lambda: robot(fleet).state is RobotState.SILENT)
    before = fleet.planner.state.ledger.claims("Robot1")
    set_mode(fleet, "Robot1", RobotMode.DEAD)
    after = fleet.planner.state.ledger.claims("Robot1")
    assert after < before
    assert robot(fleet).state is RobotState.DEAD
    assert not fleet.ask(GoalSet("Robot1", 3)).ok


def test_an_emergency_stop_cancels_every_robot(make: Make) -> None:
    fleet = make(GridMap(), [0, 56], [7, 63])
    set_mode(fleet, "Robot2", RobotMode.PAUSED)
    out = fleet.tell(ModeSet(None, RobotMode.STOPPED, "smoke"))
    assert SendCancel("Robot1") in out
    fleet.run(lambda: fleet.states() == [RobotState.STOPPED] * 2)
    assert robot(fleet).reason == "stopped by an emergency stop (smoke)"
    set_mode(fleet, None, RobotMode.AUTOMATIC)
    fleet.run(lambda: robot(fleet).state is RobotState.ARRIVED)
    assert robot(fleet, 2).state is RobotState.PAUSED, "it was paused before, by itself"


def test_robots_join_a_paused_fleet_without_driving(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap()), [0], 1, loss=0.0)
    set_mode(fleet, None, RobotMode.PAUSED)
    fleet.run(lambda: fleet.states() == [RobotState.PAUSED])
    assert fleet.ask(GoalSet("Robot1", 5)).ok
    for _ in range(20):
        fleet.step()
    assert robot(fleet).plan == (0,)
    set_mode(fleet, None, RobotMode.AUTOMATIC)
    fleet.run(fleet.all_arrived)


@pytest.mark.parametrize(
    ("name", "mode", "message"),
    [
        ("Robot9", RobotMode.PAUSED, "robot Robot9 is unknown"),
        (None, RobotMode.MANUAL, "the fleet cannot be manual; its modes are automatic, paused, stopped"),
    ],
)
def test_a_wrong_mode_is_refused(make: Make, name: str | None, mode: RobotMode, message: str) -> None:
    assert make(GridMap(), [0], []).ask(ModeSet(name, mode)).message == message


def test_modes_of_fleet_and_robot_combine() -> None:
    assert effective_mode(RobotMode.PAUSED, RobotMode.AUTOMATIC) is RobotMode.PAUSED
    assert effective_mode(RobotMode.PAUSED, RobotMode.DEAD) is RobotMode.DEAD
    assert effective_mode(RobotMode.STOPPED, RobotMode.PAUSED) is RobotMode.STOPPED
    with pytest.raises(ValueError, match="there is no mode 'asleep'; modes are automatic"):
        read_mode("asleep")
