"""Better paths while robots drive: when they are looked for, and when they are used."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import TYPE_CHECKING

import pytest
from unit.fleet.test_late_plans import PlannerHarness

from rce_fleet.coordination.events import (
    CellBlocked,
    Event,
    GoalSet,
    Instruction,
    PlanMade,
    PoseSeen,
    ReportSeen,
    RobotRemoved,
)
from rce_fleet.coordination.improving import EVERY
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import compute_plan
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

SETTINGS = FleetSettings(
    improve_seconds=1e9, repairs=0, effort=8_000
)  # the effort ends the search, not the time
ROBOTS = 16


class Crowd(PlannerHarness):
    """Robots that were sent across the floor; plans are made at once, better paths when a test says so."""

    def __init__(self, seed: int = 0, settings: FleetSettings = SETTINGS) -> None:
        super().__init__(*range(ROBOTS), settings=settings)
        self.stand()
        for number, cell in enumerate(Random(seed).sample(range(16, 64), ROBOTS), start=1):
            self.tell(GoalSet(f"R{number}", cell))

    def tell(self, event: Event) -> list[Instruction]:
        done = super().tell(event)
        while self.requests and not self.requests[-1].improve_seconds:
            super().tell(PlanMade(compute_plan(self.requests.pop())))
        return done

    def stand(self) -> None:
        for _ in range(4):
            for robot in self.revisions:
                x, y = self.planner.state.grid.centre(self.planner.state.ledger.route(robot)[0])
                self.tell(PoseSeen(robot, x, y, 0.0))
                self.tell(ReportSeen(robot, ClientReport(self.revisions[robot], ClientState.IDLE)))
            self.now += EVERY / 4
        self.events(1)

    def ask(self) -> bool:
        """Let time pass; return whether better paths are asked for."""
        self.requests.clear()
        self.stand()
        return bool(self.requests)

    def granted(self) -> list[list[int]]:
        return [self.planner.state.ledger.granted(f"R{number}") for number in range(1, ROBOTS + 1)]

    def routes(self) -> dict[str, list[int]]:
        return {robot: self.planner.state.ledger.route(robot) for robot in self.planner.state.robots}

    def last_steps(self) -> float:
        """Return the sum of the steps at which the robots arrive."""
        return sum(self.planner.state.ledger.account(robot).steps[-1] for robot in self.planner.state.robots)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_better_paths_keep_granted_cells_and_end_at_goals(seed: int) -> None:
    crowd = Crowd(seed)
    assert crowd.ask()
    granted, before, old = crowd.granted(), crowd.last_steps(), crowd.routes()
    result = compute_plan(crowd.requests[-1])
    assert result.rerouting is not None
    assert result.rerouting.robots
    crowd.tell(PlanMade(result))
    changed = {crowd.requests[-1].robots[index] for index in result.rerouting.robots}
    for cells, now in zip(granted, crowd.granted(), strict=True):
        assert now[: len(cells)] == cells
    for robot, route in crowd.routes().items():
        assert route[-1] == crowd.planner.state.robots[robot].goal
        assert robot in changed or route == old[robot]
    assert crowd.last_steps() < before


@pytest.mark.slow
def test_better_paths_are_not_looked_for_again_in_vain() -> None:
    """The search is repeated while it finds something; then nothing is done until paths change."""
    crowd = Crowd()
    for _ in range(20):
        if not crowd.ask():
            break
        crowd.finish()
    assert not crowd.ask()
    assert not crowd.ask()
    crowd.tell(GoalSet("R1", 9))
    assert any(crowd.ask() for _ in range(5))


@pytest.mark.slow
def test_nothing_is_granted_while_better_paths_are_looked_for() -> None:
    crowd = Crowd()
    assert crowd.ask()
    for robot, cells in zip(tuple(crowd.revisions), crowd.granted(), strict=True):
        if len(cells) > 1:
            crowd.tell(PoseSeen(robot, *crowd.planner.state.grid.centre(cells[1]), 0.0))
    crowd.sent.clear()
    crowd.events(3)
    assert crowd.sent == {}
    crowd.finish()
    assert crowd.sent


@pytest.mark.slow
def test_robots_drive_on_if_better_paths_are_late() -> None:
    """The process is stopped: its answer is ignored when it comes, and other paths are found meanwhile."""
    crowd = Crowd(settings=replace(SETTINGS, improve_seconds=0.05))
    assert crowd.ask()
    for robot, cells in zip(tuple(crowd.revisions), crowd.granted(), strict=True):
        if len(cells) > 1:
            crowd.tell(PoseSeen(robot, *crowd.planner.state.grid.centre(cells[1]), 0.0))
    crowd.now += 2.0
    crowd.sent.clear()
    crowd.events(1)
    assert crowd.sent
    before = crowd.routes()
    PlannerHarness.tell(crowd, PlanMade(compute_plan(replace(crowd.requests[-1], improve_seconds=1e9))))
    assert crowd.routes() == before


@pytest.mark.slow
@pytest.mark.parametrize("what", ["a blocked cell", "a removed robot", "a new goal"])
def test_better_paths_for_another_state_are_not_used(what: str) -> None:
    crowd = Crowd()
    assert crowd.ask()
    request = crowd.requests[-1]
    result = compute_plan(request)
    assert result.rerouting is not None
    robot = request.robots[result.rerouting.robots[0]]
    events: dict[str, Event] = {
        "a blocked cell": CellBlocked(20),
        "a removed robot": RobotRemoved("R1"),
        "a new goal": GoalSet(robot, None),
    }
    PlannerHarness.tell(crowd, events[what])
    ledger = crowd.planner.state.ledger
    versions = {robot: ledger.version(robot) for robot in crowd.planner.state.robots}
    PlannerHarness.tell(crowd, PlanMade(result))
    assert versions == {robot: ledger.version(robot) for robot in crowd.planner.state.robots}


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [replace(SETTINGS, improve_seconds=0), replace(SETTINGS, planner="dijkstra")]
)
def test_better_paths_are_off(settings: FleetSettings) -> None:
    """Without time for it, and for robots that each have their shortest path."""
    crowd = Crowd(settings=settings)
    assert not any(crowd.ask() for _ in range(3))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_robots_with_better_paths_arrive(make_fleet: type[SimulatedClients], seed: int) -> None:
    """Messages are late and get lost, and so are plans: no collision, and everyone arrives."""
    rng = Random(seed)
    grid = GridMap().with_blocked(rng.sample(range(16, 48), 3))
    starts, goals = rng.sample(grid.free[:30], 10), rng.sample(grid.free[30:], 10)
    planner = FleetPlanner(grid, replace(SETTINGS, effort=3_000, repairs=3))
    fleet = make_fleet(planner, starts, seed, loss=0.1, plan_delays=(0.0, 0.3))
    fleet.send(goals)
    fleet.run(fleet.all_arrived)
