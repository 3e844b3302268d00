"""Robots that lie about where they are, and move clients that answer nothing."""

from __future__ import annotations

from math import inf, nan
from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import (
    CellBlocked,
    Event,
    GoalSet,
    ModeSet,
    PoseSeen,
    RobotHeard,
    RobotsExpected,
    SendCancel,
)
from rce_fleet.coordination.grid_change import refuse_grid
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.placement import UNSEEN
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.snapshot import RobotSnapshot, RobotState
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients


def robot(fleet: SimulatedClients, number: int = 1) -> RobotSnapshot:
    return fleet.planner.snapshot().robots[number - 1]


def test_a_pose_that_cannot_be_true_stops_the_robot(make_fleet: type[SimulatedClients]) -> None:
    """It keeps the cells where it may be, and others in the way of where it says it is are stopped."""
    fleet = make_fleet(FleetPlanner(GridMap()), [0, 24], 1, loss=0.0)
    fleet.send([7, 31])
    fleet.run(lambda: len(robot(fleet).granted) > 3)
    before = fleet.planner.state.ledger.claims("Robot1")
    x, y = fleet.grid.centre(robot(fleet, 2).granted[-1])
    out = fleet.tell(PoseSeen("Robot1", x, y, 0.0))
    assert {SendCancel("Robot1"), SendCancel("Robot2")} <= set(out)
    assert "its pose jumped" in robot(fleet).reason
    assert before <= fleet.planner.state.ledger.claims("Robot1")
    fleet.run(fleet.all_arrived)


def test_a_stopping_robot_whose_pose_jumps_keeps_its_cells(make_fleet: type[SimulatedClients]) -> None:
    """It is partly in a cell beside its path, which another robot was granted otherwise."""
    fleet = make_fleet(FleetPlanner(GridMap()), [0], 1, loss=0.0)
    fleet.send([7])
    body = fleet.robots["Robot1"]
    for goal in (None, 56):
        fleet.run(lambda: len(fleet.grid.cells_touched(body.x, body.y, 0.25)) == 2)
        assert fleet.ask(GoalSet("Robot1", goal)).ok
    fleet.run(lambda: len(fleet.planner.state.ledger.overlapped("Robot1")) == 1)
    assert fleet.ask(GoalSet("Robot1", None)).ok
    assert robot(fleet).state in (RobotState.STOPPING, RobotState.DRIVING)
    before = fleet.planner.state.ledger.claims("Robot1")
    fleet.tell(PoseSeen("Robot1", *fleet.grid.centre(63), 0.0))
    assert before <= fleet.planner.state.ledger.claims("Robot1")


def test_a_joining_robot_whose_pose_jumps_may_be_at_both_places() -> None:
    grid, steady = GridMap(), FleetSettings().jump_settle_time
    planner = FleetPlanner(grid)
    claims = planner.state.ledger.claims
    planner.handle(PoseSeen("Robot1", *grid.centre(0), 0.0), 0.0)
    planner.handle(PoseSeen("Robot1", *grid.centre(63), 0.0), 0.1)
    assert claims("Robot1") == {0, 63}
    planner.handle(PoseSeen("Robot1", *grid.centre(63), 0.0), steady)
    assert claims("Robot1") == {0, 63}
    planner.handle(PoseSeen("Robot1", *grid.centre(63), 0.0), 0.2 + steady)
    assert claims("Robot1") == {63}


def test_a_robot_that_jumps_to_and_fro_is_not_driven(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap()), [0], 1, loss=0.0)
    fleet.send([])
    assert fleet.ask(GoalSet("Robot1", 7)).ok
    true, false = fleet.grid.centre(0), fleet.grid.centre(63)
    for number in range(200):
        fleet.now += 0.2
        fleet.tell(PoseSeen("Robot1", *(false, true)[number % 2], 0.0))
        assert 0 in fleet.planner.state.ledger.claims("Robot1")
        assert robot(fleet).state in (RobotState.STOPPING, RobotState.SILENT)


