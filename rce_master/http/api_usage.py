"""REST: the usage, once or as a stream."""

from __future__ import annotations

from functools import partial

from aiohttp import web
from msgspec import json

from rce.web.openapi import Query
from rce_master.exceptions import EndedError, FencedError, InvalidRequestError, TooMuchError
from rce_master.http.paging import PAGE, Listing, Span, answer, keys_of_users, whole
from rce_master.http.routes import ENDED, OF_USER, Call, route_table
from rce_master.http.usage_models import ContainerUsageOut, UsageOut
from rce_master.http.usage_views import UsageViews

routes = route_table("usage")

LEAST_INTERVAL_S, MOST_INTERVAL_S = 1, 3600


@routes.route(
    "GET",
    "/usage",
    "Show what containers, nodes and machines consume now, and what could be better",
    reply=UsageOut,
    query=(OF_USER, *PAGE),
)
async def show_usage(call: Call) -> web.Response:
    """Show the usage."""
    views = _views(call)
    # The machines belong to the first page: the others are about containers only.
    others = partial(_others, call, views, is_first="cursor" not in call.request.query)
    return await answer(call, _listing(call, views), others)


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
        return await _stream(call, interval)


async def _stream(call: Call, interval: int) -> web.StreamResponse:
    response = web.StreamResponse(
        headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    )
    await response.prepare(call.request)
    try:
        await call.write(response, await _frame(call))
        while True:
            if not await call.lasts(interval):
                await call.write(response, b": %s\n\n" % ENDED.encode())
                return response
            await call.write(response, await _frame(call))
    except (ConnectionError, EndedError, FencedError):
        # The client disconnected, or another master leads or will.
        return response


async def _frame(call: Call) -> bytes:
    views = _views(call)
    try:
        usage = await whole(call, _listing(call, views), partial(_others, call, views, is_first=True))
    except TooMuchError as error:
        return b": %s\n\n" % str(error).encode()
    return b"event: usage\ndata: %s\n\n" % usage


def _listing(call: Call, views: UsageViews) -> Listing:
    tables, scope = call.services.state_service.tables, call.scope

    def items(key: str, span: Span) -> list[tuple[str, ContainerUsageOut]]:
        container = tables.container(key)
        return [] if container is None else [(name, views.container(container)) for name in span.of(("",))]

    return Listing(
        name="containers",
        whole=lambda: [container.id for container in tables.containers(scope)],
        keys=keys_of_users(tables, tables.endpoints, "containers_of", scope),
        items=items,
    )


async def _others(call: Call, views: UsageViews, *, is_first: bool) -> dict[str, bytes]:
    machines = await views.machines() if call.is_admin and is_first else []
    rows = b",".join(machine.model_dump_json().encode() for machine in machines)
    return {"time": json.encode(call.services.clock()), "machines": b"[%s]" % rows}


def _views(call: Call) -> UsageViews:
    services = call.services
    return UsageViews(services.state_service.tables, services.reconciler.book, call.caller.name)
