"""A webhook whose events are numbered anew: its receiver is told, until it has taken it."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

from aiohttp import web
from aiohttp.test_utils import TestServer

from rce.aio.backoff import Backoff
from rce_fleet.api.webhooks import WebhookRequest
from rce_fleet.station.events import EventBatch, EventFeed
from rce_fleet.station.webhook_sender import WebhookSender
from rce_fleet.station.webhook_store import WebhookStore


class Manager:
    """A journal that can be lost."""

    def __init__(self) -> None:
        self.journal, self.count = "aa", 3

    async def ask(self, after: int, limit: int) -> EventBatch:
        numbers = range(after + 1, self.count + 1)[:limit]
        return EventBatch(
            [{"number": number, "kind": "task"} for number in numbers], self.journal, self.count
        )


async def test_a_receiver_is_told_of_a_lost_journal() -> None:
    manager, said = Manager(), asyncio.Queue[dict[str, Any]]()
    refusals = [False, True, False, False]

    async def take(request: web.Request) -> web.Response:
        said.put_nowait(await request.json())
        return web.Response(status=500 if refusals.pop(0) else 200)

    app = web.Application()
    app.router.add_post("/", take)
    feed, store = EventFeed(manager.ask), WebhookStore(None)
    sender = WebhookSender(store, feed, retry=Backoff(first=0.01, longest=0.02))
    async with TestServer(app) as server, asyncio.timeout(60):
        hook = store.add(WebhookRequest(url=str(server.make_url("/")), allow_private=True), "anna", 1, "aa")
        running = asyncio.create_task(sender.run())
        first = await said.get()
        assert (first["journal"], [event["number"] for event in first["events"]]) == ("aa", [2, 3])
        manager.journal, manager.count = "bb", 2
        feed.take(json.dumps({"number": 1, "kind": "task", "journal": "bb"}))
        for _ in range(2):
            gap = await said.get()
            assert (gap["gap"], gap["journal"], gap["events"]) == (True, "bb", [])
        anew = await said.get()
        assert ("gap" in anew, anew["journal"], anew["events"][0]["number"]) == (False, "bb", 1)
        while hook.position != 1:
            await asyncio.sleep(0.01)
        running.cancel()
        await asyncio.wait([running])
    assert hook.journal == "bb"


async def test_a_receiver_behind_more_than_is_kept_is_told() -> None:
    """The events that it lacks are gone; without a word it would take the rest for all."""

    class Short(Manager):
        async def ask(self, after: int, limit: int) -> EventBatch:
            return await super().ask(max(after, self.count - 2), limit)

    manager, said = Short(), asyncio.Queue[dict[str, Any]]()
    manager.count = 9
    refusals = [True, False, False]

    async def take(request: web.Request) -> web.Response:
        said.put_nowait(await request.json())
        return web.Response(status=500 if refusals.pop(0) else 200)

    app = web.Application()
    app.router.add_post("/", take)
    store = WebhookStore(None)
    sender = WebhookSender(store, EventFeed(manager.ask), retry=Backoff(first=0.01, longest=0.02))
    async with TestServer(app) as server, asyncio.timeout(60):
        hook = store.add(WebhookRequest(url=str(server.make_url("/")), allow_private=True), "anna", 3, "aa")
        running = asyncio.create_task(sender.run())
        for _ in range(2):
            gap = await said.get()
            assert (gap["gap"], gap["journal"], gap["from"], gap["to"]) == (True, "aa", 4, 7)
        after = await said.get()
        assert ("gap" in after, [event["number"] for event in after["events"]]) == (False, [8, 9])
        while hook.position != 9:
            await asyncio.sleep(0.01)
        running.cancel()
        await asyncio.wait([running])


async def test_events_that_a_receiver_does_not_want_are_done(tmp_path: Path) -> None:
    """A station that is started again does not begin with them: the manager has forgotten most by then."""

    class Growing(Manager):
        """A journal of tasks that keeps the newest events only; the last one may be of a zone."""

        kept = 3000
        has_zone = False

        async def ask(self, after: int, limit: int) -> EventBatch:
            found = await super().ask(max(after, self.count - self.kept), limit)
            if self.has_zone and found.events and found.events[-1]["number"] == self.count:
                found.events[-1]["kind"] = "zone"
            return found

    manager, said = Growing(), asyncio.Queue[dict[str, Any]]()
    manager.count = 2900

    async def take(request: web.Request) -> web.Response:
        said.put_nowait(await request.json())
        return web.Response()

    app = web.Application()
    app.router.add_post("/", take)
    file = tmp_path / "webhooks.json"
    async with TestServer(app) as server, asyncio.timeout(60):
        wanted = WebhookRequest(url=str(server.make_url("/")), allow_private=True, kinds=["zone"])
        store = WebhookStore(file)
        hook = store.add(wanted, "anna", 0, "aa")
        store.save()
        running = asyncio.create_task(WebhookSender(store, EventFeed(manager.ask)).run())
        while hook.position != manager.count:
            await asyncio.sleep(0.01)
        running.cancel()
        await asyncio.wait([running])

        manager.count, manager.has_zone = 4400, True
        again = WebhookStore(file)
        again.load()
        running = asyncio.create_task(WebhookSender(again, EventFeed(manager.ask)).run())
        first = await said.get()
        running.cancel()
        await asyncio.wait([running])
    assert ("gap" in first, [event["number"] for event in first["events"]]) == (False, [4400])
