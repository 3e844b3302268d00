"""Events over HTTP: pages of JSON, server-sent events, and the history as CSV."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import io
import json
import re
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from aiohttp import hdrs, web

from rce.guard import NoPlaceError
from rce.web.writing import write
from rce_fleet.exceptions import EventsForgottenError, EventsRestartedError
from rce_fleet.station.access import USER, problem
from rce_fleet.station.events import EventCursor, EventFeed
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.station.quotas import why_no_place

if TYPE_CHECKING:
    from yarl import URL

    from rce_fleet.station.access import AccessControl
    from rce_fleet.station.fleet_requests import FleetRequests

EVENT_STREAM, CSV = "text/event-stream", "text/csv"
AWAY_S = 2.0
MAX_ROWS = 1_000_000
_PAGE = 1000
_DIGITS = 18
_ID = re.compile(r"(?:([0-9a-f]{1,32}):)?([0-9]{1,18})")
"""The id of a server-sent event: the journal and the number; a number alone is of any journal."""
COLUMNS = ("number", "time", "kind", "id", "name", "state", "robot", "user", "text", "revision")
_CUT = "the fleet manager stopped in the middle of the history"
"""Why an answer ends without its last chunk: what was sent must not be taken for all."""
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Beginnings of a text that spreadsheets take for a formula."""

Work = Callable[[web.Request], Awaitable[web.StreamResponse]]


