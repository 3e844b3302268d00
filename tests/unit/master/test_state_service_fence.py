"""What becomes of commands when the leadership of their master ends."""

from __future__ import annotations

import asyncio

import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request
from support.master_cloud import FragileStore

from rce_master.exceptions import FencedError, StoreError
from rce_master.http.server import settling
from rce_master.leadership.core import Fence, LeadershipCore, LeaseSettings
from rce_master.state import commands
from rce_master.state.user_records import User, UserRole
from rce_master.state_service import StateService


class Leading:
    """A state service of a master that leads by a clock of the test."""

    def __init__(self) -> None:
        self.now = 100.0
        core = LeadershipCore(LeaseSettings(ttl=3.0))
        core.granted(self.now, 3.0)
        core.elected(0, self.now)
        self.fence = Fence(core, lambda: self.now, "one:9000")
        self.store = FragileStore()

    async def open(self) -> StateService:
        return await StateService.open(self.store, fence=self.fence)


def new_user(name: str) -> commands.AddUser:
    return commands.AddUser(user=User(name=name, role=UserRole.USER, password="x", created=0.0))


async def test_nothing_is_written_or_answered_after_the_deadline() -> None:
    leading = Leading()
    service = await leading.open()
    running = asyncio.create_task(service.run())
    await service.submit(new_user("anna"))
    leading.now += 3.0
    waiting = [asyncio.create_task(service.submit(new_user(name))) for name in ("bert", "carl")]
    for task in waiting:
        with pytest.raises(FencedError):
            await task
    with pytest.raises(FencedError):
        await running
    with pytest.raises(FencedError):
        await service.submit(new_user("dora"))
    assert list((await leading.store.load())["users"]) == ["anna"]


async def test_a_save_that_outlives_the_lease_is_not_answered() -> None:
    leading = Leading()
    service = await leading.open()
    running = asyncio.create_task(service.run())
    heard: list[object] = []
    service.listeners.append(heard.append)
    leading.store.free.clear()
    adding = asyncio.create_task(service.submit(new_user("anna")))
    later = asyncio.create_task(service.submit(new_user("bert")))
    while leading.store.free.is_set() or service.tables.users.get("anna") is None:
        await asyncio.sleep(0)
    leading.now += 3.0
    leading.store.free.set()
    for task in (adding, later, running):
        with pytest.raises(FencedError):
            await task
    assert heard == []


async def test_readers_wait_until_what_they_see_is_stored() -> None:
    leading = Leading()
    service = await leading.open()
    running = asyncio.create_task(service.run())
    await service.settled()
    leading.store.free.clear()
    adding = asyncio.create_task(service.submit(new_user("anna")))
    while service.tables.users.get("anna") is None:
        await asyncio.sleep(0)
    reading = asyncio.create_task(service.settled())
    await asyncio.sleep(0)
    assert not reading.done()
    leading.store.free.set()
    await reading
    await adding
    assert service.reverts == 0
    running.cancel()


async def test_readers_learn_that_what_they_saw_was_taken_back() -> None:
    leading = Leading()
    service = await leading.open()
    running = asyncio.create_task(service.run())
    answers = []

    async def handler(_: web.Request) -> web.StreamResponse:
        answers.append(sorted(user.name for user in service.tables.users))
        return web.Response(text=",".join(answers[-1]))

    read = settling(service, leading.fence)
    leading.store.free.clear()
    leading.store.broken = True
    adding = asyncio.create_task(service.submit(new_user("anna")))
    while service.tables.users.get("anna") is None:
        await asyncio.sleep(0)
    reading = asyncio.create_task(read(make_mocked_request("GET", "/api/v1/users"), handler))
    await asyncio.sleep(0)
    leading.store.free.set()
    with pytest.raises(StoreError):
        await adding
    assert (await reading).text == ""
    assert answers == [["anna"], []]
    running.cancel()


async def test_readers_are_refused_when_the_lead_is_lost_meanwhile() -> None:
    leading = Leading()
    service = await leading.open()
    running = asyncio.create_task(service.run())
    leading.store.free.clear()
    adding = asyncio.create_task(service.submit(new_user("anna")))
    while service.tables.users.get("anna") is None:
        await asyncio.sleep(0)
    reading = asyncio.create_task(service.settled())
    leading.now += 3.0
    leading.store.free.set()
    for task in (reading, adding, running):
        with pytest.raises(FencedError):
            await task
