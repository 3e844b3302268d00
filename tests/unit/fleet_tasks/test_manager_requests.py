"""Requests to the fleet manager without ROS: answers, roles, pages, revisions, bad input, a full disk."""

from __future__ import annotations

import asyncio
import json
import logging
import sqlite3
import threading
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rce_fleet.exceptions import JournalError
from rce_fleet.journal.journal import Journal
from rce_fleet.manager import manager as managers
from rce_fleet.manager import task_routes
from rce_fleet.manager.fleet_routes import ROUTES as FLEET_ROUTES
from rce_fleet.manager.goals import GoalKeeper
from rce_fleet.manager.manager import FleetManager
from rce_fleet.manager.mirror import REFUSED_S
from rce_fleet.manager.requests import FleetRequest, Router
from rce_fleet.manager.task_routes import ROUTES as TASK_ROUTES
from rce_fleet.manager.zones import zone_fields
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.facts import FleetFacts, RobotFacts
from rce_fleet.tasks.loads import carried
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import (
    BlockedCells,
    GoalEntry,
    Places,
    PlannerRun,
    RobotEntry,
    RobotProfile,
    Zone,
)
from rce_fleet.tasks.task import Task, TaskState

GO = {"stops": [{"cell": 5}]}


class Planner:
    """Accepts all goals."""

    def __init__(self) -> None:
        self.goals: dict[str, int | None] = {}
        self.calls: list[tuple[Any, ...]] = []
        self.refusal = ""

    async def set_goal(self, robot: str, cell: int | None) -> str:
        self.goals[robot] = cell
        return ""

    async def block_cell(self, cell: int, *, blocked: bool) -> str:
        self.calls.append(("cell", cell, blocked))
        return self.refusal

    async def set_mode(self, robot: str, mode: str, reason: str, user: str) -> str:
        self.calls.append(("mode", robot, mode, reason, user))
        return self.refusal

    async def set_zone(self, name: str, zone: Zone | None, now: float) -> str:
        self.calls.append(("zone", name, None if zone is None else zone_fields(zone, now)["kind"]))
        return self.refusal


class ManagerClient:
    """A manager with a journal, and a client of it."""

    def __init__(self, path: Path) -> None:
        self.journal = Journal(path)
        self.planner = Planner()
        self.manager = FleetManager(self.journal, self.planner, TaskRules(), logging.getLogger("manager"))
        self.manager.facts.grid = self.manager.book.grid = GridMap(blocked=frozenset({9}))
        self.manager.facts.shut = frozenset({9})
        self.manager.facts.is_live = True
        self.router = Router(self.manager, [*TASK_ROUTES, *FLEET_ROUTES])

    async def ask(self, method: str, path: str, body: Any = None, **fields: str) -> tuple[int, Any, str]:
        text = body if isinstance(body, str) else "" if body is None else json.dumps(body)
        given = {"user": "erp", "role": "operator", **fields}
        answer = await self.router.answer(FleetRequest(method, path, text, **given))
        return answer.status, json.loads(answer.body), answer.revision


@pytest.fixture
async def client(tmp_path: Path) -> AsyncIterator[ManagerClient]:
    made = ManagerClient(tmp_path / "j.sqlite")
    yield made
    await made.manager.close()


async def test_pages_of_tasks_follow_each_other(client: ManagerClient) -> None:
    for _ in range(5):
        assert (await client.ask("POST", "/tasks", GO))[0] == 201
    first = (await client.ask("GET", "/tasks?limit=2"))[1]
    second = (await client.ask("GET", f"/tasks?limit=2&cursor={first['next']}"))[1]
    newest = (await client.ask("GET", "/tasks?order=desc&limit=1"))[1]
    assert [task["id"] for task in first["tasks"] + second["tasks"]] == ["T1", "T2", "T3", "T4"]
    assert newest["tasks"][0]["id"] == "T5"
    await client.ask("DELETE", "/tasks/T3")
    ended = (await client.ask("GET", "/tasks?state=ended"))[1]
    assert ([task["id"] for task in ended["tasks"]], ended["next"]) == (["T3"], None)


async def test_an_old_etag_is_refused(client: ManagerClient) -> None:
    _, _, revision = await client.ask("POST", "/tasks", GO)
    status, body, newer = await client.ask("PATCH", "/tasks/T1", {"priority": 3}, revision=revision)
    assert (status, body["priority"], newer) == (200, 3, '"2"')
    assert (await client.ask("PATCH", "/tasks/T1", {"priority": 4}, revision=revision))[0] == 412
    assert (await client.ask("PUT", "/chargers", {"chargers": [63]}, revision='"0"'))[0] == 200
    assert (await client.ask("PUT", "/chargers", {"chargers": []}, revision='"0"'))[0] == 412


