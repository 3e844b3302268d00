"""Changes while the plan process has a request: the robots concerned get other paths, and only these."""

from __future__ import annotations

import pytest
from unit.fleet.test_late_plans import PlannerHarness

from rce_fleet.coordination.events import (
    CellBlocked,
    Event,
    GoalSet,
    ModeSet,
    ObstacleSeen,
    PlanMade,
    Tick,
    ZonesSet,
)
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.replanning import PlanResult, compute_plan
from rce_fleet.coordination.rerouting import Rerouting
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.zones import Zone, ZoneKind

LATER = 0.2
"""Seconds after a tick, before the next one can have come."""


def asked_for_all(*ways: tuple[int, int]) -> PlannerHarness:
    """Return robots with a start and a goal each, for which one plan is asked: no other paths were found."""
    starts, goals = zip(*ways, strict=True)
    harness = PlannerHarness(*starts, settings=FleetSettings(repairs=1))
    harness.stand()
    for number, goal in enumerate(goals, start=1):
        harness.tell(GoalSet(f"R{number}", goal))
    harness.tell(Tick())
    number = harness.requests[-1].number
    rerouting = Rerouting(found=False)
    harness.tell(PlanMade(PlanResult(number, (), (), (), complete=True, rerouting=rerouting)))
    assert harness.requests[-1].copy is None
    return harness


def test_a_block_during_a_plan_for_all_concerns_one_robot() -> None:
    """No second plan for all follows: the other robots keep the paths of the first."""
    harness = asked_for_all((0, 56), (1, 57), (2, 58))
    asked, route = len(harness.requests), harness.planner.state.ledger.route
    result = compute_plan(harness.requests[-1])
    harness.tell(CellBlocked(41))
    harness.tell(PlanMade(result))
    assert harness.sent["R2"] == (1, 9, 17, 25, 33), "it drives up to the blocked cell"
    others = route("R1"), route("R3")
    assert others == (list(range(0, 57, 8)), list(range(2, 59, 8)))
    harness.tell(Tick())
    assert 41 not in route("R2")
    assert route("R2")[-1] == 57
    assert (route("R1"), route("R3")) == others
    assert len(harness.requests) == asked


def test_a_new_goal_during_a_plan_for_all_concerns_one_robot() -> None:
    harness = asked_for_all((0, 56), (1, 57), (2, 58))
    asked, route = len(harness.requests), harness.planner.state.ledger.route
    result = compute_plan(harness.requests[-1])
    harness.tell(GoalSet("R3", 7))
    harness.tell(PlanMade(result))
    assert (route("R1")[-1], route("R2")[-1], route("R3")) == (56, 57, [2])
    harness.tell(Tick())
    assert route("R3")[-1] == 7
    assert len(harness.requests) == asked


def test_a_robot_with_its_old_goal_again_keeps_the_plan() -> None:
    harness = asked_for_all((0, 56), (1, 57), (2, 58))
    result = compute_plan(harness.requests[-1])
    harness.tell(GoalSet("R3", 7))
    harness.tell(GoalSet("R3", 58))
    harness.tell(PlanMade(result))
    version = harness.planner.state.ledger.version("R3")
    harness.tell(Tick())
    assert harness.planner.state.ledger.version("R3") == version
    assert harness.planner.state.ledger.route("R3")[-1] == 58


def test_robots_are_led_around_one_that_fell_out_meanwhile() -> None:
    """The plan for all leads R1 through the cell in which R2 has stopped since."""
    harness = asked_for_all((0, 7), (3, 59))
    asked, route = len(harness.requests), harness.planner.state.ledger.route
    result = compute_plan(harness.requests[-1])
    harness.tell(ModeSet("R2", RobotMode.PAUSED))
    harness.stand()
    harness.tell(PlanMade(result))
    assert route("R1") == list(range(8))
    harness.tell(Tick())
    assert 3 not in route("R1")
    assert route("R1")[-1] == 7
    assert len(harness.requests) == asked


def test_robots_wait_for_one_that_is_only_stopping() -> None:
    """It was stopped by a block in its base while a plan was made, and has its turn in a second."""
    harness = asked_for_all((0, 7), (3, 59))
    result = compute_plan(harness.requests[-1])
    harness.tell(ModeSet("R2", RobotMode.PAUSED))
    harness.tell(ModeSet("R2", RobotMode.AUTOMATIC))
    harness.tell(PlanMade(result))
    harness.tell(Tick())
    route = harness.planner.state.ledger.route
    assert route("R1") == list(range(8))
    harness.stand()
    harness.tell(Tick())
    assert route("R2")[-1] == 59


def test_a_block_does_not_wait_for_better_paths() -> None:
    """The answer to the request for them is ignored when it comes."""
    harness = PlannerHarness(0, 7, settings=FleetSettings(improve_seconds=1e9, effort=1_000))
    harness.stand()
    harness.tell(GoalSet("R1", 56))
    harness.tell(GoalSet("R2", 63))
    harness.tell(Tick())
    (request,) = harness.requests
    assert request.improve_seconds
    result = compute_plan(request)
    harness.now += LATER
    harness.tell(CellBlocked(24))
    ledger = harness.planner.state.ledger
    assert 24 not in ledger.route("R1")
    assert ledger.route("R1")[-1] == 56
    assert len(harness.sent["R1"]) == len(harness.sent["R2"]) == 5
    versions = ledger.version("R1"), ledger.version("R2")
    harness.tell(PlanMade(result))
    assert (ledger.version("R1"), ledger.version("R2")) == versions


@pytest.fixture
def driving() -> PlannerHarness:
    """R1 drives through row 0, and was granted its first cells."""
    harness = PlannerHarness(0, 63, settings=FleetSettings())
    harness.stand()
    harness.tell(GoalSet("R1", 7))
    harness.tell(Tick())
    assert harness.sent["R1"] == (0, 1, 2, 3, 4)
    return harness


@pytest.mark.parametrize(
    "event",
    [CellBlocked(6), ZonesSet((Zone("z", ZoneKind.BLOCKED, (6,)),)), ObstacleSeen("R1", (6,))],
    ids=["cell", "zone", "obstacle"],
)
def test_a_path_is_found_with_the_event_that_cuts_the_old(driving: PlannerHarness, event: Event) -> None:
    driving.now += LATER
    driving.tell(event)
    route = driving.planner.state.ledger.route("R1")
    assert 6 not in route
    assert route[-1] == 7


def test_robots_are_led_around_one_as_soon_as_it_is_paused() -> None:
    harness = PlannerHarness(0, 6, settings=FleetSettings())
    harness.stand()
    for robot, goal in (("R2", 62), ("R1", 7)):
        harness.tell(GoalSet(robot, goal))
        harness.tell(Tick())
    route = harness.planner.state.ledger.route
    assert 6 in route("R1")
    harness.now += LATER
    harness.tell(ModeSet("R2", RobotMode.PAUSED))
    assert 6 not in route("R1")
    assert route("R1")[-1] == 7


def test_cells_blocked_in_one_go_are_looked_at_together(driving: PlannerHarness) -> None:
    route = driving.planner.state.ledger.route
    driving.now += LATER
    driving.tell(CellBlocked(6))
    driving.tell(CellBlocked(route("R1")[-3]))
    assert route("R1")[-1] != 7, "it waits for the next tick"
    driving.tell(Tick())
    assert route("R1")[-1] == 7
