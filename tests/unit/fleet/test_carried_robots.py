"""Robots that people carry or push into the way of others, while they are stopped, silent or lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import GoalSet, ModeSet, PoseSeen
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.snapshot import RobotSnapshot, RobotState
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

FLOOR = GridMap(3, 12)
"""Robot1 drives in row 0, Robot2 in row 2; who cannot pass in one row can pass in another."""
LONG = 200
"""Steps of 0.1 s in which robots would have met."""


def robot(fleet: SimulatedClients, number: int) -> RobotSnapshot:
    return fleet.planner.snapshot().robots[number - 1]


def carry_to(fleet: SimulatedClients, number: int, cell: int, right: float = 0.0, up: float = 0.0) -> None:
    """Put a robot at a place relative to the centre of a cell, metres."""
    x, y = fleet.grid.centre(cell)
    fleet.carry(f"Robot{number}", x + right, y + up)


def start(make_fleet: type[SimulatedClients], seed: int) -> SimulatedClients:
    """Return a fleet whose first robot drives along row 0; the second stands at the end of row 2."""
    fleet = make_fleet(FleetPlanner(FLOOR), [0, 35], seed, loss=0.0)
    fleet.send([11])
    fleet.run(lambda: robot(fleet, 1).granted == (1, 2, 3, 4, 5))
    return fleet


def is_driving(fleet: SimulatedClients, number: int) -> bool:
    return fleet.robots[f"Robot{number}"].current is not None


def run_on(fleet: SimulatedClients) -> None:
    """Let time pass; each step checks that robots do not touch."""
    for _ in range(LONG):
        fleet.step()


def arrive(fleet: SimulatedClients) -> None:
    """Send the second robot to a goal, and wait until both have arrived."""
    assert fleet.ask(GoalSet("Robot2", 24)).ok
    fleet.run(fleet.all_arrived)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("up", [0.0, 0.4])
def test_a_lost_robot_found_in_the_way_stops_others(
    make_fleet: type[SimulatedClients], seed: int, up: float
) -> None:
    """It is localized anew in a cell that is granted to another robot, which stops and drives around it."""
    fleet = start(make_fleet, seed)
    body = fleet.robots["Robot2"]
    fleet.tell(PoseSeen("Robot2", body.x, body.y, 0.0, 2.3, 0.1))
    assert robot(fleet, 2).state is RobotState.LOST
    carry_to(fleet, 2, 4, up=up)
    fleet.tell(PoseSeen("Robot2", body.x, body.y, 0.0, 0.1, 0.1))
    run_on(fleet)
    arrive(fleet)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("cell", "up"), [(4, 0.0), (4, 0.4), (6, 0.0), (5, 0.3)])
def test_a_silent_robot_pushed_into_the_way_stops_others(
    make_fleet: type[SimulatedClients], seed: int, cell: int, up: float
) -> None:
    """Its move client is silent, but its poses show where it was pushed; it keeps its former cells too."""
    fleet = make_fleet(FleetPlanner(FLOOR), [0, 35], seed, loss=0.0)
    fleet.send([])
    fleet.mute = {"Robot2"}
    fleet.run(lambda: robot(fleet, 2).state is RobotState.SILENT)
    assert fleet.ask(GoalSet("Robot1", 11)).ok
    fleet.run(lambda: robot(fleet, 1).granted == (1, 2, 3, 4, 5))
    carry_to(fleet, 2, cell, up=up)
    fleet.run(lambda: robot(fleet, 1).state is RobotState.ARRIVED)
    assert {cell, 35} <= fleet.planner.state.ledger.claims("Robot2")
    run_on(fleet)
    fleet.mute.clear()
    arrive(fleet)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("cell", "place"), [(6, (0.0, 0.0)), (6, (0.3, 0.0)), (6, (-0.2, 0.4)), (7, (-0.45, 0.0))]
)
def test_a_robot_carried_beyond_the_grants_keeps_others_out(
    make_fleet: type[SimulatedClients], seed: int, cell: int, place: tuple[float, float]
) -> None:
    """The cell after the last that another robot was granted is not granted to it any more."""
    fleet = start(make_fleet, seed)
    carry_to(fleet, 2, cell, *place)
    fleet.run(lambda: fleet.robots["Robot1"].x > 5.0 or robot(fleet, 1).state is RobotState.ARRIVED)
    run_on(fleet)
    arrive(fleet)


@pytest.mark.parametrize("seed", range(2))
def test_two_robots_carried_to_one_border_take_part_again(
    make_fleet: type[SimulatedClients], seed: int
) -> None:
    """Each overlaps the other's cell: the first gets its cells, and the second when the first has left."""
    fleet = start(make_fleet, seed)
    carry_to(fleet, 1, 18, right=0.3)
    carry_to(fleet, 2, 19, right=-0.2)
    run_on(fleet)
    arrive(fleet)


def test_a_robot_in_a_cell_of_another_can_be_removed(make_fleet: type[SimulatedClients]) -> None:
    """Its own cells become free, one of which it overlaps."""
    fleet = start(make_fleet, 0)
    carry_to(fleet, 2, 5, right=0.4)
    fleet.run(lambda: bool(fleet.planner.state.index.displaced.cells))
    fleet.remove("Robot2")
    fleet.run(fleet.all_arrived)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_paused_robot_pushed_twice_is_placed_anew(make_fleet: type[SimulatedClients], seed: int) -> None:
    """First to the corner of its cell, and then into the one that it overlapped there."""
    fleet = start(make_fleet, seed)
    assert fleet.ask(ModeSet("Robot2", RobotMode.PAUSED)).ok
    carry_to(fleet, 2, 35, right=-0.4, up=-0.4)
    run_on(fleet)
    carry_to(fleet, 2, 22)
    run_on(fleet)
    assert (robot(fleet, 2).state, robot(fleet, 2).cell) == (RobotState.PAUSED, 22)
    assert fleet.ask(ModeSet("Robot2", RobotMode.AUTOMATIC)).ok
    arrive(fleet)


@pytest.mark.parametrize("seed", range(2))
def test_a_silent_robot_pushed_off_its_path_is_stopped(make_fleet: type[SimulatedClients], seed: int) -> None:
    """Its move client still hears the planner; it would drive the robot back through cells of others."""
    fleet = make_fleet(FleetPlanner(FLOOR), [0, 35], seed, loss=0.0)
    fleet.send([1, 24])
    fleet.run(lambda: len(robot(fleet, 2).granted) == 5)
    fleet.mute = {"Robot2"}
    fleet.run(lambda: robot(fleet, 2).state is RobotState.SILENT)
    assert is_driving(fleet, 2)
    fleet.carried.add("Robot2")
    body = fleet.robots["Robot2"]
    body.x, body.y = fleet.grid.centre(6)
    fleet.run(lambda: not is_driving(fleet, 2), limit=3.0)
    assert robot(fleet, 2).state is RobotState.SILENT
    run_on(fleet)
    assert not is_driving(fleet, 2)
    fleet.mute.clear()
    fleet.run(fleet.all_arrived)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_silent_robot_is_stopped_before_a_robot_in_its_way(
    make_fleet: type[SimulatedClients], seed: int
) -> None:
    """The planner hears nothing of it, but its move client may hear the planner."""
    fleet = start(make_fleet, seed)
    fleet.mute = {"Robot1"}
    fleet.run(lambda: robot(fleet, 1).state is RobotState.SILENT)
    last = robot(fleet, 1).granted[-1]
    assert is_driving(fleet, 1)
    carry_to(fleet, 2, last, right=0.4)
    run_on(fleet)
    fleet.mute.clear()
    arrive(fleet)