async def test_the_etag_of_a_removed_zone_fits_no_new_one(client: ManagerClient, tmp_path: Path) -> None:
    """Another person removed the zone and made one of the same name: their zone was replaced."""
    zone = {"kind": "slow", "cells": [3], "value": 0.3}
    _, _, seen = await client.ask("PUT", "/zones/gate", zone)
    await client.ask("DELETE", "/zones/gate")
    await client.manager.close()
    following = ManagerClient(tmp_path / "j.sqlite")
    client.manager = following.manager
    _, _, newer = await following.ask("PUT", "/zones/gate", {"kind": "blocked", "cells": [4]}, revision='"0"')
    assert (await following.ask("PUT", "/zones/gate", zone, revision=seen))[0] == 412
    assert (await following.ask("DELETE", "/zones/gate", revision=seen))[0] == 412
    assert (await following.ask("PUT", "/zones/gate", zone, revision=newer))[0] == 200


async def test_the_map_shows_a_cell_as_it_was_just_set(client: ManagerClient) -> None:
    """The planner's change comes later; the person who blocked the cell looks at once."""
    assert (await client.ask("PUT", "/cells/5", {"blocked": True}))[0] == 200
    assert (await client.ask("GET", "/map"))[1]["blocked"] == [5]
    client.manager.facts.shut = frozenset({5, 9})
    assert (await client.ask("PUT", "/cells/5", {"blocked": False}))[0] == 200
    shown = (await client.ask("GET", "/map"))[1]
    assert (shown["blocked"], shown["walls"]) == ([], [9])


async def test_a_viewer_changes_nothing(client: ManagerClient) -> None:
    assert (await client.ask("POST", "/tasks", GO, role="viewer"))[0] == 403
    assert (await client.ask("GET", "/tasks", role="viewer"))[:2] == (200, {"tasks": [], "next": None})


@pytest.mark.parametrize("path", ["/robots/Robot1", "/robots/Robot1/take-out", "/robots/Robot1/goal"])
async def test_no_robot_is_denied_before_the_planner_has_told_its_robots(
    client: ManagerClient, path: str
) -> None:
    """A fleet manager that was killed does not know yet which robots there are."""
    grid, client.manager.facts.grid = client.manager.facts.grid, None
    method = {"Robot1": "GET", "take-out": "POST", "goal": "PUT"}[path.rpartition("/")[2]]
    body = {"cell": 3} if method == "PUT" else None
    status, said, _ = await client.ask(method, path, body)
    assert (status, said["error"]) == (503, "the planner has not told its robots yet; try again later")
    client.manager.facts.grid = grid
    assert (await client.ask(method, path, body))[0] == 404


@pytest.mark.parametrize(
    ("method", "path", "body", "status"),
    [
        ("POST", "/tasks", "{", 422),
        ("POST", "/tasks", {"stops": []}, 422),
        ("POST", "/tasks", {"stops": [{"cell": 5}], "colour": "red"}, 422),
        ("POST", "/tasks", {"stops": [{"cell": 5, "cells": [6]}]}, 409),
        ("POST", "/tasks", {"stops": [{"cell": 9}]}, 409),
        ("POST", "/tasks", '{"stops": [{"cell": 5, "duration": NaN}]}', 422),
        ("GET", "/tasks/T1", None, 404),
        ("GET", "/tasks?state=sleeping", None, 422),
        ("GET", "/tasks?limit=many", None, 422),
        ("GET", "/tasks?limit=1.5", None, 422),
        ("GET", "/tasks?cursor=x", None, 422),
        ("GET", "/events?after=-1", None, 422),
        ("GET", "/nothing", None, 404),
        ("PUT", "/tasks", GO, 405),
        ("POST", "/robots/Robot9/pause", None, 404),
        ("PUT", "/chargers", {"chargers": [99]}, 409),
        ("DELETE", "/zones/z", None, 404),
        ("PUT", "/zones/z", {"kind": "icy", "cells": [1]}, 422),
        ("PUT", "/cells/9", {"blocked": True}, 409),
        ("PUT", "/cells/64", {"blocked": True}, 409),
        ("PUT", "/cells/-1", {"blocked": True}, 404),
        ("PUT", "/cells/8", {}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [64]}, 409),
        ("PUT", "/zones/z", {"kind": "blocked", "edges": [[0, 9]]}, 409),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [1], "until": 1.0}, 409),
        ("POST", "/tasks", {**GO, "deadline": -1e308}, 422),
        ("POST", "/tasks", {**GO, "deadline": 1e308}, 422),
        ("POST", "/tasks", {**GO, "earliest_start": -1.0}, 422),
        ("POST", "/tasks", {**GO, "earliest_start": 1e12}, 422),
        ("POST", "/tasks", {**GO, "payload": 1e308}, 422),
        ("POST", "/tasks", {**GO, "repeat": {"every": 60, "count": 10**30}}, 422),
        ("POST", "/tasks", {"stops": [{"cells": [10**30]}]}, 422),
        ("POST", "/tasks", {**GO, "return_cells": [-1]}, 422),
        ("PATCH", "/tasks/T1", {"deadline": 1e12}, 422),
        ("PATCH", "/robots/Robot1", {"profile": {"zone_cost": {"z": -2}}}, 422),
        ("PATCH", "/robots/Robot1", {"profile": {"zone_cost": {"z": 1e308}}}, 422),
        *(
            ("PATCH", "/robots/Robot1", {"profile": {name: value}}, 422)
            for name in ("payload", "speed", "capacity", "drive", "idle", "acting", "charging")
            for value in (-1.0, 1e308)
        ),
        ("PATCH", "/robots/Robot1", {"profile": {"speed": 1e-320}}, 422),
        ("PATCH", "/robots/Robot1", {"profile": {"capacity": 1e-320}}, 422),
        ("PUT", "/chargers", {"chargers": [2**31]}, 422),
        ("PUT", "/chargers", {"parking": [-1]}, 422),
        ("PUT", "/zones/z", {"kind": "limited", "cells": [1], "value": 3e9}, 409),
        ("PUT", "/zones/z", {"kind": "slow", "cells": [1], "value": 1e-320}, 409),
        ("PUT", "/zones/z", {"kind": "slow", "cells": [1], "value": 1e308}, 409),
        ("PUT", "/zones/z", {"kind": "cost", "cells": [1], "value": 1e308}, 409),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [2**31]}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "edges": [[0, -1]]}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [1], "until": 1e12}, 422),
        ("PUT", f"/cells/{2**31}", {"blocked": True}, 404),
    ],
)
async def test_bad_requests_say_why(
    client: ManagerClient, method: str, path: str, body: Any, status: int
) -> None:
    said, answer, _ = await client.ask(method, path, body)
    assert (said, set(answer)) == (status, {"error"})
    assert client.manager.book.number == 0


