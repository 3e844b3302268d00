"""What the fleet manager tells the planner: cells, modes and goals; also after restarts."""

from __future__ import annotations

import asyncio
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
from support.fleet_manager import GO, ManagerClient

from rce.ros.types import Time
from rce_fleet.coordination.events import PoseSeen, ReportSeen, Tick
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.manager.goals import NO_ANSWER, GoalKeeper
from rce_fleet.nodes.fleet_facts import FULL, FactKeeper
from rce_fleet.nodes.state_publisher import state_fields
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import Lane, LaneGraph
from rce_fleet.tasks.facts import FleetFacts, RobotFacts
from rce_fleet.tasks.records import BlockedCells, CellBlock, FleetEntry, PlannerRun


async def test_the_map_shows_a_cell_as_it_was_just_set(client: ManagerClient) -> None:
    """The planner's change comes later; the person who blocked the cell looks at once."""
    assert (await client.ask("PUT", "/cells/5", {"blocked": True}))[0] == 200
    assert (await client.ask("GET", "/map"))[1]["blocked"] == [5]
    client.manager.facts.shut = frozenset({5, 9})
    assert (await client.ask("PUT", "/cells/5", {"blocked": False}))[0] == 200
    shown = (await client.ask("GET", "/map"))[1]
    assert (shown["blocked"], shown["walls"]) == ([], [9])


async def test_the_map_shows_the_lanes(client: ManagerClient) -> None:
    assert (await client.ask("GET", "/map"))[1]["lanes"] == []
    client.manager.facts.lanes = LaneGraph((Lane("out", (0, 1), one_way=True, speed=0.5),))
    lane = {"name": "out", "cells": [0, 1], "one_way": True, "speed": 0.5, "width": 0.0, "cost": 1}
    assert (await client.ask("GET", "/map"))[1]["lanes"] == [lane]


def test_lanes_come_from_the_planners_state() -> None:
    """Its messages have the fields of a lane; planners of earlier releases tell none."""
    lanes = LaneGraph(
        (Lane("out", (0, 1, 2), one_way=True, speed=0.5, cost=3), Lane("b", (2, 10), width=0.5))
    )
    planner = FleetPlanner(lanes.restrict(GridMap()), lanes=lanes)
    state = state_fields(Time(5, 0), planner)
    facts = FleetFacts()
    keeper = FactKeeper(facts)
    keeper.take_state({"sequence": 0, "state": {**state, "started": {"secs": 5, "nsecs": 0}}}, 1.0)
    assert facts.lanes == lanes
    del state["lanes"]
    keeper.take_state({"sequence": 0, "state": {**state, "started": {"secs": 6, "nsecs": 0}}}, 2.0)
    assert facts.lanes is None


def test_the_planner_tells_who_rests_on_a_path() -> None:
    planner = FleetPlanner(GridMap(1, 6))
    facts = FleetFacts()
    keeper = FactKeeper(facts)
    state = {**state_fields(Time(5, 0), planner), "started": {"secs": 5, "nsecs": 0}}
    reasons = ("deadlock: Robot2 rests on its path, in cell 3", "")
    for reason, cell in zip(reasons, (3, None), strict=True):
        robot = {
            "id": "Robot1",
            "cell": 1,
            "goal": 5,
            "state": "waiting",
            "reason": reason,
            "mode": "automatic",
        }
        keeper.take_state({"sequence": 0, "state": {**state, "robots": [robot]}}, 1.0)
        assert facts.robots["Robot1"].barred_by == cell


def test_a_lost_robot_of_the_planner_is_away_until_it_is_found() -> None:
    """The planner does not drive it meanwhile: its tasks are given to others, as of a silent one."""
    planner, facts = FleetPlanner(GridMap()), FleetFacts()
    keeper, centre = FactKeeper(facts), GridMap().centre(9)
    for second, spread in ((1, 0.1), (2, 3.0), (3, 0.1)):
        for now in (second, second + 0.5):
            planner.handle(PoseSeen("Robot1", *centre, 0.0, spread, spread), now)
            revision = planner.state.robots["Robot1"].revision
            planner.handle(ReportSeen("Robot1", ClientReport(revision, ClientState.IDLE)), now)
            planner.handle(Tick(), now)
        state = {**state_fields(Time(second, 0), planner), "started": {"secs": second, "nsecs": 0}}
        keeper.take_state({"sequence": 0, "state": state}, float(second))
        robot = facts.robots["Robot1"]
        found = ("lost", False, float(second)) if spread > 1 else ("idle", True, inf)
        assert (robot.state, robot.is_there, robot.away_since) == found


