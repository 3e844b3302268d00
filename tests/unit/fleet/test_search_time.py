"""Plans for all that find no way past other robots: longer searches, and what the state of a robot says."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from unit.fleet.test_late_plans import PlannerHarness

from rce_fleet.coordination.adoption import NO_PLAN_EXISTS, NO_WAY_PAST
from rce_fleet.coordination.events import GoalSet, PlanMade
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import PlanRequest, PlanResult, request_plan
from rce_fleet.coordination.search_time import PAUSE, SearchTime
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients


def request_with(seconds: float) -> PlanRequest:
    planner = FleetPlanner(GridMap())
    return request_plan(planner.state, planner.settings, 1, 0.0, search_seconds=seconds)


def answer(*, complete: bool = False, failure: str = "") -> PlanResult:
    return PlanResult(1, (), (), (), complete=complete, failure=failure)


@pytest.mark.parametrize(
    ("timeout", "expected"), [(60.0, [0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 15.0]), (8.0, [0.5, 1.0, 2.0, 2.0])]
)
def test_time_grows_and_robots_drive_in_between(timeout: float, expected: list[float]) -> None:
    """A plan is asked for every second, and none is complete."""
    search, taken = SearchTime(timeout), []
    for now in range(300):
        seconds = search.take(float(now))
        search.note(request_with(seconds), answer())
        if seconds:
            taken.append((now, seconds))
    assert [seconds for _, seconds in taken][: len(expected)] == expected
    assert all(later - at >= PAUSE * seconds for (at, seconds), (later, _) in pairwise(taken))


def test_time_shrinks_with_complete_plans() -> None:
    search = SearchTime(60.0)
    assert search.take(0.0) == 0.0
    search.note(request_with(0.0), answer(failure="it took longer than 60 s"))
    assert search.take(1.0) == 0.0, "a longer search would not end the failure"
    search.note(request_with(0.0), answer())
    assert search.take(2.0) == 0.5
    search.note(request_with(0.5), answer())
    assert search.take(100.0) == 1.0
    search.note(request_with(1.0), answer(complete=True))
    assert search.take(101.0) == 0.5, "it needs no pause"
    search.note(request_with(0.5), answer(complete=True))
    assert search.take(102.0) == 0.0


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        ({}, NO_WAY_PAST),
        ({"impossible": True}, NO_PLAN_EXISTS),
        ({"failure": "ValueError: no"}, "the planner made no plan: ValueError: no"),
        ({"complete": True}, ""),
    ],
)
def test_a_waiting_robot_says_why_it_has_no_path(result: dict[str, bool | str], reason: str) -> None:
    harness = PlannerHarness(0, 7, settings=FleetSettings(repairs=0))
    harness.finish_all()
    harness.tell(GoalSet("R1", 56))
    number = harness.requests[-1].number
    fields: dict[str, bool | str] = {"complete": False, **result}
    harness.tell(PlanMade(PlanResult(number, (), (), (), **fields)))  # type: ignore[arg-type]  # by name
    seen = harness.planner.snapshot().robots
    assert [robot.state for robot in seen] == [RobotState.WAITING, RobotState.IDLE]
    assert [robot.reason for robot in seen] == [reason, ""]
    changes = harness.planner.take_changes()
    assert changes is not None
    assert changes.robots[0].reason == reason
    harness.tell(GoalSet("R1", 48))
    assert harness.planner.snapshot().robots[0].reason == ""
    assert harness.requests[-1].search_seconds == (0.5 if "pass" in reason or "past" in reason else 0.0)
    harness.finish()
    assert harness.planner.snapshot().robots[0].state is RobotState.DRIVING


def test_robots_that_cannot_pass_each_other_say_so(make_fleet: type[SimulatedClients]) -> None:
    """Two robots in one lane without a bay, each with its goal behind the other."""
    fleet = make_fleet(FleetPlanner(GridMap(1, 4)), [0, 3], seed=1, loss=0.0)
    fleet.send([3, 0])
    fleet.run(lambda: {robot.reason for robot in fleet.planner.snapshot().robots} == {NO_PLAN_EXISTS}, 60.0)
    assert fleet.states() == [RobotState.WAITING] * 2