async def test_a_journal_with_numbers_beyond_the_limits_works(tmp_path: Path) -> None:
    """Earlier releases accepted any number; the manager has to begin with them, and answer."""
    journal = Journal(tmp_path / "j.sqlite")
    profile = RobotProfile(speed=1e-320, capacity=1e-320, drive=1e308, zone_cost={"mud": -2.0})
    stops = (Stop(Action.GO, (5,)),)
    orders = [
        Order(stops, deadline=-1e308, payload=0.0),
        Order(stops, deadline=1e308, earliest_start=1e308, every=60.0, occurrences=10**15),
        Order((Stop(Action.GO, (2**40, -3)),), payload=1e308),
    ]
    journal.put(
        [
            *(Task(number, order, "erp", "", 1.0, 1.0) for number, order in enumerate(orders, 1)),
            RobotEntry("Robot1", profile=profile),
            Zone("lift", "limited", (1, 2**40), 3e9, unsent=True),
            Zone("aisle", "slow", (2,), 1e-320, until=1e308),
            Zone("mud", "cost", (3,), 1e308),
            Zone("shut", "blocked", (4,), robots=("Robot1",)),
            Places((2**40, 6)),
            GoalEntry("Robot3", 2**40, unsent=True),
            BlockedCells((2**40, 7), (2**40,)),
        ]
    )
    journal.close()
    client = ManagerClient(tmp_path / "j.sqlite")
    facts, book = client.manager.facts, client.manager.book
    facts.is_current = True
    for name, cell in (("Robot1", 0), ("Robot2", 60)):
        facts.robots[name] = RobotFacts(name, "idle", cell=cell, battery=0.9)
    client.manager.planner_began(PlannerRun("1", "8 x 8"))
    for _ in range(2):
        await client.manager.step()
    assert (book.find("T1").state, book.places.chargers) == (TaskState.RUNNING, (6,))
    assert (book.zones["lift"].value, book.zones["aisle"].value) == (1e6, 0.01)
    assert book.blocked == BlockedCells((7,), ())
    for path in ("/tasks", "/robots", "/zones", "/chargers", "/robots/Robot1"):
        assert (await client.ask("GET", path))[0] == 200, path
    await client.manager.close()


@pytest.mark.parametrize(
    ("zone", "status", "text"),
    [
        ({"kind": "fast", "value": 1.0}, 422, "'slow', 'one_way', 'limited' or 'cost'"),
        ({"kind": "slow"}, 409, "needs a value"),
        ({"kind": "slow", "value": 0.0}, 409, "a speed of 0.01 .. 100 m/s"),
        ({"kind": "one_way", "value": 0.8}, 409, "a direction is 0, pi/2, pi or -pi/2"),
        ({"kind": "room", "value": 1.5}, 409, "whole number"),
        ({"kind": "room", "value": 0}, 409, "within 1 .. 1000000"),
        ({"kind": "cost", "value": -1}, 409, "a metre counts 1 .. 1000000"),
    ],
)
async def test_zones_that_cannot_be(client: ManagerClient, zone: Any, status: int, text: str) -> None:
    said, answer, _ = await client.ask("PUT", "/zones/z", {"cells": [3], **zone})
    assert (said, text in answer["error"]) == (status, True), answer


