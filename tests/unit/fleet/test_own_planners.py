"""Planners of other packages in a fleet: when they are asked, and what becomes of plans that are wrong."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pytest

from rce_fleet.coordination.events import CellBlocked, GoalSet, MakePlan, Tick
from rce_fleet.coordination.own_planner import PAUSE, find_fault
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import PlanRequest, PlanResult, compute_plan, request_plan
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.planning import planner
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.independent import DijkstraPlanner
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.planner import JointPlan, PlanningProblem

if TYPE_CHECKING:
    from collections.abc import Callable

    from unit.fleet.conftest import SimulatedClients

    from rce_fleet.coordination.events import Event, Instruction

MINE = FleetSettings(planner="mine")
LANE = GridMap(2, 6, blocked=frozenset({6, 7, 9, 10, 11}))
"""One lane with a bay beside cell 2."""


class Mine:
    """The planner ``mine``; the test says how it plans."""

    calls: ClassVar[list[PlanningProblem]] = []
    make: ClassVar[Callable[[PlanningProblem], JointPlan]]

    def plan(self, problem: PlanningProblem) -> JointPlan:
        self.calls.append(problem)
        return type(self).make(problem)


def good(problem: PlanningProblem) -> JointPlan:
    return LacamPlanner(compiled=False).plan(problem)


def jumping(problem: PlanningProblem) -> JointPlan:
    return JointPlan.of([problem.starts.tolist(), problem.goals.tolist()], complete=True)


def careless(problem: PlanningProblem) -> JointPlan:
    """Plan each robot alone, and promise that there are no conflicts."""
    return replace(DijkstraPlanner().plan(problem), conflict_free=True)


def independent(problem: PlanningProblem) -> JointPlan:
    return DijkstraPlanner().plan(problem)


def hopeless(problem: PlanningProblem) -> JointPlan:
    return JointPlan.of([problem.starts.tolist()], complete=False)


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> type[Mine]:
    """Install the planner ``mine`` beside the others."""
    point = EntryPoint("mine", f"{__name__}:Mine", planner.PLANNER_ENTRY_POINTS)
    monkeypatch.setattr(planner, "entry_points", lambda *, group: [*entry_points(group=group), point])
    monkeypatch.setattr(Mine, "calls", [])
    monkeypatch.setattr(Mine, "make", staticmethod(good), raising=False)
    return Mine


def follow_requests(fleet: SimulatedClients) -> list[str]:
    """Return a list that grows with the planner of each request."""
    asked: list[str] = []
    tell = fleet.tell

    def told(event: Event) -> list[Instruction]:
        out = tell(event)
        asked.extend(done.request.planner for done in out if isinstance(done, MakePlan))
        return out

    fleet.tell = told  # type: ignore[method-assign]
    return asked


@pytest.mark.parametrize("count", [2, 6])
def test_an_own_planner_makes_the_paths_of_all_robots(
    make_fleet: type[SimulatedClients], mine: type[Mine], count: int
) -> None:
    """For new goals and for a cell that is blocked on a path; never a repair of single paths."""
    fleet = make_fleet(FleetPlanner(GridMap(), MINE), list(range(count)), 1, loss=0.0)
    fleet.send(list(range(56, 56 + count)))
    calls = len(mine.calls)
    assert calls
    assert len(mine.calls[-1].goals) == count
    assert fleet.planner.snapshot().robots[0].plan[-1] == 56
    assert fleet.ask(CellBlocked(fleet.planner.snapshot().robots[0].plan[-2])).ok
    fleet.tell(Tick())
    assert len(mine.calls) == calls + 1
    assert fleet.planner.snapshot().robots[0].plan[-1] == 56


@pytest.mark.parametrize("make", [jumping, careless, hopeless])
def test_robots_arrive_though_an_own_plan_is_wrong(
    make_fleet: type[SimulatedClients], mine: type[Mine], make: Callable[[PlanningProblem], JointPlan]
) -> None:
    """The fleet checks after each step that robots drive within granted cells, and never touch."""
    mine.make = staticmethod(make)
    fleet = make_fleet(FleetPlanner(LANE, MINE), [0, 5], 1, loss=0.0)
    fleet.send([5, 0])
    fleet.run(fleet.all_arrived)
    assert mine.calls


def test_an_own_plan_that_leads_to_a_deadlock_is_left(
    make_fleet: type[SimulatedClients], mine: type[Mine]
) -> None:
    """A plan that does not promise freedom of conflicts is carried out; lacam is the way out."""
    mine.make = staticmethod(independent)
    fleet = make_fleet(FleetPlanner(LANE, MINE), [0, 5], 1, loss=0.0)
    fleet.send([5, 0])
    assert not fleet.planner.state.ledger.ordered
    fleet.run(fleet.all_arrived)


def test_an_own_planner_is_asked_again_after_a_pause(
    make_fleet: type[SimulatedClients], mine: type[Mine]
) -> None:
    mine.make = staticmethod(jumping)
    fleet = make_fleet(FleetPlanner(GridMap(), MINE), [0, 5], 1, loss=0.0)
    fleet.send([7, 8])
    fleet.run(fleet.all_arrived)
    failed = len(mine.calls)
    fleet.ask(GoalSet("Robot1", 20))
    fleet.tell(Tick())
    assert len(mine.calls) == failed
    mine.make = staticmethod(good)
    fleet.run(fleet.all_arrived)
    fleet.now += PAUSE
    for _ in range(2):
        fleet.step()
    fleet.ask(GoalSet("Robot1", 30))
    fleet.run(fleet.all_arrived)
    assert len(mine.calls) > failed


def test_a_plan_that_took_too_long_is_made_by_lacam(
    make_fleet: type[SimulatedClients], mine: type[Mine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planner's process answers with a failure then, as after an exception."""
    fleet = make_fleet(FleetPlanner(GridMap(), MINE), [0, 5], 1, loss=0.0)

    def compute(request: PlanRequest) -> PlanResult:
        if request.planner == "mine":
            failure = "it took longer than 60 s"
            return PlanResult(request.number, (), (), (), complete=False, failure=failure)
        return compute_plan(request)

    monkeypatch.setattr(sys.modules[make_fleet.__module__], "compute_plan", compute)
    asked = follow_requests(fleet)
    fleet.send([7, 8])
    fleet.run(fleet.all_arrived)
    assert asked.count("mine") == 1
    assert "lacam" in asked
    assert not mine.calls


