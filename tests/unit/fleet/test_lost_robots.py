"""Robots whose localization does not know where they are, by the covariance of their poses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from rce_fleet.coordination.events import ModeSet, PoseSeen, SendCancel
from rce_fleet.coordination.localization import is_lost
from rce_fleet.coordination.modes import RobotMode, read_mode
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.robot import RobotRecord
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.snapshot import RobotSnapshot, RobotState
from rce_fleet.nodes.robot_messages import read_pose_seen
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

CORRIDOR = GridMap(3, 9, blocked=frozenset({10, 11, 12, 14, 15, 16}))
"""Two ways from column 0 to column 8: rows 0 and 2."""


def robot(fleet: SimulatedClients, number: int = 1) -> RobotSnapshot:
    return fleet.planner.snapshot().robots[number - 1]


def pose(fleet: SimulatedClients, spread: float | None, yaw_spread: float | None = 0.1) -> PoseSeen:
    """Return the pose where the first robot is, with other standard deviations."""
    body = fleet.robots["Robot1"]
    return PoseSeen("Robot1", body.x, body.y, 0.0, spread, yaw_spread)


def test_a_lost_robot_stops_and_others_plan_around_it(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(CORRIDOR), [0, 9], 1, loss=0.0)
    fleet.send([8, 7])
    fleet.run(lambda: robot(fleet).cell == 2)
    out = fleet.tell(pose(fleet, 2.3))
    claims = set(fleet.planner.state.ledger.claims("Robot1"))
    assert SendCancel("Robot1") in out
    assert (robot(fleet).state, robot(fleet).mode) == (RobotState.LOST, "automatic")
    assert "2.3 m" in robot(fleet).reason
    fleet.run(lambda: robot(fleet, 2).state is RobotState.ARRIVED)
    assert claims == set(fleet.planner.state.ledger.claims("Robot1"))
    assert (robot(fleet).state, robot(fleet).goal) == (RobotState.LOST, 8)
    fleet.tell(pose(fleet, 0.8))
    assert robot(fleet).state is RobotState.LOST, "between the limits it stays lost"
    fleet.tell(pose(fleet, None, None))
    assert robot(fleet).state is RobotState.LOST, "a pose of its move client tells nothing of it"
    fleet.tell(pose(fleet, 0.5))
    fleet.run(fleet.all_arrived)


def test_a_lost_robot_that_is_paused_stays_lost(make_fleet: type[SimulatedClients]) -> None:
    """A lost robot that a person drives by hand joins once it is found and automatic again."""
    fleet = make_fleet(FleetPlanner(CORRIDOR), [0], 1, loss=0.0)
    fleet.send([8])
    fleet.run(lambda: robot(fleet).cell == 2)
    assert fleet.ask(ModeSet("Robot1", RobotMode.PAUSED, "", "anna")).ok
    fleet.run(lambda: robot(fleet).state is RobotState.PAUSED)
    fleet.tell(pose(fleet, 0.1, 2.0))
    assert robot(fleet).state is RobotState.PAUSED
    assert fleet.ask(ModeSet("Robot1", RobotMode.AUTOMATIC, "", "anna")).ok
    assert (robot(fleet).state, "115 degrees" in robot(fleet).reason) == (RobotState.LOST, True)
    assert fleet.ask(ModeSet("Robot1", RobotMode.MANUAL, "", "anna")).ok
    assert robot(fleet).state is RobotState.MANUAL
    fleet.tell(pose(fleet, 0.1))
    assert fleet.ask(ModeSet("Robot1", RobotMode.AUTOMATIC, "", "anna")).ok
    fleet.run(fleet.all_arrived)


def test_a_new_robot_that_is_lost_gets_no_cell(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap()), [0], 1, loss=0.0)
    fleet.tell(pose(fleet, 5.0))
    for _ in range(40):
        fleet.step()
    assert (robot(fleet).state, robot(fleet).cell) == (RobotState.LOST, None)
    fleet.tell(pose(fleet, 0.2))
    fleet.run(lambda: robot(fleet).state is RobotState.IDLE)


@pytest.mark.parametrize(
    ("lost", "spread", "yaw", "expected"),
    [
        (False, 1.0, 1.0, False),
        (False, 1.01, 0.0, True),
        (False, 0.0, 1.01, True),
        (True, 0.71, 0.0, True),
        (True, 0.0, 0.71, True),
        (True, 0.5, 0.27, False),
        (True, None, 0.0, True),
        (False, None, None, False),
    ],
)
def test_lost_and_found_have_different_limits(
    lost: bool, spread: float | None, yaw: float | None, expected: bool
) -> None:
    record = RobotRecord("Robot1", 0, lost="so" if lost else "")
    seen = PoseSeen("Robot1", 0.0, 0.0, 0.0, spread, yaw)
    assert bool(is_lost(record, seen, FleetSettings())) is expected


def test_other_limits_are_used() -> None:
    seen = PoseSeen("Robot1", 0.0, 0.0, 0.0, 0.3, 0.0)
    strict = replace(FleetSettings(), lost_spread=0.25)
    assert is_lost(RobotRecord("Robot1", 0), seen, strict)


@pytest.mark.parametrize(
    ("entries", "spreads"),
    [
        ({0: 0.04, 7: 0.25, 35: 0.09}, (0.5, 0.3)),
        ({0: 2.5, 1: 1.5, 6: 1.5, 7: 2.5, 35: 0.0}, (2.0, 0.0)),
        ({0: float("nan"), 35: 0.04}, (None, 0.2)),
        ({0: -1.0, 7: -1.0, 35: -1.0}, (None, None)),
    ],
)
def test_covariances_become_standard_deviations(entries: dict[int, float], spreads: Any) -> None:
    covariance = [entries.get(index, 0.0) for index in range(36)]
    position, turn = SimpleNamespace(x=1.0, y=2.0), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    there = SimpleNamespace(pose=SimpleNamespace(position=position, orientation=turn), covariance=covariance)
    message: Any = SimpleNamespace(pose=there)
    seen = read_pose_seen("Robot1", message)
    assert (seen.spread, seen.yaw_spread) == pytest.approx(spreads)


def test_people_cannot_set_the_mode_lost() -> None:
    with pytest.raises(ValueError, match="there is no mode 'lost'"):
        read_mode("lost")
