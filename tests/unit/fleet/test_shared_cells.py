"""Robots that start in one cell, or were put into the cell of another: they separate, or say why not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import (
    GoalSet,
    ModeSet,
    PoseSeen,
    ReportSeen,
    RobotRemoved,
    RobotsExpected,
    Tick,
)
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients


def reasons(fleet: SimulatedClients) -> str:
    return " ".join(robot.reason for robot in fleet.planner.snapshot().robots)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((1.5, 1.26), (1.5, 1.74)),
        ((1.26, 1.5), (1.74, 1.5)),
        ((1.3, 1.3), (1.65, 1.65)),
        ((1.5, 1.5), (1.98, 1.5)),
    ],
)
def test_two_robots_in_one_cell_separate(
    make_fleet: type[SimulatedClients], first: tuple[float, float], second: tuple[float, float]
) -> None:
    """The one that gets the cell would touch the other one on its way to the centre."""
    fleet = make_fleet(FleetPlanner(GridMap()), [], 1, loss=0.0)
    fleet.add_robot_at("Robot1", *first)
    fleet.add_robot_at("Robot2", *second)
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2, limit=60.0)
    cells = [robot.cell for robot in fleet.planner.snapshot().robots]
    assert len(set(cells)) == 2
    for number, goal in enumerate(reversed(cells), start=1):
        fleet.ask(GoalSet(f"Robot{number}", goal))
    fleet.run(fleet.all_arrived)


@pytest.mark.parametrize("carried_away", ["Robot1", "Robot2"])
def test_robots_with_no_way_out_of_their_cell_stand_and_say_so(
    make_fleet: type[SimulatedClients], carried_away: str
) -> None:
    """The floor is one cell: no robot can leave it. When one was carried away, the other drives."""
    fleet = make_fleet(FleetPlanner(GridMap(1, 1)), [], 1, loss=0.0)
    fleet.add_robot_at("Robot1", 0.5, 0.24)
    fleet.add_robot_at("Robot2", 0.5, 0.76)
    said = "to leave cell 0: drive one of them by hand", "cell 0 is held by Robot"
    fleet.run(lambda: all(text in reasons(fleet) for text in said))
    places = [(robot.x, robot.y) for robot in fleet.robots.values()]
    for _ in range(100):
        fleet.step()
    assert places == [(robot.x, robot.y) for robot in fleet.robots.values()]
    fleet.remove(carried_away)
    fleet.run(lambda: fleet.states() == [RobotState.IDLE])


def test_a_resumed_robot_does_not_drive_over_one_in_its_cell(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap()), [], 1, loss=0.0)
    fleet.add_robot_at("Robot1", 1.5, 1.24)
    fleet.run(lambda: len(fleet.states()) == 1)
    assert fleet.ask(ModeSet("Robot1", RobotMode.PAUSED)).ok
    fleet.run(lambda: fleet.states() == [RobotState("paused")])
    fleet.add_robot_at("Robot2", 1.5, 1.76)
    fleet.run(lambda: "cell 9 is held by Robot1" in reasons(fleet))
    assert fleet.ask(ModeSet("Robot1", RobotMode.AUTOMATIC)).ok
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2, limit=60.0)


def test_a_robot_in_a_cell_of_one_that_was_never_heard_waits() -> None:
    """An earlier planner granted the cell to Robot2, whose place is not known."""
    planner = FleetPlanner(GridMap())
    planner.handle(RobotsExpected({"Robot2": (9,)}), 0.0)
    for step in range(25):
        planner.handle(PoseSeen("Robot1", 1.5, 1.9, 0.0), step / 10)
        planner.handle(ReportSeen("Robot1", ClientReport(1, ClientState.IDLE)), step / 10)
        planner.handle(Tick(), step / 10)
    joining, _ = planner.snapshot().robots
    assert joining.reason == "cell 9 is held by Robot2"
    planner.handle(RobotRemoved("Robot2"), 2.5)
    planner.handle(PoseSeen("Robot1", 1.5, 1.9, 0.0), 2.6)
    assert planner.snapshot().robots[0].cell == 9