@pytest.mark.parametrize(
    ("percentage", "capacity", "status", "level"),
    [
        (0.6, 20.0, 1, 0.6),
        (nan, 20.0, 1, 0.8),
        (nan, 20.0, FULL, 1.0),
        (0.93, 0.0, FULL, 1.0),
        (nan, 0.0, 1, None),
        (1.04, 0.0, 1, 1.0),
        (-0.02, 0.0, 1, 0.0),
    ],
)
def test_a_battery_is_full_when_it_says_so(
    percentage: float, capacity: float, status: int, level: float | None
) -> None:
    """A worn one holds 16 of 20 ampere hours then."""
    facts = FleetFacts(robots={"Robot1": RobotFacts("Robot1")})
    assert not FactKeeper(facts).take_battery("Robot1", percentage, 16.0, capacity, status)
    assert facts.robots["Robot1"].battery == level


@pytest.mark.parametrize("percentage", [12.0, 100.0, -1.0])
@pytest.mark.parametrize(("capacity", "level"), [(0.0, None), (20.0, 0.8)])
def test_a_battery_in_percent_is_not_full(percentage: float, capacity: float, level: float | None) -> None:
    """Its robot would get every task and never charge."""
    facts = FleetFacts(robots={"Robot1": RobotFacts("Robot1", battery=0.5)})
    fault = FactKeeper(facts).take_battery("Robot1", percentage, 16.0, capacity, 2)
    assert facts.robots["Robot1"].battery == level
    assert f"percentage is {percentage:g}, not a share of 0 .. 1" in fault


async def test_a_request_reaches_the_planner_after_a_kill(tmp_path: Path) -> None:
    """The planner was away when it was accepted; once it has it, only changes at the planner count."""

    def begin() -> ManagerClient:
        made = ManagerClient(tmp_path / "j.sqlite")
        made.manager.facts.is_current, made.manager.facts.requested = True, frozenset()
        made.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
        made.manager.planner_began(PlannerRun("1", "8 x 8"))
        return made

    first = begin()
    await first.manager.step()
    first.manager.facts.is_live = False
    assert (await first.ask("POST", "/robots/Robot1/pause", {"reason": "tea"}))[0] == 200
    await first.manager.close()
    second = begin()
    await second.manager.step()
    assert second.planner.calls == [("mode", "Robot1", "paused", "tea", "erp")]
    await second.manager.step()
    await second.manager.close()
    third = begin()
    await third.manager.step()
    assert (third.planner.calls, third.manager.book.entry("Robot1").mode) == ([], "automatic")
    await third.manager.close()


@pytest.mark.parametrize("change", ["pause", "resume"])
async def test_a_robot_that_is_out_is_not_brought_back(client: ManagerClient, change: str) -> None:
    """A script that pauses and resumes every robot put those into service that a person had taken out."""
    client.manager.facts.is_current = True
    client.manager.planner_began(PlannerRun("1", "8 x 8"))
    client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    assert (await client.ask("POST", "/robots/Robot1/take-out"))[0] == 200
    status, body, _ = await client.ask("POST", f"/robots/Robot1/{change}")
    assert (status, "put it in" in str(body)) == (409, True)
    assert client.manager.book.entry("Robot1").mode == "out_of_service"


@pytest.mark.parametrize("mode", ["paused", "stopped"])
async def test_a_robot_that_is_put_in_may_stand(client: ManagerClient, mode: str) -> None:
    """As before it was taken out: the planner is never told to drive it."""
    client.manager.facts.is_current = True
    client.manager.planner_began(PlannerRun("1", "8 x 8"))
    client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    await client.ask("POST", "/robots/Robot1/take-out", {"reason": "a wheel"})
    put_in = {"mode": mode, "reason": "visitors"}
    status, body, _ = await client.ask("POST", "/robots/Robot1/put-in", put_in)
    assert (status, body["mode"], body["mode_reason"]) == (200, mode, "visitors")
    assert [call[2] for call in client.planner.calls] == ["out_of_service", mode]
    assert (await client.ask("POST", "/robots/Robot1/put-in", {"mode": "manual"}))[0] == 422


async def test_a_mode_that_the_planner_refuses_stays(client: ManagerClient) -> None:
    client.manager.facts.is_current = True
    client.manager.planner_began(PlannerRun("1", "8 x 8"))
    client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    client.planner.refusal = "not now"
    status, body, _ = await client.ask("POST", "/robots/Robot1/take-out")
    assert (status, body["error"]) == (409, "not now")
    assert (await client.ask("GET", "/robots/Robot1"))[1]["mode"] == "automatic"