async def test_former_words_of_zones_are_understood(client: ManagerClient) -> None:
    body = {"kind": "room", "cells": [3], "value": 2}
    assert (await client.ask("PUT", "/zones/lift", body))[1]["kind"] == "limited"


async def test_a_task_is_given_to_another_robot(client: ManagerClient) -> None:
    for name, cell in (("Robot1", 4), ("Robot2", 60)):
        client.manager.facts.robots[name] = RobotFacts(name, "idle", cell=cell)
    await client.ask("POST", "/tasks", {"stops": [{"cell": 7}]})
    await client.manager.step()
    assert (await client.ask("GET", "/tasks/T1"))[1]["robot_assigned"] == "Robot1"
    status, task, _ = await client.ask("POST", "/tasks/T1/reassign")
    assert (status, task["state"], task["robot_assigned"]) == (200, "queued", "")
    await client.manager.step()
    assert (await client.ask("GET", "/tasks/T1"))[1]["robot_assigned"] == "Robot2"


async def test_zones_reach_the_planner(client: ManagerClient) -> None:
    """Also when it was away; a zone that only costs does not."""
    manager, planner = client.manager, client.planner
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    planner.refusal = "the planner does not answer"
    slow = {"kind": "slow", "cells": [3, 4], "value": 0.2, "until": manager.clock() + 1000}
    assert (await client.ask("PUT", "/zones/aisle", slow))[0] == 201
    assert (await client.ask("PUT", "/zones/dear", {"kind": "cost", "cells": [6], "value": 2.0}))[0] == 201
    planner.refusal = ""
    planner.calls.clear()
    await manager.step()
    assert planner.calls == [], "it was sent again at once"
    manager.clock._now += REFUSED_S  # type: ignore[attr-defined]  # the clock is moved on
    await manager.step()
    assert planner.calls == [("zone", "aisle", "slow")]
    manager.facts.zones["aisle"] = manager.book.zones["aisle"]
    manager.clock._now += 1000.0  # type: ignore[attr-defined]
    await manager.step()
    assert planner.calls[-1] == ("zone", "aisle", None)
    assert [zone["id"] for zone in (await client.ask("GET", "/zones"))[1]["zones"]] == ["dear"]


@pytest.mark.parametrize("zone", [{"kind": "blocked"}, {"kind": "cost", "value": 2.0}])
async def test_a_removed_zone_leaves_the_journal(client: ManagerClient, zone: dict[str, Any]) -> None:
    """Once the planner has confirmed it; what happened to it stays among the events."""
    manager, planner = client.manager, client.planner
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    await client.ask("PUT", "/zones/z", {**zone, "cells": [3]})
    if zone["kind"] == "blocked":
        manager.facts.zones["z"] = manager.book.zones["z"]
    await manager.step()
    assert [record for record in client.journal.load()[0] if isinstance(record, Zone)]
    planner.refusal = "the planner does not answer"
    assert (await client.ask("DELETE", "/zones/z"))[0] == 200
    kept = [record for record in client.journal.load()[0] if isinstance(record, Zone)]
    assert [record.is_removed for record in kept] == [True]
    manager.facts.zones.clear()
    planner.refusal = ""
    manager.clock._now += REFUSED_S  # type: ignore[attr-defined]  # the clock is moved on
    for _ in range(2):
        await manager.step()
    assert not [record for record in client.journal.load()[0] if isinstance(record, Zone)]
    events = (await client.ask("GET", "/events?id=z"))[1]["events"]
    assert [event["name"] for event in events] == ["zone", "zone removed"]


async def test_a_goal_that_ended_leaves_the_journal(client: ManagerClient) -> None:
    book, now = client.manager.book, client.manager.clock()
    for entry, count in ((GoalEntry("Robot1", 5), 1), (GoalEntry("Robot1"), 0)):
        book.emit(entry, "goal", now)
        await client.manager.commit()
        found = [record for record in client.journal.load()[0] if isinstance(record, GoalEntry)]
        assert len(found) == count


