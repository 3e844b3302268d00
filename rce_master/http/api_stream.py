"""REST: logs of nodes, and the stream of events."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping
from enum import Enum
from typing import TypeVar

import msgspec
from aiohttp import web
from msgspec.structs import asdict

from rce.control import LogLevel, LogQuery, LogStream
from rce.web.openapi import Query
from rce_master.events import AT_ONCE, GAP, Event
from rce_master.exceptions import FencedError, InvalidRequestError
from rce_master.http import models
from rce_master.http.paging import MAX_ITEMS, PAGE
from rce_master.http.routes import ENDED, OF_USER, Call, route_table

routes = route_table("stream")

MAX_LOG = 1 << 20
HEARTBEAT_S = 15.0
E = TypeVar("E", bound=Enum)
_GAP = "earlier events are not kept; read the present state"
_EVENT_ID = re.compile(r"[0-9]{1,18}")


def _words(words: type[Enum]) -> str:
    return ", ".join(word.value for word in words)


_LOG_QUERY = (
    OF_USER,
    Query(name="offset", description="First byte; negative: that many before the end.", type="integer"),
    Query(name="limit", description=f"At most so many bytes, up to {MAX_LOG}.", type="integer"),
    Query(name="stream", description=f"Only these, with commas: {_words(LogStream)}."),
    Query(name="level", description=f"Only log records in ROS from this level on: {_words(LogLevel)}."),
    Query(name="previous", description="true: of the last incarnation of the container that ended."),
    Query(name="life", description="Of that incarnation of the container, as an answer named it."),
)


@routes.route(
    "GET",
    "/containers/{container}/nodes/{node}/log",
    "Read a node's log; to follow it, read on from the offset that is given back",
    reply=models.LogOut,
    errors=(503,),
    query=_LOG_QUERY,
)
async def read_node_log(call: Call) -> models.LogOut:
    """Read a node's log."""
    return await _read_log(call, call.path("node"))


@routes.route(
    "GET",
    "/containers/{container}/log",
    "Read the log of a container's environment",
    reply=models.LogOut,
    errors=(503,),
    query=_LOG_QUERY,
)
async def read_container_log(call: Call) -> models.LogOut:
    """Read the environment's log."""
    return await _read_log(call, "")


async def _read_log(call: Call, node: str) -> models.LogOut:
    offset, limit = call.number("offset", 0), call.number("limit", 65536)
    if not 0 < limit <= MAX_LOG:
        raise InvalidRequestError(f"query parameter 'limit' must be 1 to {MAX_LOG}")
    id_ = f"{call.owner}/{call.path('container')}"
    query = _log_query(call.request.query)
    async with call.services.quotas.log_read(call.caller):
        chunk = await call.services.reconciler.read_log(id_, node, offset, limit, query)
    return models.LogOut(
        text=chunk.text,
        offset=chunk.offset,
        life=chunk.incarnation,
        ended=chunk.ended or None,
        reason=chunk.reason,
    )


def _log_query(query: Mapping[str, str]) -> LogQuery:
    streams = [word for word in query.get("stream", "").split(",") if word]
    return LogQuery(
        streams=tuple(_one_of(LogStream, "stream", word) for word in streams),
        level=_one_of(LogLevel, "level", query.get("level", LogLevel.DEBUG.value)),
        previous=query.get("previous") == "true",
        incarnation=query.get("life", ""),
    )


def _one_of(words: type[E], name: str, word: str) -> E:
    try:
        return words(word)
    except ValueError:
        raise InvalidRequestError(f"query parameter {name!r} must be one of {_words(words)}") from None


