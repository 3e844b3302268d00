"""ScenarioRun with a simulated planner and world."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from support.fleet_states import fleet, robot, truth

from rce_fleet.demo import scenario_run as scenario_run_module
from rce_fleet.demo.scenario_run import ScenarioRun
from rce_fleet.drivers.report import WorldReport
from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.scenario import Scenario
from rce_fleet.station.api import FleetModel

SCENARIO = Scenario(
    grid=GridMap(rows=4, columns=4),
    starts=(0,),
    headings=(0.0,),
    goals=(3,),
    known_boxes=(),
    hidden_boxes=(),
)
ROW = [0, 1, 2, 3]


class FakeStation:
    """A planner whose one robot needs some looks for everything."""

    def __init__(self) -> None:
        self.goals: list[tuple[str, int | None]] = []
        self.blocks: list[tuple[int, bool]] = []
        self.goal: int | None = None
        self.blocked: list[int] = []
        self.looks = 0
        self.restart_at = -1
        self.away_at: set[int] = set()
        self.refuse_blocks = 0
        self.truly_at_goal = True
        self._driven = 0
        self._replans = 0

    async def fleet(self) -> FleetModel:
        await asyncio.sleep(0)
        self.looks += 1
        if self.looks in self.away_at:
            raise StationUnavailableError("away")
        if self.looks == self.restart_at:
            self.goal, self.blocked, self._replans = None, [], 0
        if self.looks < 3:
            return fleet(robot("Robot1", state="joining"))
        if self.goal is None:
            return fleet(robot("Robot1", cell=0))
        self._driven += 1
        if self._driven < 12:
            driving = robot("Robot1", cell=0, goal=3, plan=ROW, state="driving", replans=self._replans)
            return fleet(driving, blocked=self.blocked)
        there = robot("Robot1", cell=3, goal=3, state="arrived", replans=self._replans)
        return fleet(there, blocked=self.blocked)

    async def set_goal(self, name: str, cell: int | None) -> None:
        self.goals.append((name, cell))
        self.goal = cell

    async def set_blocked(self, cell: int, *, blocked: bool) -> None:
        if self.refuse_blocks:
            self.refuse_blocks -= 1
            raise RequestRefusedError("no")
        self.blocks.append((cell, blocked))
        self.blocked = [cell] if blocked else []
        self._replans += blocked

    def truth(self) -> WorldReport:
        at_goal = self._driven >= 12 and self.truly_at_goal
        return truth({"Robot1": 3 if at_goal else 1}, boxes=self.blocked)


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenario_run_module, "POLL_S", 0.0)


def make(station: Any) -> ScenarioRun:
    return ScenarioRun(station, SCENARIO, station.truth, lambda _: None)


async def test_a_robot_is_sent_a_cell_is_blocked_and_it_arrives() -> None:
    station = FakeStation()
    run = make(station)
    assert run.duration == 0.0
    await asyncio.wait_for(run.run(), 5)
    assert station.goals == [("Robot1", 3)]
    (blocked,) = station.blocks
    assert blocked == (run.blocker.done[0], True)
    assert run.reached == {"Robot1"}
    assert run.replans == {"Robot1": 1}
    ended = run.duration
    await asyncio.sleep(0.01)
    assert run.duration == ended > 0


async def test_unavailable_station_is_waited_for() -> None:
    station = FakeStation()
    station.away_at = {1, 5, 6, 9}
    await asyncio.wait_for(make(station).run(), 5)


async def test_restarted_planner_gets_goals_and_cells_again() -> None:
    station = FakeStation()
    station.restart_at = 10
    run = make(station)
    await asyncio.wait_for(run.run(), 5)
    assert station.goals == [("Robot1", 3)] * 2
    assert station.blocks == [(run.blocker.done[0], True)] * 2
    assert run.replans["Robot1"] == 2, "what the first planner counted is not forgotten"


async def test_no_cell_is_blocked_when_none_is_asked_for() -> None:
    station = FakeStation()
    run = ScenarioRun(station, SCENARIO, station.truth, lambda _: None, blocked_cells=0)  # type: ignore[arg-type]  # it is played
    await asyncio.wait_for(run.run(), 5)
    assert station.blocks == []
    assert run.blocker.done == []


async def test_refused_block_is_tried_again() -> None:
    station = FakeStation()
    station.refuse_blocks = 2
    run = make(station)
    await asyncio.wait_for(run.run(), 5)
    assert len(run.blocker.done) == 1


async def test_arrival_needs_the_world_to_confirm_it() -> None:
    station = FakeStation()
    station.truly_at_goal = False
    run = make(station)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(run.run(), 0.2)
    assert run.reached == set()


async def test_a_run_that_does_not_end_says_where_its_robots_are() -> None:
    station = FakeStation()
    run = make(station)
    assert run.missing == ["Robot1 (the planner does not know it)"]
    station.truly_at_goal = False  # the planner takes it for arrived
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(run.run(), 0.2)
    (missing,) = run.missing
    assert missing.startswith("Robot1 (arrived; cell 3, in the world cell 1; goal 3; plan ")
    station.away_at = {station.looks + 1}
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(run.run(), 0.1)
    assert run.refusal