@pytest.mark.slow
@pytest.mark.parametrize("far", [nan, inf, -inf, 1.7e308, -1e308, 1.001e9])
@pytest.mark.parametrize("is_mute", [False, True])
def test_a_place_that_no_robot_can_be_at_is_ignored(
    make_fleet: type[SimulatedClients], far: float, is_mute: bool
) -> None:
    """The sums of such a place with a cell's size are not finite: the planner ended, or lost other robots."""
    fleet = make_fleet(FleetPlanner(GridMap(cell_size=0.8, yaw=0.5)), [0, 24], 1, loss=0.0)
    fleet.mute = {"Robot1"} if is_mute else set()
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2)
    for number, goal in enumerate((7, 31), start=1):
        assert fleet.ask(GoalSet(f"Robot{number}", goal)).ok
    for step in range(100):
        fleet.tell(PoseSeen("Robot1", *((far, 0.5), (0.5, far))[step % 2], 0.0))
        fleet.step()
    fleet.run(fleet.all_arrived)


def test_an_age_that_is_no_number_tells_nothing(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap()), [0], 1, loss=0.0, pose_step=0.2)

    def settled_meanwhile() -> bool:
        fleet.tell(RobotHeard("Robot1", nan))
        fleet.tell(RobotHeard("Robot1", inf))
        return fleet.settled()

    fleet.run(settled_meanwhile, limit=20.0)


def test_a_move_client_that_answers_nothing_is_driven_by_poses(make_fleet: type[SimulatedClients]) -> None:
    """It takes lists and cancellations; its robot keeps a cell more behind it than others."""
    fleet = make_fleet(FleetPlanner(GridMap()), [0, 56], 1, loss=0.0, pose_step=0.2)
    fleet.mute = {"Robot1"}
    fleet.run(lambda: len(fleet.states()) == 2 and robot(fleet).state is RobotState.SILENT)
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2)
    assert (robot(fleet).pose_only, robot(fleet, 2).pose_only) == (True, False)
    for name, goal in (("Robot1", 63), ("Robot2", 7)):
        assert fleet.ask(GoalSet(name, goal)).ok
    behind = set()

    def arrived() -> bool:
        here = fleet.grid.cell_at(fleet.robots["Robot1"].x, fleet.robots["Robot1"].y)
        route = fleet.planner.state.ledger.route("Robot1")
        if here in route:
            behind.add(route.index(here))
        return fleet.all_arrived()

    fleet.run(arrived)
    assert max(behind) >= 2
    fleet.mute.clear()
    fleet.run(lambda: not robot(fleet).pose_only)
    fleet.run(fleet.all_arrived)


CORRIDOR = GridMap(3, 12, blocked=frozenset({*range(12), *range(24, 36)}) - {5, 29})
"""The middle row is free, and one cell on each side of it."""


def corridor(make_fleet: type[SimulatedClients], pose_step: float = 0.0) -> SimulatedClients:
    """A robot that is driven by its poses, and was granted five cells of a corridor; another at its end."""
    fleet = make_fleet(FleetPlanner(CORRIDOR), [12, 23], 1, loss=0.0, pose_step=pose_step)
    fleet.mute = {"Robot1"}
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2)
    assert fleet.ask(GoalSet("Robot1", 22)).ok
    fleet.run(lambda: robot(fleet).granted == (12, 13, 14, 15, 16))
    return fleet


@pytest.mark.parametrize(
    "ends",
    [
        GoalSet("Robot1", None),
        CellBlocked(15),
        ModeSet("Robot1", RobotMode.PAUSED),
        ModeSet("Robot1", RobotMode.MANUAL),
        ModeSet("Robot1", RobotMode.OUT_OF_SERVICE),
        ModeSet(None, RobotMode.STOPPED),
    ],
)
def test_a_robot_whose_poses_end_keeps_the_cells_ahead(
    make_fleet: type[SimulatedClients], ends: Event
) -> None:
    """It may not have heard that it is to stop, and drives to the last of them; another robot waits."""
    fleet = corridor(make_fleet)
    fleet.unposed = fleet.deaf = {"Robot1"}
    fleet.tell(ends)
    assert fleet.ask(GoalSet("Robot2", 29)).ok
    for _ in range(300):
        fleet.step()
        assert {13, 14, 15, 16} <= fleet.planner.state.ledger.claims("Robot1")
    assert fleet.grid.cell_at(fleet.robots["Robot1"].x, fleet.robots["Robot1"].y) == 16
    assert refuse_grid(fleet.planner, GridMap())
    fleet.unposed, fleet.deaf = set(), set()
    assert fleet.ask(ModeSet(None, RobotMode.AUTOMATIC)).ok
    assert fleet.ask(ModeSet("Robot1", RobotMode.AUTOMATIC)).ok
    fleet.run(lambda: robot(fleet).cell in (16, 22))


