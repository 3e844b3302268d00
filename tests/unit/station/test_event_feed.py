"""The station's events: kept ones, gaps, lost messages and numbers that begin anew."""

from __future__ import annotations

import asyncio
import json
from typing import Any, cast

import pytest
from aiohttp import ClientSession, web
from aiohttp.test_utils import TestServer
from support.station_access import OpenAccess, name_user

from rce_fleet.exceptions import EventsForgottenError, EventsRestartedError
from rce_fleet.station import events as module
from rce_fleet.station.event_streams import COLUMNS, EventStreams, csv_rows
from rce_fleet.station.events import EventBatch, EventCursor, EventFeed
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.station.server import _problems


class Journal:
    """All events; counts how often it is asked."""

    def __init__(self, count: int = 0, journal: str = "aa") -> None:
        self.events: list[dict[str, Any]] = []
        self.id = journal
        self.asked = 0
        self.grow(count)

    def grow(self, count: int, time: float = 0.0) -> None:
        for _ in range(count):
            number = len(self.events) + 1
            self.events.append({"number": number, "time": time + number, "kind": "task", "text": "x"})

    async def ask(self, after: int, limit: int) -> EventBatch:
        self.asked += 1
        return EventBatch(self.events[after : after + limit], self.id, len(self.events))


def numbers(events: Any) -> list[int]:
    return [event["number"] for event in events]


def tell(feed: EventFeed, journal: Journal, *wanted: int) -> None:
    for number in wanted:
        feed.take(json.dumps({**journal.events[number - 1], "journal": journal.id}))


async def test_kept_events_cost_the_manager_nothing() -> None:
    journal = Journal(10)
    feed = EventFeed(journal.ask)
    tell(feed, journal, 4, 5, 6)
    assert numbers(await feed.after(3)) == [4, 5, 6]
    assert numbers(await feed.after(6)) == []
    assert journal.asked == 0
    assert numbers(await feed.after(1)) == list(range(2, 11))


async def test_a_gap_is_filled_by_a_request() -> None:
    journal = Journal(9)
    feed = EventFeed(journal.ask)
    cursor = EventCursor(feed, 2)
    tell(feed, journal, 3, 4)
    assert numbers(await cursor.next()) == [3, 4]
    tell(feed, journal, 8, 9)
    assert numbers(await cursor.next()) == [5, 6, 7, 8, 9]


async def test_a_new_client_gets_events_from_now_on() -> None:
    journal = Journal(5)
    feed = EventFeed(journal.ask)
    first = EventCursor(feed, None)
    tell(feed, journal, 4)
    assert numbers(await first.next()) == [4]
    second = EventCursor(feed, None)
    tell(feed, journal, 5)
    assert numbers(await second.next()) == [5]


async def test_a_new_client_gets_all_of_the_first_burst() -> None:
    """Several come together, before the client has its turn."""
    journal = Journal(2)
    feed = EventFeed(journal.ask)
    cursor = EventCursor(feed, None)
    assert (numbers(await cursor.next()), cursor.number) == ([], 2)
    waiting = asyncio.create_task(cursor.next())
    await asyncio.sleep(0)
    journal.grow(3)
    tell(feed, journal, 3, 4, 5)
    assert numbers(await waiting) == [3, 4, 5]


async def test_a_first_event_whose_message_is_lost_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RECHECK_S", 0.01)
    journal = Journal(2)
    cursor = EventCursor(EventFeed(journal.ask), None)
    assert numbers(await cursor.next()) == []
    journal.grow(1)
    assert numbers(await cursor.next()) == [3]


