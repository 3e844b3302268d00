"""The fleet manager and its journal: a full disk, records of earlier releases, restarts, old tasks."""

from __future__ import annotations

import asyncio
import logging
import sqlite3
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from support.fleet_manager import GO, ManagerClient, Planner

from rce_fleet.exceptions import JournalError
from rce_fleet.journal.journal import Journal
from rce_fleet.manager import manager as managers
from rce_fleet.manager.manager import FleetManager
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.facts import RobotFacts
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


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("PATCH", "/robots/Robot1", {"profile": {"payload": 7.0}}),
        ("POST", "/robots/Robot1/pause", {}),
        ("PUT", "/cells/12", {"blocked": True}),
    ],
)
async def test_a_repeated_request_waits_for_the_journal_too(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch, method: str, path: str, body: object
) -> None:
    """It was answered before the first one was written, which then failed."""
    begun, go_on = threading.Event(), threading.Event()
    client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)

    def append(*_given: object) -> None:
        begun.set()
        go_on.wait(60)
        raise JournalError("the disk is full")

    monkeypatch.setattr(client.journal, "append", append)
    async with asyncio.timeout(60):
        first = asyncio.create_task(client.ask(method, path, body))
        await asyncio.to_thread(begun.wait, 60)
        second = asyncio.create_task(client.ask(method, path, body))
        await asyncio.sleep(0)
        go_on.set()
        assert [(await each)[0] for each in (first, second)] == [507, 507]
    assert (client.manager.book.number, client.planner.calls) == (0, [])


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


@pytest.mark.slow
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
        assert (await client.ask("GET", "/tasks/T1"))[0] == 507
    await client.manager.step()
    assert (await client.ask("GET", "/tasks/T1"))[0] == 200
    assert (client.manager.failure, list(client.manager.book.tasks)) == ("", [1])
    assert (await client.ask("POST", "/tasks", GO))[1]["id"] == "T2"
    events = (await client.ask("GET", "/events"))[1]["events"]
    assert [event["number"] for event in events] == list(range(1, len(events) + 1))


async def test_a_restarted_manager_knows_everything(tmp_path: Path) -> None:
    first = ManagerClient(tmp_path / "j.sqlite")
    facts = first.manager.facts
    facts.is_live = False
    await first.ask("POST", "/tasks", GO, key="order-1")
    await first.ask("PUT", "/zones/ice", {"kind": "slow", "cells": [3], "value": 0.2})
    facts.is_live = facts.is_current = True
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