def test_a_robot_is_placed_once_a_pose_shows_that_it_stands(make_fleet: type[SimulatedClients]) -> None:
    """Its localization sends none at rest: until it is localized, twice, it keeps the cells ahead."""
    fleet = corridor(make_fleet, pose_step=0.2)
    assert fleet.ask(ModeSet("Robot1", RobotMode.PAUSED)).ok
    for _ in range(300):
        fleet.step()
    assert (robot(fleet).state, robot(fleet).reason) == (RobotState.STOPPING, UNSEEN)
    assert {13, 14, 15, 16} <= fleet.planner.state.ledger.claims("Robot1")
    for _ in range(2):
        fleet.posed.clear()
        for _ in range(50):
            fleet.step()
    assert robot(fleet).state is RobotState.PAUSED
    assert fleet.planner.state.ledger.claims("Robot1") <= {12, 13}
    assert fleet.ask(ModeSet("Robot1", RobotMode.AUTOMATIC)).ok
    fleet.run(lambda: robot(fleet).cell == 22)


def test_a_robot_that_is_driven_by_hand_needs_one_pose(make_fleet: type[SimulatedClients]) -> None:
    fleet = corridor(make_fleet)
    fleet.unposed = {"Robot1"}
    assert fleet.ask(ModeSet("Robot1", RobotMode.MANUAL)).ok
    for _ in range(60):
        fleet.step()
    assert {13, 14, 15, 16} <= fleet.planner.state.ledger.claims("Robot1")
    fleet.unposed = set()
    fleet.run(lambda: fleet.planner.state.ledger.claims("Robot1").isdisjoint({14, 15, 16}))


def test_a_robot_by_poses_that_stands_for_a_while_is_sent_again(make_fleet: type[SimulatedClients]) -> None:
    """A person stood in its way. It is not stopped: no pose would show that it has."""
    fleet = corridor(make_fleet, pose_step=0.2)
    body = fleet.robots["Robot1"]
    speed, body.speed = body.speed, 0.0
    for _ in range(200):
        fleet.step()
        assert robot(fleet).state is RobotState.DRIVING
    body.speed = speed
    fleet.run(lambda: robot(fleet).cell == 22)


def test_a_robot_by_poses_that_stands_for_long_is_passed(make_fleet: type[SimulatedClients]) -> None:
    """Its poses ended, or it is stuck: its reason says so, and others plan around its cells."""
    fleet = corridor(make_fleet)
    fleet.unposed = {"Robot1"}
    fleet.run(lambda: robot(fleet).reason == UNSEEN, limit=60.0)
    assert {13, 14, 15, 16} <= fleet.planner.state.ledger.claims("Robot1")
    assert fleet.ask(GoalSet("Robot2", 14)).ok
    fleet.run(lambda: robot(fleet, 2).state is RobotState.UNREACHABLE, limit=20.0)


def test_a_restarted_planner_keeps_the_cells_it_was_told(make_fleet: type[SimulatedClients]) -> None:
    """Of a robot that it drives by its poses, of which it hears one from the middle of the drive."""
    fleet = corridor(make_fleet)
    fleet.unposed = {"Robot1"}
    fleet.restart_planner(FleetPlanner(CORRIDOR))
    fleet.tell(RobotsExpected({"Robot1": (12, 13, 14, 15, 16), "Robot2": (23,)}))
    fleet.tell(PoseSeen("Robot1", *fleet.grid.centre(12), 0.0))
    for _ in range(300):
        fleet.step()
        assert {13, 14, 15, 16} <= fleet.planner.state.ledger.claims("Robot1")
    assert robot(fleet).pose_only


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_by_poses_arrives_though_its_last_pose_is_short(
    make_fleet: type[SimulatedClients], seed: int
) -> None:
    """Localization sends none for the last centimetres; the cells behind it are free in the end."""
    fleet = make_fleet(FleetPlanner(CORRIDOR), [12], seed, loss=0.0, pose_step=0.3)
    fleet.mute = {"Robot1"}
    fleet.send([18])
    fleet.run(lambda: fleet.planner.state.ledger.claims("Robot1") == {18}, limit=120.0)