@pytest.mark.parametrize("change", ["pause", "take-out"])
async def test_a_mode_without_an_answer_is_sent_later(client: ManagerClient, change: str) -> None:
    """The planner is being restarted: it gets what was accepted, as if it had not been heard before."""
    manager, planner = client.manager, client.planner
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    planner.refusal = f"{NO_ANSWER}: closed"
    status, body, _ = await client.ask("POST", f"/robots/Robot1/{change}")
    assert (status, body["mode"]) == (200, planner.calls[0][2])
    planner.refusal = ""
    manager.planner_began(PlannerRun("2", "8 x 8"))
    await manager.step()
    assert planner.calls == [planner.calls[0]] * 2
    assert manager.book.entry("Robot1").mode == body["mode"]


async def test_a_robot_paused_with_the_fleet_stays_paused(client: ManagerClient) -> None:
    """The planner has to know the robot's own mode when the fleet drives again."""
    manager = client.manager
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    manager.facts.robots["Robot1"] = RobotFacts("Robot1", "paused", cell=0, mode="paused")
    manager.facts.mode = "paused"
    await manager.step()
    assert (await client.ask("POST", "/robots/Robot1/pause"))[0] == 200
    assert client.planner.calls == [("mode", "Robot1", "paused", "", "erp")]


@pytest.mark.parametrize(
    ("method", "path", "bodies"),
    [
        ("PUT", "/mode", ({"mode": "paused"}, {"mode": "paused", "reason": "lunch"})),
        ("POST", "/robots/Robot1/pause", ({}, {"reason": "lunch"})),
        ("PUT", "/cells/12", ({"blocked": True}, {"blocked": False})),
        ("PUT", "/zones/z", ({"kind": "blocked", "cells": [3]}, {"kind": "blocked", "cells": [4]})),
    ],
)
async def test_two_refused_requests_leave_what_was_before(
    client: ManagerClient, method: str, path: str, bodies: tuple[Any, Any]
) -> None:
    """The second one came before the planner had answered the first one."""
    manager, planner, asked, answered = client.manager, client.planner, asyncio.Event(), asyncio.Event()
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)

    async def refuse(*_given: object, **_named: object) -> str:
        asked.set()
        await answered.wait()
        return "not now"

    planner.set_mode = planner.block_cell = planner.set_zone = refuse  # type: ignore[method-assign]
    async with asyncio.timeout(60):
        first = asyncio.create_task(client.ask(method, path, bodies[0]))
        await asked.wait()
        second = asyncio.create_task(client.ask(method, path, bodies[1]))
        await asyncio.sleep(0)
        answered.set()
        assert [(await each)[0] for each in (first, second)] == [409, 409]
    book = manager.book
    assert (book.fleet.mode, book.entry("Robot1").mode) == ("automatic", "automatic")
    assert (book.blocked.cells, book.zones) == ((), {})


async def test_a_goal_set_by_hand_holds_the_task(client: ManagerClient) -> None:
    robot = client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    await client.ask("POST", "/tasks", GO)
    for _ in range(2):
        await client.manager.step()
        robot.goal, robot.state = client.planner.goals.get("Robot1"), "driving"
    assert robot.goal == 5
    await client.manager.step()
    robot.goal = 60
    await client.manager.step()
    task = (await client.ask("GET", "/tasks/T1"))[1]
    assert (task["state"], task["robot_assigned"]) == ("held", "")
    assert "Robot1 was sent to cell 60 by hand" in task["reason"]
    assert client.planner.goals["Robot1"] == 5, "the goal that was set by hand was overwritten"


def test_goals_are_sent_again_after_a_restart() -> None:
    keeper, facts = GoalKeeper(), FleetFacts(is_live=True)
    robot = facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    assert keeper.to_send(facts, {"Robot1": 5}, 0.0) == [("Robot1", 5)]
    assert keeper.to_send(facts, {"Robot1": 5}, 0.5) == []
    assert keeper.to_send(facts, {"Robot1": 5}, 2.0) == [("Robot1", 5)]
    robot.goal = 5
    assert keeper.notice(facts, {"Robot1": 5}) == {}
    keeper.reset()
    robot.goal = None
    assert keeper.notice(facts, {"Robot1": 5}) == {}
    assert keeper.to_send(facts, {"Robot1": 5}, 3.0) == [("Robot1", 5)]


