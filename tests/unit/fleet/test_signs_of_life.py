"""Robots whose localization publishes no poses while they stand, as ROS's ``amcl`` does."""

from __future__ import annotations

from math import inf, nan
from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import GoalSet, PoseSeen, ReportSeen, RobotHeard, Tick
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.robot_signs import FRESH, NO_SIGN, RobotSign, RobotSigns
from rce_fleet.coordination.robot_watch import NO_POSE
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

AMCL_STEP = 0.2
"""``update_min_d`` of ROS's amcl, metres."""


class ClientOnly:
    """A planner with one robot at rest, of which only the move client's reports come."""

    def __init__(self) -> None:
        self.planner = FleetPlanner(GridMap())
        self.now = 100.0

    def report(self, age: float | None) -> None:
        if age is not None:
            self.planner.handle(RobotHeard("Robot1", age), self.now)
        revision = self.planner.state.robots["Robot1"].revision if self.planner.state.robots else 0
        report = ClientReport(revision, ClientState.IDLE)
        self.planner.handle(ReportSeen("Robot1", report), self.now)

    def run(self, seconds: float, *, age: float | None = 0.1, growing: bool = False) -> None:
        end = self.now + seconds
        while self.now < end:
            self.report(age)
            self.planner.handle(Tick(), self.now)
            self.planner.validate()
            self.now += 0.5
            if growing and age is not None:
                age += 0.5

    def state(self) -> RobotState:
        return self.planner.snapshot().robots[0].state

    @property
    def reason(self) -> str:
        return self.planner.snapshot().robots[0].reason


def test_a_standing_robot_without_poses_is_not_silent() -> None:
    client = ClientOnly()
    client.planner.handle(PoseSeen("Robot1", 2.5, 3.5, 0.0), client.now)
    client.run(3.0)
    assert client.state() is RobotState.IDLE
    client.run(60.0)
    assert client.state() is RobotState.IDLE
    assert client.planner.snapshot().robots[0].cell == 26


def test_a_robot_that_its_client_hears_no_more_is_silent() -> None:
    """The move client runs in the cloud and lives on; it says since when it heard nothing."""
    client = ClientOnly()
    client.planner.handle(PoseSeen("Robot1", 2.5, 3.5, 0.0), client.now)
    client.run(3.0)
    client.run(4.5, growing=True)
    assert client.state() is RobotState.SILENT
    assert "neither poses nor states" in client.reason
    client.run(5.0)
    assert client.state() is RobotState.IDLE


def test_a_client_without_signs_leaves_it_to_the_poses() -> None:
    client = ClientOnly()
    client.planner.handle(PoseSeen("Robot1", 2.5, 3.5, 0.0), client.now)
    client.run(5.0, age=None)
    assert client.state() is RobotState.SILENT


def test_a_robot_without_a_pose_says_what_it_waits_for() -> None:
    client = ClientOnly()
    client.run(10.0)
    assert (client.state(), client.reason) == (RobotState.JOINING, NO_POSE)
    client.planner.handle(PoseSeen("Robot1", 2.5, 3.5, 0.0), client.now)
    assert client.reason == "new"
    client.run(2.0)
    assert client.state() is RobotState.IDLE


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_robots_that_send_no_pose_at_rest_arrive(make_fleet: type[SimulatedClients], seed: int) -> None:
    """Poses come each 0.2 m only, so the last cell is reached by the feedback of navigation."""
    fleet = make_fleet(FleetPlanner(GridMap()), [0, 7, 56], seed, loss=0.0, pose_step=AMCL_STEP)
    fleet.send([63, 56, 7])
    fleet.run(fleet.all_arrived)
    for _ in range(100):
        fleet.step()
    assert fleet.all_arrived()
    assert fleet.ask(GoalSet("Robot1", 32)).ok
    fleet.run(fleet.all_arrived)


def test_signs_tell_age_and_the_end_of_a_drive() -> None:
    signs = RobotSigns()
    assert signs.sign(5.0, is_driving=False) == NO_SIGN
    signs.hear(5.0)
    assert signs.sign(7.5, is_driving=False) == RobotSign(2.5)
    signs.take_pose(1.0, 2.0, 0.5, 8.0)
    assert signs.sign(8.0, is_driving=True) == RobotSign(0.0)
    assert signs.sign(8.5, is_driving=False) == RobotSign(0.5, (1.0, 2.0, 0.5))
    assert signs.sign(8.0 + FRESH + 0.1, is_driving=False) == RobotSign(2.1)


@pytest.mark.parametrize("x", [nan, inf])
def test_a_pose_of_no_numbers_is_only_a_sign_of_life(x: float) -> None:
    signs = RobotSigns()
    signs.take_pose(x, 2.0, 0.5, 8.0)
    assert signs.sign(8.0, is_driving=False) == RobotSign(0.0)


def test_the_heartbeat_is_of_the_one_that_was_silent_longer() -> None:
    """A robot that stands is as old as what its move client heard of it, and as the report about it."""
    client = ClientOnly()
    client.planner.handle(PoseSeen("Robot1", 2.5, 3.5, 0.0), client.now)
    client.run(10.0, age=0.3)
    record = client.planner.state.robots["Robot1"]
    reported = client.now - 0.5
    assert record.heartbeat_age(reported) == pytest.approx(0.3)
    assert record.heartbeat_age(reported + 7.0) == pytest.approx(7.3)
    client.planner.handle(PoseSeen("Robot1", 2.5, 3.5, 0.0), reported + 7.0)
    assert record.heartbeat_age(reported + 7.0) == pytest.approx(7.0), "its move client is silent"