class EventStreams:
    """Handlers of ``/events`` and ``/history``.

    Args:
        requests: Asks the manager.
        feed: The newest events.
        access: Ends streams of users whose login has ended.
    """

    def __init__(self, requests: FleetRequests, feed: EventFeed, access: AccessControl) -> None:
        self._requests = requests
        self._feed = feed
        self._access = access

    async def events(self, request: web.Request) -> web.StreamResponse:
        """Return events after a number; with ``Accept: text/event-stream``, follow them."""
        if EVENT_STREAM not in request.headers.get(hdrs.ACCEPT, ""):
            return await self._requests.handle(request, "")
        if ignored := {"id", "kind", "limit", "robot"} & request.query.keys():
            return problem(
                422, f"a stream of events takes no {min(ignored)!r}: it sends all, from 'after' on"
            )
        last = request.headers.get("Last-Event-ID") or request.query.get("after", "")
        found = _ID.fullmatch(last)
        if last and found is None:
            return problem(422, f"Last-Event-ID must be the id or number of an event, not {last[:40]!r}")
        journal, number = (found[1] or "", int(found[2])) if found else ("", None)
        cursor = EventCursor(self._feed, number, journal)
        return await self._in_place(request, lambda: self._follow(request, cursor))

    async def _in_place(
        self, request: web.Request, answer: Callable[[], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Answer while the user has a place for a stream, or refuse."""
        with contextlib.ExitStack() as place:
            try:
                place.enter_context(self._access.quotas.streams.place(request[USER].name))
            except NoPlaceError as error:
                return problem(429, why_no_place("streams of events", error), {"Retry-After": "10"})
            return await answer()

    async def _follow(self, request: web.Request, cursor: EventCursor) -> web.StreamResponse:
        headers = {hdrs.CONTENT_TYPE: EVENT_STREAM, hdrs.CACHE_CONTROL: "no-store", "X-Accel-Buffering": "no"}
        response = web.StreamResponse(headers=headers)
        await response.prepare(request)
        try:
            await write(request, response, f"retry: 2000\n{_place_of(cursor)}\n".encode())
            while True:
                frames = await _next_frames(cursor)
                if not await self._access.is_still_allowed(request):
                    await write(request, response, b": your login has ended; log in again\n\n")
                    return response
                await write(
                    request, response, "".join(frames or [f"{_place_of(cursor)}: no event\n\n"]).encode()
                )
        except ConnectionError:
            return response

    async def history(self, request: web.Request) -> web.StreamResponse:
        """Return events of a time as JSON, or all of them as CSV."""
        wanted = request.query.get("format", "csv" if CSV in request.headers.get(hdrs.ACCEPT, "") else "json")
        if wanted == "json":
            return await self._requests.handle(request, "")
        if wanted != "csv":
            return problem(422, f"format must be json or csv, not {wanted[:40]!r}")
        url = request.rel_url.without_query_params("token", "format", "limit")
        first = url.query.get("after", "0")
        if not (first.isdecimal() and len(first) <= _DIGITS):
            return problem(422, f"after must be the number of an event, not {first[:40]!r}")
        return await self._in_place(request, lambda: self._history_csv(request, url, int(first)))

    async def _history_csv(self, request: web.Request, url: URL, after: int) -> web.StreamResponse:
        response: web.StreamResponse | None = None
        for _ in range(MAX_ROWS // _PAGE):
            asked = url.update_query({"after": str(after), "limit": str(_PAGE)})
            path = f"/history?{asked.raw_query_string}"
            try:
                answer = await self._requests.ask("GET", path, user=request[USER])
            except PlannerUnavailableError as error:
                if response is None:
                    raise
                raise ConnectionError(f"{_CUT}: {error}") from error
            if answer["status"] != 200:  # noqa: PLR2004
                if response is not None:
                    raise ConnectionError(f"{_CUT}: {answer['body']}")
                return web.Response(
                    status=int(answer["status"]), text=answer["body"], content_type="application/json"
                )
            page = json.loads(answer["body"])
            if response is None:
                response = await _begin(request)
            await write(request, response, csv_rows(page["events"]).encode())
            after = page["next"]
            if len(page["events"]) < _PAGE:
                break
        assert response is not None
        await response.write_eof()
        return response


async def _next_frames(cursor: EventCursor) -> list[str]:
    """Wait for events; return them as server-sent events.

    The event ``gap`` tells that numbers begin anew, or that some events are not kept any more.
    """
    try:
        found = await cursor.next()
    except PlannerUnavailableError:
        await asyncio.sleep(AWAY_S)
        return []
    except EventsRestartedError as error:
        told = json.dumps({"journal": error.journal, "text": str(error)})
        return [f"event: gap\nid: {error.journal}:0\ndata: {told}\n\n"]
    except EventsForgottenError as error:
        told = json.dumps(
            {"journal": error.journal, "from": error.first, "to": error.last, "text": str(error)}
        )
        return [f"event: gap\nid: {_id_of(cursor, error.last)}\ndata: {told}\n\n"]
    return [f"id: {_id_of(cursor, one['number'])}\ndata: {json.dumps(one)}\n\n" for one in found]


def _place_of(cursor: EventCursor) -> str:
    """Return the line with the id from which a client resumes; empty: not known yet."""
    return "" if cursor.number is None else f"id: {_id_of(cursor, cursor.number)}\n"


def _id_of(cursor: EventCursor, number: int) -> str:
    """Return the id of the event of this number."""
    return f"{cursor.journal}:{number}" if cursor.journal else str(number)


async def _begin(request: web.Request) -> web.StreamResponse:
    headers = {
        hdrs.CONTENT_TYPE: f"{CSV}; charset=utf-8",
        hdrs.CONTENT_DISPOSITION: 'attachment; filename="history.csv"',
        hdrs.CACHE_CONTROL: "no-store",
    }
    response = web.StreamResponse(headers=headers)
    await response.prepare(request)
    await response.write((",".join(COLUMNS) + "\r\n").encode())
    return response


def csv_rows(events: list[dict[str, Any]]) -> str:
    """Write events as lines of CSV; times as ISO 8601 in UTC, and no text that begins a formula."""
    lines = io.StringIO()
    writer = csv.writer(lines)
    for event in events:
        writer.writerow([_cell(column, event.get(column, "")) for column in COLUMNS])
    return lines.getvalue()


def _cell(column: str, value: Any) -> str:
    if column == "time":
        return datetime.fromtimestamp(float(value), UTC).isoformat(timespec="milliseconds")
    text = str(value)
    return f"'{text}" if isinstance(value, str) and text.startswith(_FORMULA) else text