async def test_a_full_disk_refuses_and_recovers(client: ManagerClient) -> None:
    """Nothing is accepted that is not in the journal; the book is as the journal has it."""
    assert (await client.ask("POST", "/tasks", GO))[0] == 201
    pages = client.journal._db.execute("PRAGMA page_count").fetchone()[0]
    client.journal._db.execute(f"PRAGMA max_page_count = {pages}")
    big = {"stops": [{"cell": 5, "label": "x" * 200}] * 400}
    status, body, _ = await client.ask("POST", "/tasks", big)
    assert (status, "the disk is full" in body["error"]) == (507, True)
    assert len(client.manager.book.tasks) == 1
    assert (await client.ask("POST", "/tasks", GO))[0] == 507
    assert (await client.ask("GET", "/tasks/T1"))[0] == 200
    client.journal._db.execute("PRAGMA max_page_count = 100000")
    await client.manager.step()
    assert (await client.ask("POST", "/tasks", GO))[1]["id"] == "T2"


async def test_old_events_that_cannot_be_removed_stop_nothing(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full while events are removed, and another request waits for the journal."""
    begun, go_on = threading.Event(), threading.Event()

    def forget_events(_before: int) -> None:
        begun.set()
        go_on.wait(60)
        raise JournalError("the disk is full")

    monkeypatch.setattr(managers, "_TRIM_EVERY", 1)
    monkeypatch.setattr(client.journal, "forget_events", forget_events)
    assert (await client.ask("POST", "/tasks", GO))[0] == 201
    await asyncio.to_thread(begun.wait, 60)
    waiting = [asyncio.create_task(client.ask("POST", "/tasks", GO)) for _ in range(2)]
    await asyncio.sleep(0)
    go_on.set()
    async with asyncio.timeout(60):
        assert [(await each)[0] for each in waiting] == [201, 201]
        await client.manager.step()
    assert (client.manager.failure, len(client.manager.book.tasks)) == ("", 3)


async def test_an_event_that_cannot_be_written_is_rolled_back(client: ManagerClient) -> None:
    """A record without a form in the journal: waiting callers are told, and the next step recovers."""
    assert (await client.ask("POST", "/tasks", GO))[0] == 201
    book = client.manager.book
    book.emit(replace(book.find("T1"), revision=2**70), "wrong", 1.0)
    async with asyncio.timeout(60):
        with pytest.raises(JournalError, match="cannot be written"):
            await client.manager.commit()
        assert client.manager.book.find("T1").revision == 1
        await client.manager.step()
    assert (await client.ask("POST", "/tasks", GO))[1]["id"] == "T2"


async def test_a_journal_that_cannot_be_read_is_read_later(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither written nor read: what was not accepted must not come into the journal afterwards."""
    assert (await client.ask("POST", "/tasks", GO))[0] == 201

    def fail(*_given: object) -> None:
        raise JournalError("the disk is gone")

    with monkeypatch.context() as patch:
        patch.setattr(client.journal, "append", fail)
        patch.setattr(client.journal, "load", fail)
        assert (await client.ask("POST", "/tasks", GO))[0] == 507
        await client.manager.step()
    await client.manager.step()
    assert (client.manager.failure, list(client.manager.book.tasks)) == ("", [1])
    assert (await client.ask("POST", "/tasks", GO))[1]["id"] == "T2"
    events = (await client.ask("GET", "/events"))[1]["events"]
    assert [event["number"] for event in events] == list(range(1, len(events) + 1))


async def test_a_restarted_manager_knows_everything(tmp_path: Path) -> None:
    first = ManagerClient(tmp_path / "j.sqlite")
    await first.ask("POST", "/tasks", GO, key="order-1")
    await first.ask("PUT", "/zones/ice", {"kind": "slow", "cells": [3], "value": 0.2})
    facts = first.manager.facts
    facts.is_current = True
    first.manager.planner_began(PlannerRun("1", "8 x 8"))
    facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    facts.requested = frozenset({7})
    await first.ask("POST", "/robots/Robot1/pause", {"reason": "tea"})
    await first.manager.step()
    assert first.planner.calls == [
        *(("mode", "Robot1", "paused", "tea", "erp"), ("zone", "ice", "slow")),
    ]
    await first.manager.close()
    second = ManagerClient(tmp_path / "j.sqlite")
    status, body, _ = await second.ask("POST", "/tasks", GO, key="order-1")
    assert (status, body["id"]) == (200, "T1")
    assert (await second.ask("GET", "/zones/ice"))[1]["user"] == "erp"
    second.manager.facts.is_current = True
    second.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    second.manager.planner_began(PlannerRun("2", "8 x 8"))
    await second.manager.step()
    assert second.planner.calls == [
        *(("mode", "Robot1", "paused", "tea", "erp"), ("zone", "ice", "slow"), ("cell", 7, True)),
    ]
    await second.manager.close()


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


async def test_a_mode_that_the_planner_refuses_stays(client: ManagerClient) -> None:
    client.manager.facts.is_current = True
    client.manager.planner_began(PlannerRun("1", "8 x 8"))
    client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
    client.planner.refusal = "not now"
    status, body, _ = await client.ask("POST", "/robots/Robot1/take-out")
    assert (status, body["error"]) == (409, "not now")
    assert (await client.ask("GET", "/robots/Robot1"))[1]["mode"] == "automatic"


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


async def test_statistics_survive_a_restart(tmp_path: Path) -> None:
    """A robot had a task for a whole minute before the manager was started again."""
    now = 1000.0

    def manager(journal: Journal) -> FleetManager:
        log = logging.getLogger("manager")
        made = FleetManager(journal, Planner(), TaskRules(), log, clock=lambda: now)
        made.facts.grid, made.facts.is_live = GridMap(), True
        made.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
        return made

    first = manager(Journal(tmp_path / "j.sqlite"))
    first.book.create(Order((Stop(Action.GO, (5,)),)), now)
    await first.step()
    for _ in range(7):
        now += 10.0
        await first.step()
    await first.close()
    again = manager(Journal(tmp_path / "j.sqlite"))
    shown = again.statistics.show(now, 3600.0, again.facts, again.book)
    assert shown.utilization == pytest.approx(1.0)
    assert shown.tasks_open == 1
    await again.close()


async def test_a_blocked_cell_is_in_the_journal_first(client: ManagerClient) -> None:
    """The planner is told what the journal has; a cell that only sensors blocked is freed as well."""
    kept: list[tuple[int, ...]] = []
    planner, block = client.planner, client.planner.block_cell

    async def block_cell(cell: int, *, blocked: bool) -> str:
        records, _ = client.journal.load()
        kept.extend(record.unsent for record in records if isinstance(record, BlockedCells))
        return await block(cell, blocked=blocked)

    planner.block_cell = block_cell  # type: ignore[method-assign]  # looks into the journal first
    status, said, _ = await client.ask("PUT", "/cells/12", {"blocked": True})
    assert (status, said, kept) == (200, {"message": "cell 12 is blocked"}, [(12,)])
    event = (await client.ask("GET", "/events"))[1]["events"][-1]
    assert (event["kind"], event["name"], event["user"]) == ("cells", "blocked", "erp")
    assert (await client.ask("PUT", "/cells/20", {"blocked": False}))[0] == 200
    assert planner.calls == [("cell", 12, True), ("cell", 20, False)]
    assert (await client.ask("PUT", "/cells/12", {"blocked": True}, role="viewer"))[0] == 403


async def test_a_cell_that_the_planner_refuses_stays(client: ManagerClient) -> None:
    for refusal, expected in (("remove the zone", 409), ("the planner does not answer: gone", 503)):
        client.planner.refusal = refusal
        status, said, _ = await client.ask("PUT", "/cells/12", {"blocked": True})
        assert (status, said, client.manager.book.blocked.cells) == (expected, {"error": refusal}, ())
    client.manager.facts.is_live = False
    assert (await client.ask("PUT", "/cells/12", {"blocked": True}))[0] == 200
    assert client.manager.book.blocked == BlockedCells((12,), (12,))


async def test_a_robot_shows_what_it_carries(client: ManagerClient) -> None:
    stops = [
        {"cell": cell, "action": "pick", "label": label} for cell, label in ((1, "A"), (2, ""), (3, "C"))
    ]
    stops += [{"cell": cell, "action": "deliver", "label": label} for cell, label in ((4, "C"), (5, ""))]
    await client.ask("POST", "/tasks", {"stops": [*stops, {"cell": 6, "action": "deliver"}], "name": "box"})
    book, names = client.manager.book, list[list[str]]()
    book.put_record(RobotEntry("Robot1"))
    for position, loads in enumerate((0, 1, 2, 3, 2, 1, 0)):
        task = replace(
            book.find("T1"), robot="Robot1", position=position, loads=loads, state=TaskState.RUNNING
        )
        book.put_record(task)
        names.append((await client.ask("GET", "/robots"))[1]["robots"][0]["loads"] if loads else [])
        assert names[-1] == list(carried(task))
    assert names == [[], ["A"], ["A", "box"], ["A", "box", "C"], ["A", "box"], ["box"], []]
    assert carried(replace(book.find("T1"), position=0, loads=1)) == ("box",)


async def test_a_task_number_is_given_once_over_restarts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The newest tasks are cancelled and forgotten before the oldest one; then the manager is restarted."""
    client = ManagerClient(tmp_path / "j.sqlite")
    monkeypatch.setattr(managers, "KEEP_ENDED", 0)
    for _ in range(3):
        await client.ask("POST", "/tasks", GO)
    for task in ("T2", "T3"):
        await client.ask("DELETE", f"/tasks/{task}")
    await client.ask("POST", "/tasks/T1/hold", {})
    assert list(client.manager.book.tasks) == [1]
    await client.manager.close()
    again = ManagerClient(tmp_path / "j.sqlite")
    assert (await again.ask("POST", "/tasks", GO))[1]["id"] == "T4"
    await again.manager.close()
    _forget_counter(tmp_path / "j.sqlite")
    former = ManagerClient(tmp_path / "j.sqlite")
    assert (await former.ask("POST", "/tasks", GO))[1]["id"] == "T5"
    await former.manager.close()


def _forget_counter(path: Path) -> None:
    """Make a journal as the release before wrote it: its records have one task, its events name all."""
    db = sqlite3.connect(path)
    db.execute("DELETE FROM meta WHERE name = 'last task'")
    db.execute("DELETE FROM records WHERE id = 'T4'")
    db.commit()
    db.close()


async def _between_occurrences(client: ManagerClient, **fields: Any) -> Task:
    """Create a recurring task, and let its first occurrence be done a second later."""
    await client.ask("POST", "/tasks", {**GO, "repeat": {"every": 3600, "count": 5}, **fields})
    book = client.manager.book
    task = book.tasks[1]
    book.emit(replace(task, state=TaskState.DONE, position=1, revision=2), "finished", client.manager.clock())
    await client.manager.commit()
    return book.tasks[1]


async def test_a_recurring_task_ends_between_occurrences(client: ManagerClient) -> None:
    """It stays done, and no occurrence follows; a second request says the same."""
    task = await _between_occurrences(client)
    (listed,) = (await client.ask("GET", "/tasks?state=recurring"))[1]["tasks"]
    assert (listed["id"], listed["state"], listed["recurs_at"]) == ("T1", "done", task.recurs_at)
    assert (await client.ask("DELETE", "/tasks/T1", revision='"1"'))[0] == 412
    for _ in range(2):
        status, body, _ = await client.ask("DELETE", "/tasks/T1")
        assert (status, body["state"], body["recurs_at"]) == (200, "done", None)
    assert task.recurs_at is not None
    client.manager.dispatcher.update(task.recurs_at + 1, client.manager.facts)
    assert list(client.manager.book.tasks) == [1]
    assert (await client.ask("GET", "/tasks?state=recurring"))[1]["tasks"] == []


@pytest.mark.parametrize(
    ("change", "due", "expected"),
    [
        ({"stops": [{"cell": 7}], "priority": 3}, 3600.0, {"priority": 3, "occurrence": 2}),
        ({"repeat": {"every": 60}}, 60.0, {"occurrence": 2}),
        ({"name": "round"}, 3600.0, {"deadline": 4000.0}),
        ({"deadline": 4600.0}, 3600.0, {"deadline": 4600.0}),
        ({"earliest_start": 9000.0}, 9000.0, {"deadline": 9400.0}),
    ],
)
async def test_a_change_between_occurrences_counts_for_the_next(
    client: ManagerClient, change: dict[str, Any], due: float, expected: dict[str, Any]
) -> None:
    """Times are seconds after the start of the first occurrence, which has a deadline 400 s later."""
    start = client.manager.clock()
    await _between_occurrences(client, earliest_start=start, deadline=start + 400)

    def shifted(fields: dict[str, Any]) -> dict[str, Any]:
        times = ("deadline", "earliest_start")
        return {name: value + start if name in times else value for name, value in fields.items()}

    status, body, _ = await client.ask("PATCH", "/tasks/T1", shifted(change))
    assert (status, body["state"]) == (200, "done")
    assert body["recurs_at"] == pytest.approx(start + due, abs=30.0)
    assert body["earliest_start"] == body["recurs_at"]
    assert (await client.ask("PATCH", "/tasks/T1", shifted(change)))[1] == body
    client.manager.dispatcher.update(body["recurs_at"] + 1, client.manager.facts)
    following = (await client.ask("GET", "/tasks/T2"))[1]
    assert following["stops"] == body["stops"]
    assert following["earliest_start"] == body["recurs_at"]
    for name, value in shifted(expected).items():
        assert following[name] == pytest.approx(value, abs=1e-3)


@pytest.mark.parametrize("change", [{"repeat": None}, {"repeat": {"every": 3600, "count": 1}}])
async def test_a_change_between_occurrences_ends_a_recurrence(
    client: ManagerClient, change: dict[str, Any]
) -> None:
    await _between_occurrences(client)
    assert (await client.ask("PATCH", "/tasks/T1", change))[1]["recurs_at"] is None
    assert (await client.ask("PATCH", "/tasks/T1", {"priority": 3}))[0] == 409


@pytest.mark.parametrize(
    "change", [{"stops": [{"cell": 9}]}, {"deadline": 1.0}, {"after": ["T1"]}, {"repeat": {"every": 0.5}}]
)
async def test_an_impossible_change_between_occurrences_is_refused(
    client: ManagerClient, change: dict[str, Any]
) -> None:
    before = await _between_occurrences(client)
    assert (await client.ask("PATCH", "/tasks/T1", change))[0] in (409, 422)
    assert client.manager.book.tasks[1] == before


async def test_a_known_key_gives_its_task_also_with_too_many_open_tasks(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first answer was lost: 429 would say that the task was not accepted."""
    monkeypatch.setattr(task_routes, "MOST_OPEN", 2)
    assert (await client.ask("POST", "/tasks", GO, key="order-1"))[0] == 201
    assert (await client.ask("POST", "/tasks", GO, key="order-2"))[0] == 201
    status, body, _ = await client.ask("POST", "/tasks", GO, key="order-3")
    assert (status, "2 open tasks" in body["error"]) == (429, True)
    status, body, _ = await client.ask("POST", "/tasks", GO, key="order-1")
    assert (status, body["id"]) == (200, "T1")
    await client.ask("DELETE", "/tasks/T2")
    assert (await client.ask("POST", "/tasks", GO, key="order-3"))[0] == 201


@pytest.mark.parametrize("order", ["DESC", "newest", ""])
async def test_an_unknown_order_of_tasks_is_refused(client: ManagerClient, order: str) -> None:
    """It was taken for ascending."""
    status, body, _ = await client.ask("GET", f"/tasks?order={order}")
    assert (status, body["error"]) == (422, f"order must be asc or desc, not {order!r}")


async def test_statistics_say_how_far_back_tasks_are_known(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Ten tasks an hour are done, and the newest three are kept: as if a day had three tasks."""
    now = 1e6
    client.manager.clock = lambda: now
    assert (await client.ask("GET", "/statistics?seconds=86400"))[1]["seconds"] == 86400
    monkeypatch.setattr(managers, "KEEP_ENDED", 3)
    for _ in range(10):
        now += 360.0
        _, task, _ = await client.ask("POST", "/tasks", GO)
        ended = client.manager.book.find(task["id"])
        client.manager.book.emit(replace(ended, state=TaskState.DONE, changed_at=now), "finished", now)
        await client.manager.commit()
    figures = (await client.ask("GET", "/statistics?seconds=86400"))[1]
    assert (figures["tasks_done"], figures["seconds"]) == (2, 720.0)
    assert figures["tasks_per_hour"] == pytest.approx(10.0)
    assert (await client.ask("GET", "/statistics?seconds=600"))[1]["seconds"] == 600
    await client.manager.close()
    following = ManagerClient(tmp_path / "j.sqlite")
    client.manager = following.manager
    following.manager.clock = lambda: now
    assert (await following.ask("GET", "/statistics?seconds=86400"))[1] == figures


async def test_the_key_of_a_recurring_task_lasts_as_long_as_it_recurs(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The request that is sent again when its first occurrence is forgotten makes no second series."""
    monkeypatch.setattr(managers, "KEEP_ENDED", 0)
    task = await _between_occurrences(client, key="round-1")
    assert task.recurs_at is not None
    client.manager.dispatcher.update(task.recurs_at + 1, client.manager.facts)
    await client.ask("POST", "/tasks", {"stops": [{"cell": 3}]})
    await client.ask("POST", "/tasks", {"stops": [{"cell": 4}]})
    assert (await client.ask("GET", "/tasks/T1"))[0] == 404, "its first occurrence was not forgotten"
    again = {**GO, "repeat": {"every": 3600, "count": 5}, "key": "round-1"}
    status, body, _ = await client.ask("POST", "/tasks", again)
    assert (status, body["id"], body["occurrence"]) == (200, "T2", 2)
    assert (await client.ask("POST", "/tasks", {**again, "priority": 1}))[0] == 409
    await client.manager.close()
    following = ManagerClient(tmp_path / "j.sqlite")
    client.manager, client.journal = following.manager, following.journal
    assert (await following.ask("POST", "/tasks", again))[1]["id"] == "T2"
    await following.ask("DELETE", "/tasks/T2")
    await following.ask("POST", "/tasks", GO)
    await following.ask("POST", "/tasks", GO)
    assert (await following.ask("POST", "/tasks", again))[0] == 201


async def test_a_task_before_another_one_is_not_forgotten(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was cancelled: the one that is held until then must not begin as if it had been done."""
    monkeypatch.setattr(managers, "KEEP_ENDED", 0)
    await client.ask("POST", "/tasks", GO)
    await client.ask("POST", "/tasks", {**GO, "after": ["T1"]})
    await client.ask("POST", "/tasks/T2/hold", {})
    await client.ask("DELETE", "/tasks/T1")
    await client.ask("POST", "/tasks/T2/resume", {})
    client.manager.dispatcher.update(client.manager.clock(), client.manager.facts)
    assert (await client.ask("GET", "/tasks/T2"))[1]["state"] == "failed"
    await client.ask("POST", "/tasks", GO)
    await client.ask("POST", "/tasks/T3/hold", {})
    assert list(client.manager.book.tasks) == [3]