async def test_a_stream_of_a_quiet_fleet_resumes_where_it_broke() -> None:
    """The station has seen no event yet: an event between two connections was lost without a word."""
    journal = Journal(5)
    app = web.Application(middlewares=[name_user])
    streams = EventStreams(cast("Any", None), EventFeed(journal.ask), cast("Any", OpenAccess()))
    app.router.add_get("/events", streams.events)
    async with TestServer(app) as server, ClientSession() as session, asyncio.timeout(60):

        async def follow(last: dict[str, str]) -> str:
            headers = {"Accept": "text/event-stream", **last}
            async with session.get(server.make_url("/events"), headers=headers) as reply:
                await reply.content.readuntil(b"\n\n")
                return (await reply.content.readuntil(b"\n\n")).decode()

        assert (await follow({})).startswith("id: aa:5\n")
        journal.grow(1)
        assert (await follow({"Last-Event-ID": "aa:5"})).startswith("id: aa:6\ndata: ")


async def test_a_stream_begins_with_the_id_of_the_newest_event() -> None:
    """So that a client that loses it before the first event misses none."""
    journal = Journal(5)
    feed = EventFeed(journal.ask)
    tell(feed, journal, 4, 5)
    app = web.Application(middlewares=[name_user])
    streams = EventStreams(cast("Any", None), feed, cast("Any", OpenAccess()))
    app.router.add_get("/events", streams.events)
    async with TestServer(app) as server, ClientSession() as session:
        asked = session.get(server.make_url("/events"), headers={"Accept": "text/event-stream"})
        async with asyncio.timeout(60), asked as answer:
            begin = await answer.content.readuntil(b"\n\n")
    assert begin == b"retry: 2000\nid: aa:5\n\n"


async def test_a_lost_message_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RECHECK_S", 0.01)
    journal = Journal(5)
    feed = EventFeed(journal.ask)
    tell(feed, journal, 4)
    cursor = EventCursor(feed, 4)
    feed.take("not json")
    assert numbers(await cursor.next()) == [5]
    assert numbers(await cursor.next()) == []


async def test_numbers_that_begin_anew_are_told() -> None:
    """A manager without a volume lost its journal with its container."""
    journal = Journal(50)
    feed = EventFeed(journal.ask)
    told: list[str] = []
    feed.on_restart = lambda: told.append(feed.journal)
    tell(feed, journal, *range(40, 51))
    cursor = EventCursor(feed, 50)
    tell(feed, journal, 45)  # told twice
    assert (feed.epoch, told) == (0, [])
    journal.events, journal.id = Journal(3).events, "bb"
    tell(feed, journal, 1, 2)
    assert (feed.epoch, feed.newest, told) == (1, 2, ["bb"])
    with pytest.raises(EventsRestartedError):
        await cursor.next()
    assert numbers(await cursor.next()) == [1, 2]
    assert cursor.journal == "bb"


@pytest.mark.parametrize(
    ("number", "journal"), [(40, "aa"), (60, "aa"), (60, "")], ids=["passed", "ahead", "ahead, unknown"]
)
async def test_a_client_of_a_lost_journal_is_told(number: int, journal: str) -> None:
    """The station was away when the journal was lost; the new one may have passed the client's number."""
    feed = EventFeed(Journal(50, "bb").ask)
    cursor = EventCursor(feed, number, journal)
    with pytest.raises(EventsRestartedError) as caught:
        await cursor.next()
    assert caught.value.journal == "bb"
    assert numbers(await cursor.next()) == list(range(1, 51))


async def test_an_older_copy_of_the_journal_is_noticed() -> None:
    journal = Journal(50)
    feed = EventFeed(journal.ask)
    tell(feed, journal, 50)
    cursor = EventCursor(feed, 45)
    journal.events = journal.events[:30]
    with pytest.raises(EventsRestartedError):
        await cursor.next()
    assert numbers(await cursor.next()) == list(range(1, 31))


async def test_a_client_that_knows_more_is_no_gap() -> None:
    """Its events came by another way than the topic, whose last messages were lost."""
    journal = Journal(50)
    feed = EventFeed(journal.ask)
    tell(feed, journal, 20, 21)
    cursor = EventCursor(feed, 40, "aa")
    assert numbers(await cursor.next()) == list(range(41, 51))