@routes.route(
    "GET",
    "/events",
    "Follow what happens, as server-sent events; Last-Event-ID resumes. With Accept: application/json, return"
    " a page of what happened",
    reply=models.EventsOut,
    other_media=("text/event-stream",),
    query=(
        OF_USER,
        Query(
            name="since",
            description="Id after which to begin. Default: now; of pages: the oldest that is kept.",
            type="integer",
        ),
        *PAGE,
    ),
)
async def stream_events(call: Call) -> models.EventsOut | web.StreamResponse:
    """Return a page, or stream until the client or the server ends it, or the token becomes invalid."""
    if call.request.headers.get("Accept", "").partition(";")[0].strip() == "application/json":
        return _page(call, call.scope)
    with call.services.quotas.stream(call.caller):
        return await _stream(call, call.scope, _start(call))


def _page(call: Call, scope: str | None) -> models.EventsOut:
    log = call.services.events
    limit, since = call.number("limit", MAX_ITEMS), call.number("cursor", call.number("since", 0))
    if not 0 < limit <= MAX_ITEMS:
        raise InvalidRequestError(f"query parameter 'limit' must be 1 to {MAX_ITEMS}")
    made = log.made(scope or "")
    if (gap := _gap(call, scope, since)) is not None:
        since = gap.id
    found = log.since(since, limit + 1, scope)
    has_more, found = len(found) > limit, found[:limit]
    shown = [event for event in found if event.id > made and _concerns(call, event)]
    if gap is not None:
        shown.insert(0, gap)
    return models.EventsOut(
        events=[models.EventOut(**asdict(event)) for event in shown],
        newest=max(since, log.last_id),
        next=str(found[-1].id) if has_more else None,
    )


async def _stream(call: Call, scope: str | None, last: int) -> web.StreamResponse:
    made = call.services.events.made(scope or "")
    response = web.StreamResponse(
        headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    )
    await response.prepare(call.request)
    events = call.services.events
    gap = _gap(call, scope, last)
    clock = asyncio.get_running_loop().time
    try:
        # A client that loses the stream before the first event resumes it here, too.
        await call.write(response, b"id: %d\n: hello\n\n" % last + (b"" if gap is None else _frame(gap)))
        last = last if gap is None else gap.id
        written = clock()
        while not events.is_closed:
            news = await events.wait(last, max(0.0, written + HEARTBEAT_S - clock()), scope)
            if not call.is_still_valid:
                await call.write(response, _frame(_farewell(call, last)))
                return response
            # Periodic comments prevent timeouts of proxies, and detect that a client has disconnected.
            frames = [_frame(event) for event in news if event.id > made and _concerns(call, event)]
            if frames or clock() >= written + HEARTBEAT_S:
                await call.write(response, b"".join(frames) or b":\n\n")
                written = clock()
            last = news[-1].id if news else last
            if len(news) == AT_ONCE:
                await call.services.quotas.replay(call.caller)
    except (ConnectionError, FencedError):
        # The client disconnected, or another master leads and is asked next, from the last event on.
        pass
    return response


def _start(call: Call) -> int:
    resumed = call.request.headers.get("Last-Event-ID", "")
    if _EVENT_ID.fullmatch(resumed):
        return int(resumed)
    return call.number("since", call.services.events.last_id)


def _gap(call: Call, scope: str | None, last: int) -> Event | None:
    """Return what stands for the events that a follower missed after an event; None if none are missing."""
    missed = call.services.events.missed(last, scope) if last > 0 else None
    if missed is None:
        return None
    user = scope or call.caller.name
    return Event(id=missed, time=call.services.clock(), kind=GAP, user=user, subject=user, text=_GAP)


def _concerns(call: Call, event: Event) -> bool:
    """Return whether a caller may see an event; events without a user are for administrators."""
    return bool(event.user) or call.is_admin


def _farewell(call: Call, last: int) -> Event:
    """Return the last event of a stream whose caller has lost the permission."""
    return Event(
        id=last,
        time=call.services.clock(),
        kind="stream_ended",
        user=call.caller.name,
        subject=call.caller.name,
        text=ENDED,
    )


def _frame(event: Event) -> bytes:
    body = msgspec.json.encode(event)
    return b"id: %d\nevent: %s\ndata: %s\n\n" % (event.id, event.kind.encode(), body)
