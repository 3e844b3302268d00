"""Builds the HTTP application: routes, permissions and error answers."""

from __future__ import annotations

import logging
import math
from functools import cache
from typing import TYPE_CHECKING, Any

from aiohttp import hdrs, web

from rce.web.openapi import PREFIX
from rce.web.origin import ServerNames
from rce_master.exceptions import (
    AuthError,
    EndedError,
    FencedError,
    ForbiddenError,
    MasterError,
    RefusedError,
    StoreError,
    TaskSetAwayError,
    TooManyFailuresError,
    TooManyLoginsError,
    TooMuchError,
    UnderWayError,
)
from rce_master.http.access import check_metrics
from rce_master.http.auditing import note_refused_scrape
from rce_master.http.health import HEALTH_PATH, Health
from rce_master.http.late import LateApi
from rce_master.http.origin_guard import origin_guard

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from rce_master.http.entry import Entry
    from rce_master.http.routes import Services
    from rce_master.leadership import Fence
    from rce_master.state_service import StateService

    Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

_log = logging.getLogger(__name__)

MAX_BODY = 1 << 20


def make_app(
    services: Services, entry: Entry, *, allowed_origins: Iterable[str] = (), names: ServerNames | None = None
) -> web.Application:
    """Make the application.

    Args:
        services: The services of the handlers.
        entry: Where robots ask for their endpoint.
        allowed_origins: Origins whose pages may use the server from a browser, such as
            ``https://fleet.example.org``; pages of the server itself always may.
        names: The allowed host names of the server.
    """
    guard = origin_guard(frozenset(allowed_origins), names or ServerNames())
    fence = services.fence
    inner = [] if fence is None else [_fencing(fence), settling(services.state_service, fence)]
    app = web.Application(middlewares=[guard, _errors, *inner], client_max_size=MAX_BODY)
    app.on_shutdown.append(_ending(services))
    app.router.add_get("/", _at_entry(entry))
    health = Health(services.state_service, services.fence, services.drains, services.warnings)
    app.router.add_get(HEALTH_PATH, health.handle)
    app.router.add_get("/metrics", _metrics(services))
    app.router.add_route("*", PREFIX + "/{rest:.*}", LateApi(services).handle)
    return app


# Routes


def _at_entry(entry: Entry) -> Handler:
    async def handle(request: web.Request) -> web.Response:
        answer = entry.answer(request.url.raw_query_string)
        headers = {**answer.headers, hdrs.CONTENT_TYPE: answer.content_type}
        return web.Response(status=answer.status, body=answer.body, headers=headers)

    return handle


def _metrics(services: Services) -> Handler:
    @cache
    def scraped() -> Callable[[], Awaitable[web.Response]]:
        from rce_master.http.metrics import make_answer  # only scraped masters spend this memory

        checks, tables = services.authenticator, services.state_service.tables
        return make_answer(tables, services.reconciler.book, lambda: checks.checks, services.fence)

    async def handle(request: web.Request) -> web.Response:
        try:
            check_metrics(request, services)
        except (AuthError, ForbiddenError) as error:
            note_refused_scrape(request, services, error)
            raise
        return await scraped()()

    return handle


def _ending(services: Services) -> Callable[[web.Application], Awaitable[None]]:
    async def end_streams(_: web.Application) -> None:
        services.events.close()

    return end_streams


# Middleware of all routes


@web.middleware
async def _errors(request: web.Request, handler: Handler) -> web.StreamResponse:
    try:
        return await handler(request)
    except MasterError as error:
        return _error(_status(error), str(error), _headers(error))
    except web.HTTPException as error:
        return _error(error.status, error.reason, {k: v for k, v in error.headers.items() if k == hdrs.ALLOW})


def _fencing(fence: Fence) -> Any:
    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer nothing from a state that another master may have changed; streams check each write."""
        if request.path == HEALTH_PATH:
            return await handler(request)
        fence.check()
        try:
            response = await handler(request)
        except MasterError:
            fence.check()
            raise
        if not response.prepared:
            fence.check()
        return response

    return check


def settling(state_service: StateService, fence: Fence) -> Any:
    """Make the middleware by which no reader sees what is not stored, and may be lost with the lead."""

    @web.middleware
    async def settle(request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.method != hdrs.METH_GET or not request.path.startswith(PREFIX):
            return await handler(request)
        while True:
            reverts = state_service.reverts
            response, refusal = None, None
            try:
                response = await handler(request)
            except MasterError as error:
                refusal = error
            if response is not None and response.prepared:  # a stream, of what was stored
                return response
            await state_service.settled()
            fence.check()
            if state_service.reverts == reverts:
                break
        if response is None:
            assert refusal is not None
            raise refusal
        return response

    return settle


def _status(error: MasterError) -> int:
    match error:
        case RefusedError():
            return error.status
        case TooManyFailuresError():
            return 429
        case TooManyLoginsError() | StoreError() | TaskSetAwayError():
            return 503
        case AuthError():
            return 401
        case _:
            return 500


def _headers(error: MasterError) -> dict[str, str]:
    match error:
        case TooManyFailuresError() | TooMuchError():
            return {hdrs.RETRY_AFTER: str(math.ceil(error.retry_after))}
        case TooManyLoginsError() | EndedError() | FencedError() | UnderWayError():
            return {hdrs.RETRY_AFTER: "1"}
        case AuthError():
            return {hdrs.WWW_AUTHENTICATE: "Bearer"}
        case _:
            return {}


def _error(status: int, text: str, headers: dict[str, str] | None = None) -> web.Response:
    return web.json_response({"error": text}, status=status, headers=headers)