async def test_a_blocked_cell_is_in_the_journal_first(client: ManagerClient) -> None:
    """The planner is told what the journal has; a cell that only sensors blocked is freed as well."""
    kept: list[tuple[int, ...]] = []
    planner, told = client.planner, client.planner.block_cell

    async def block_cell(cell: int, block: CellBlock | None, now: float) -> str:
        records, _ = client.journal.load()
        kept.extend(record.unsent for record in records if isinstance(record, BlockedCells))
        return await told(cell, block, now)

    planner.block_cell = block_cell  # type: ignore[method-assign]  # looks into the journal first
    status, said, _ = await client.ask("PUT", "/cells/12", {"blocked": True})
    assert (status, said, kept) == (200, {"message": "cell 12 is blocked"}, [(12,)])
    event = (await client.ask("GET", "/events"))[1]["events"][-1]
    assert (event["kind"], event["name"], event["user"]) == ("cells", "blocked", "erp")
    assert (await client.ask("PUT", "/cells/20", {"blocked": False}))[0] == 200
    assert planner.calls == [("cell", 12, True), ("cell", 20, False)]
    assert (await client.ask("PUT", "/cells/12", {"blocked": True}, role="viewer"))[0] == 403


async def test_a_pause_of_the_fleet_survives_a_kill(tmp_path: Path) -> None:
    """The manager is killed after its answer, before the planner has the pause; both run again."""

    def begin() -> ManagerClient:
        made = ManagerClient(tmp_path / "j.sqlite")
        made.manager.facts.is_current = True
        made.manager.planner_began(PlannerRun("1", "8 x 8"))
        return made

    first = begin()
    await first.manager.step()
    first.manager.facts.is_live = False
    status, said, _ = await first.ask("PUT", "/mode", {"mode": "paused", "reason": "lunch"})
    assert (status, said) == (200, {"message": "the fleet is paused"})
    await first.manager.close()
    second = begin()
    await second.manager.step()
    assert second.planner.calls == [("mode", "", "paused", "lunch", "erp")]
    await second.manager.step()
    await second.manager.close()
    third = begin()
    await third.manager.step()
    assert third.planner.calls == [], "the planner has had it: now it was changed there"
    assert third.manager.book.fleet.mode == "automatic"
    await third.manager.close()


async def test_a_pause_of_the_fleet_is_in_the_journal_first(client: ManagerClient) -> None:
    kept: list[FleetEntry] = []
    planner, told = client.planner, client.planner.set_mode

    async def set_mode(robot: str, mode: str, reason: str, user: str) -> str:
        records, _ = client.journal.load()
        kept.extend(record for record in records if isinstance(record, FleetEntry))
        return await told(robot, mode, reason, user)

    planner.set_mode = set_mode  # type: ignore[method-assign]  # looks into the journal first
    assert (await client.ask("PUT", "/mode", {"mode": "paused"}))[0] == 200
    assert kept == [FleetEntry("paused", "", "erp", 1, unsent=True)]
    assert planner.calls == [("mode", "", "paused", "", "erp")]
    event = (await client.ask("GET", "/events"))[1]["events"][-1]
    assert (event["name"], event["user"], event["text"]) == ("paused", "erp", "the fleet is paused")
    assert (await client.ask("PUT", "/mode", {"mode": "stopped"}))[0] == 422
    assert (await client.ask("PUT", "/mode", {"mode": "paused"}, role="viewer"))[0] == 403


async def test_a_refused_pause_leaves_the_fleet_driving(client: ManagerClient) -> None:
    for refusal, expected in (("no", 409), ("the planner does not answer: gone", 503)):
        client.planner.refusal = refusal
        status, said, _ = await client.ask("PUT", "/mode", {"mode": "paused"})
        assert (status, said, client.manager.book.fleet.mode) == (expected, {"error": refusal}, "automatic")


async def test_a_cell_that_the_planner_refuses_stays(client: ManagerClient) -> None:
    for refusal, expected in (("remove the zone", 409), ("the planner does not answer: gone", 503)):
        client.planner.refusal = refusal
        status, said, _ = await client.ask("PUT", "/cells/12", {"blocked": True})
        assert (status, said, client.manager.book.blocked.cells) == (expected, {"error": refusal}, ())
    client.manager.facts.is_live = False
    assert (await client.ask("PUT", "/cells/12", {"blocked": True}))[0] == 200
    kept = client.manager.book.blocked
    assert (kept.cells, kept.unsent) == ((12,), (12,))
