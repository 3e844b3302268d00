"""The REST API: its routes, their requests and answers, and the OpenAPI document.

It is loaded with the first request for it: see :mod:`rce_master.http.late`.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

from aiohttp import web
from pydantic import BaseModel, ValidationError

from rce.web.bodies import read_whole
from rce.web.openapi import PREFIX, build_document
from rce.web.routes import parameter_fault
from rce_master.answers import PendingAnswer
from rce_master.exceptions import InvalidRequestError, MasterError
from rce_master.http import (
    api_account,
    api_audit,
    api_control,
    api_exec,
    api_limits,
    api_machines,
    api_packages,
    api_read,
    api_states,
    api_stream,
    api_tokens,
    api_usage,
    api_volumes,
)
from rce_master.http.access import admit, bearer
from rce_master.http.auditing import note_done, note_refused
from rce_master.http.idempotency import keyed_request, replayed
from rce_master.http.models import Error
from rce_master.http.routes import Call, Route, Services, body_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    Answer = Callable[[web.Request, Mapping[str, str]], Awaitable[web.StreamResponse]]

ROUTES: list[Route] = [
    *api_account.routes,
    *api_limits.routes,
    *api_tokens.routes,
    *api_audit.routes,
    *api_read.routes,
    *api_control.routes,
    *api_machines.routes,
    *api_usage.routes,
    *api_packages.routes,
    *api_volumes.routes,
    *api_states.routes,
    *api_stream.routes,
    *api_exec.routes,
]


class Api:
    """Answers all requests for paths of the API.

    Args:
        services: The services of the handlers.
    """

    def __init__(self, services: Services) -> None:
        self._router = web.UrlDispatcher()
        self._answers: dict[web.AbstractRoute, Answer] = {}
        for method in ("GET", "HEAD"):
            self._add(method, "/openapi.json", _document)
        for route in ROUTES:
            self._add(route.method, route.path, _adapt(route, services))

    def _add(self, method: str, path: str, answer: Answer) -> None:
        self._answers[self._router.add_route(method, PREFIX + path, self.handle)] = answer

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """Answer a request.

        Raises:
            HTTPException: The path does not exist, or does not have this method.
            MasterError: The request failed.
        """
        found = await self._router.resolve(request)
        if found.http_exception is not None:
            raise found.http_exception
        answer = self._answers[found.route]
        return await answer(request, dict(found))


def _adapt(route: Route, services: Services) -> Answer:
    async def answer(request: web.Request, parts: Mapping[str, str]) -> web.StreamResponse:
        call = Call(request, services, None, "", None, parts)
        try:
            token, user = bearer(request, services, stations=route.stations)
            if user is not None:
                services.quotas.request(user)
            call = replace(call, user=user, token=token)
            admit(route, user)
            _check_parameters(route, request)
            text = b""
            if route.body:
                text = await read_whole(request)
                if user is not None:
                    user = call.check_again()
                    admit(route, user)
                call = replace(call, user=user, body=read_body(route.body, text))
            keyed = keyed_request(request, user, text) if route.keyed and user is not None else None
            if keyed is None:
                reply = await route.handler(call)
            else:
                with services.answers.under_way(keyed) as former:
                    if former is not None:
                        return replayed(former)
                    pending = PendingAnswer(services.answers, keyed, route.status)
                    reply = await route.handler(replace(call, pending=pending))
        except MasterError as error:
            note_refused(route, call, error)
            raise
        note_done(route, call)
        if isinstance(reply, web.StreamResponse):
            return reply
        if reply is None:
            return web.Response(status=route.status)
        return web.Response(body=body_of(reply), status=route.status, content_type="application/json")

    return answer


def _check_parameters(route: Route, request: web.Request) -> None:
    if fault := parameter_fault(route, request.query.items()):
        raise InvalidRequestError(fault)


@cache
def _text() -> str:
    document = build_document(
        [route.operation for route in ROUTES],
        title="RCE master",
        description="Control of a robotics cloud.",
        error=Error,
    )
    return json.dumps(document)


async def _document(_: web.Request, __: Mapping[str, str]) -> web.Response:
    return web.Response(text=_text(), content_type="application/json")


def read_body(model: type[BaseModel], text: bytes) -> BaseModel:
    """Read a request's body.

    Raises:
        InvalidRequestError: It does not fit the model; the text names each fault with its path.
    """
    try:
        return model.model_validate_json(text or b"{}")
    except ValidationError as error:
        faults = "; ".join(f"{_place(fault['loc'])}: {fault['msg']}" for fault in error.errors())
        raise InvalidRequestError(faults) from None


def _place(location: tuple[int | str, ...]) -> str:
    return ".".join(map(str, location)) or "body"
