"""REST: the usage, once or as a stream."""

from __future__ import annotations

from aiohttp import web

from rce.web.openapi import Query
from rce_master.exceptions import InvalidRequestError
from rce_master.http.routes import ENDED, OF_USER, Call, route_table
from rce_master.http.usage_models import UsageOut
from rce_master.http.usage_views import UsageViews

routes = route_table("usage")

LEAST_INTERVAL_S, MOST_INTERVAL_S = 1, 3600


@routes.route(
    "GET",
    "/usage",
    "Show what containers, nodes and machines consume now, and what could be better",
    reply=UsageOut,
    query=(OF_USER,),
)
async def show_usage(call: Call) -> UsageOut:
    """Show the usage."""
    return _usage(call, call.scope)


@routes.route(
    "GET",
    "/usage/live",
    "The same again and again, as server-sent events",
    media="text/event-stream",
    query=(
        OF_USER,
        Query(name="interval", description="Seconds between two, at least 1; default: 2.", type="integer"),
    ),
)
async def stream_usage(call: Call) -> web.StreamResponse:
    """Stream the usage until the client or the server ends it, or the token becomes invalid."""
    interval = call.number("interval", 2)
    if not LEAST_INTERVAL_S <= interval <= MOST_INTERVAL_S:
        raise InvalidRequestError(
            f"query parameter 'interval' must be {LEAST_INTERVAL_S} to {MOST_INTERVAL_S}"
        )
    with call.services.quotas.stream(call.caller):
        return await _stream(call, call.scope, interval)


async def _stream(call: Call, scope: str | None, interval: int) -> web.StreamResponse:
    response = web.StreamResponse(
        headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    )
    await response.prepare(call.request)
    try:
        await response.write(_frame(_usage(call, scope)))
        while True:
            if not await call.lasts(interval):
                await response.write(b": %s\n\n" % ENDED.encode())
                return response
            await response.write(_frame(_usage(call, scope)))
    except ConnectionError:
        # The client disconnected: a stream does not end in another way from its side.
        return response


def _usage(call: Call, scope: str | None) -> UsageOut:
    services = call.services
    views = UsageViews(services.state_service.tables, services.reconciler.book)
    return UsageOut(
        time=services.clock(),
        containers=views.containers(scope),
        machines=views.machines() if call.is_admin else [],
    )


def _frame(usage: UsageOut) -> bytes:
    return b"event: usage\ndata: %s\n\n" % usage.model_dump_json().encode()