def test_csv_has_times_and_no_formulas() -> None:
    event = dict.fromkeys(COLUMNS, "") | {"number": 3, "time": 0.25, "text": '=SUM(A1), "x"', "user": "@erp"}
    row = csv_rows([event]).splitlines()[0]
    assert row.startswith("3,1970-01-01T00:00:00.250+00:00,")
    assert "'@erp" in row
    assert '"\'=SUM(A1), ""x"""' in row


class LeavingManager:
    """Returns one full page of the history."""

    def __init__(self) -> None:
        self.pages = 1

    async def ask(self, *_asked: object, **_options: object) -> dict[str, Any]:
        if not self.pages:
            raise PlannerUnavailableError("the fleet manager did not answer")
        self.pages -= 1
        event = dict.fromkeys(COLUMNS, "") | {"number": 1, "time": 0.0}
        return {"status": 200, "body": json.dumps({"events": [event] * 1000, "next": 1000})}


async def test_a_history_whose_manager_leaves_is_cut_off() -> None:
    """A second answer inside the first one looked like a line of the file."""
    streams = EventStreams(cast("Any", LeavingManager()), EventFeed(Journal().ask), cast("Any", OpenAccess()))
    app = web.Application(middlewares=[_problems, name_user])
    app.router.add_get("/history", streams.history)
    async with TestServer(app) as server, asyncio.timeout(60):
        reader, writer = await asyncio.open_connection(server.host, server.port)
        writer.write(b"GET /history?format=csv HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
        try:
            answer = await reader.read()
        finally:
            writer.close()
    assert answer.count(b"HTTP/1.1") == 1
    assert answer.count(b"1970-01-01") == 1000
    assert not answer.endswith(b"\r\n0\r\n\r\n"), "it looks whole"


class ShortJournal(Journal):
    """Keeps the newest events only."""

    kept = 10

    async def ask(self, after: int, limit: int) -> EventBatch:
        return await super().ask(max(after, len(self.events) - self.kept), limit)


async def test_a_client_behind_more_than_is_kept_is_told() -> None:
    journal = ShortJournal(50)
    cursor = EventCursor(EventFeed(journal.ask), 20, "aa")
    with pytest.raises(EventsForgottenError) as caught:
        await cursor.next()
    assert (caught.value.journal, caught.value.first, caught.value.last) == ("aa", 21, 40)
    assert numbers(await cursor.next()) == list(range(41, 51))


async def test_a_client_that_wants_what_is_kept_has_no_gap() -> None:
    journal = ShortJournal(50)
    assert numbers(await EventCursor(EventFeed(journal.ask), 0).next()) == list(range(41, 51))
    assert numbers(await EventCursor(EventFeed(journal.ask), 40, "aa").next()) == list(range(41, 51))


async def test_a_stream_tells_its_gap_and_resumes_after_it() -> None:
    """Without the gap, a program that was away took the events after it for all."""
    journal = ShortJournal(50)
    feed = EventFeed(journal.ask)
    streams = EventStreams(cast("Any", None), feed, cast("Any", OpenAccess()))
    app = web.Application(middlewares=[name_user])
    app.router.add_get("/events", streams.events)
    async with TestServer(app) as server, ClientSession() as session, asyncio.timeout(60):

        async def follow(last: str) -> tuple[str, str]:
            headers = {"Accept": "text/event-stream", "Last-Event-ID": last}
            async with session.get(server.make_url("/events"), headers=headers) as reply:
                await reply.content.readuntil(b"\n\n")
                gap = await reply.content.readuntil(b"\n\n")
                return gap.decode(), (await reply.content.readuntil(b"\n\n")).decode()

        gap, after = await follow("aa:20")
        fields = dict(line.split(": ", 1) for line in gap.splitlines() if line)
        assert (fields["event"], fields["id"]) == ("gap", "aa:40")
        told = json.loads(fields["data"])
        assert (told["journal"], told["from"], told["to"]) == ("aa", 21, 40)
        assert after.startswith("id: aa:41\n")
        resumed, _ = await follow(fields["id"])
        assert resumed.startswith("id: aa:41\n")
