"""Clients that ask for a stream of events, or for the history, and then take nothing: they keep no place."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest
from aiohttp import ClientSession, web
from aiohttp.test_utils import TestServer
from support.station_access import OpenAccess, name_user

from rce.web import writing
from rce_fleet.station import event_streams
from rce_fleet.station.event_streams import EventStreams
from rce_fleet.station.events import EventBatch, EventFeed

LARGE = "x" * 20_000


async def ask(after: int, limit: int) -> EventBatch:
    """A journal with more than fits into the buffers of a connection."""
    numbers = range(after + 1, 10_001)[:limit]
    return EventBatch([{"number": number, "text": LARGE} for number in numbers], "aa", 10_000)


async def test_a_stream_whose_client_takes_nothing_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a program that hangs, or of a console that was stopped by Ctrl-Z."""
    monkeypatch.setattr(writing, "WRITE_S", 0.5)
    streams = EventStreams(cast("Any", None), EventFeed(ask), cast("Any", OpenAccess(streams=1)))
    app = web.Application(middlewares=[name_user])
    app.router.add_get("/events", streams.events)
    headers = {"Accept": event_streams.EVENT_STREAM}
    async with TestServer(app) as server, ClientSession() as session, asyncio.timeout(60):
        # A reader that is not asked takes no more than its limit.
        reader, writer = await asyncio.open_connection(server.host, server.port, limit=1024)
        writer.write(b"GET /events?after=0 HTTP/1.1\r\nHost: a\r\nAccept: text/event-stream\r\n\r\n")
        assert await reader.readline() == b"HTTP/1.1 200 OK\r\n"
        while True:
            async with session.get(server.make_url("/events"), headers=headers) as reply:
                if reply.status == 200:
                    break
                assert reply.status == 429
            await asyncio.sleep(0.05)
        writer.close()