GRID = GridMap(3, 4, blocked=frozenset({5}))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([[0, 3], [1, 2], [1, 2]], ""),
        ([[0, 3], [0, 2], [10, 2]], "step 2: robot 0 goes from cell 0 to 10, .* (robot 0 is A)"),
        ([[1, 3], [1, 2]], "step 0: the path of robot 0 begins in cell 1 instead of 0 (robot 0 is A)"),
        ([[0, 3], [4, 2], [5, 2]], "step 2: robot 0 is in the blocked cell 5 (robot 0 is A)"),
        ([[0, 3], [1, 2], [2, 1]], "step 2: robots 0 and 1 exchange cells .* (robot 0 is A, robot 1 is B)"),
        ([[0, 3], [1, 7], [1, 11]], "step 2: robot 1 enters cell 11, which it may not (it is B)"),
        ([[0, 3, 8]], "its plan has the shape (1, 3) instead of (steps + 1, 2 robots)"),
        ([[0, 3]], "it found no plan: all robots stay where they are"),
    ],
)
def test_the_fault_of_a_plan_names_robot_and_step(rows: list[list[int]], said: str) -> None:
    problem = PlanningProblem.of(
        PlanningGraph.from_grid(GRID), [0, 3], [2, 1], forbidden={1: frozenset({11})}
    )
    fault = find_fault(JointPlan.of(rows, complete=False), problem, GRID, ["A", "B"])
    begin, _, end = said.partition(".*")
    assert fault.startswith(begin)
    assert fault.endswith(end)
    assert bool(fault) == bool(said)


def test_a_plan_that_is_called_complete_ends_at_the_goals() -> None:
    problem = PlanningProblem.of(PlanningGraph.from_grid(GRID), [0], [2])
    fault = find_fault(JointPlan.of([[0], [1]], complete=True), problem, GRID, ["A"])
    assert "the path of robot 0 ends in cell 1 instead of 2" in fault


def test_a_plan_without_whole_numbers_is_refused() -> None:
    problem = PlanningProblem.of(PlanningGraph.from_grid(GRID), [0], [2])
    fault = find_fault(JointPlan(np.array([[0.5]]), complete=False), problem, GRID, ["A"])
    assert "whole numbers" in fault


def test_an_own_planner_is_not_asked_without_robots(mine: type[Mine]) -> None:
    request = request_plan(FleetPlanner(GridMap(), MINE).state, MINE, 1, 0.0, planner="mine")
    assert compute_plan(request).complete
    assert not mine.calls
