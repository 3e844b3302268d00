"""Pages are told when a fleet manager comes and goes, once each time."""

from __future__ import annotations

import asyncio

import pytest

from rce_fleet.station.manager_watch import ManagerWatch
from rce_fleet.station.planner_client import PlannerUnavailableError


async def test_pages_are_told_of_changes_only() -> None:
    answers = [False, False, True, True, False]
    told: list[bool] = []

    async def ask() -> None:
        if not answers.pop(0):
            raise PlannerUnavailableError("away")

    watch = ManagerWatch(ask)
    watch.on_change = told.append
    while answers:
        await watch.look()
    assert told == [False, True, False]


async def test_a_request_waits_until_a_manager_was_asked() -> None:
    """The first answer decides, not that the planner was not connected before."""
    connected, asked = False, asyncio.Event()

    async def ask() -> None:
        if not connected:
            raise PlannerUnavailableError("not connected yet")
        await asked.wait()

    watch = ManagerWatch(ask, lambda: connected)
    await watch.look()
    await watch.looked()
    connected = True
    waiting = asyncio.create_task(watch.looked())
    look = asyncio.create_task(watch.look())
    await asyncio.sleep(0.05)
    assert not waiting.done()
    asked.set()
    await asyncio.gather(look, waiting)
    assert watch.was_here


async def test_a_request_waits_for_a_manager_that_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_fleet.station.manager_watch.COMES_WAIT_S", 0.05)
    begun = False

    async def ask() -> None:
        if not begun:
            raise PlannerUnavailableError("away")

    watch = ManagerWatch(ask)
    await watch.look()
    assert not await watch.comes()
    begun = True
    await watch.look()
    assert await watch.comes()


async def test_a_manager_that_never_comes_is_not_awaited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_fleet.station.manager_watch.START_S", 0.0)
    watch = ManagerWatch(asyncio.Event().wait)
    assert await watch.comes()
    assert not watch.was_here
