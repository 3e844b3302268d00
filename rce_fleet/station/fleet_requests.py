"""The routes of the fleet manager, as the station serves them: each request is passed on to the manager.

The station checks logins and roles and keeps the audit log. The manager checks everything else and answers;
status, body and revision are passed back as they are.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from aiohttp import hdrs, web

from rce.web.bodies import read_pieces
from rce.web.openapi import PREFIX, Query
from rce.web.routes import Route
from rce_fleet.api.fleet import (
    ChargersModel,
    ChargersState,
    FleetMapModel,
    FleetRobotModel,
    RobotChange,
    RobotList,
    StatisticsModel,
    ZoneList,
    ZoneModel,
    ZoneRequest,
)
from rce_fleet.api.tasks import (
    CancelledTasks,
    HoldRequest,
    LoadRequest,
    PutInRequest,
    TaskChange,
    TaskModel,
    TaskPage,
    TaskRequest,
)
from rce_fleet.station.access import USER, problem
from rce_fleet.station.planner_client import PlannerUnavailableError

if TYPE_CHECKING:
    from pydantic import BaseModel

    from rce_fleet.station.access import AccessControl
    from rce_fleet.station.authentication import StationUser
    from rce_fleet.station.fleet_link import FleetLink

MAX_BODY = 1 << 20
MAX_KEY = 200
MAX_SUBJECT = 300
"""Characters of a path in the audit log."""
_KEY = "Idempotency-Key"
_RETRY_S = "1"
_READS = (401, 403, 404, 421, 422, 503)
_CHANGES = (*_READS, 400, 408, 409, 412, 413, 429, 507)
_UNKNOWN_OUTCOME = (
    "the fleet manager did not answer, so the request may have been carried out: send it again, with the same"
    " Idempotency-Key if it creates a task"
)
_CURSOR = Query(name="cursor", description="The field next of the page before.")
_LIMIT = Query(name="limit", description="Most in one answer.", type="integer")
_WHICH_TASKS = (
    Query(name="state", description="States, separated by commas; also open, ended and recurring."),
    Query(name="robot", description="The robot that does them."),
    Query(name="requester", description="Who created them."),
)


def role_of(user: StationUser) -> str:
    """Return the role that a user has for the fleet manager: viewer, operator or admin."""
    if not user.may_control:
        return "viewer"
    return "admin" if user.role == "admin" else "operator"


async def read_body(request: web.Request, access: AccessControl) -> str:
    """Read a body of JSON, and check the user again if it came slowly.

    Raises:
        AuthenticationError: The user's permission has ended meanwhile.
        HTTPRequestEntityTooLarge: It is too large.
        HTTPBadRequest: It is not UTF-8, or damaged.
    """
    body, began = bytearray(), time.monotonic()
    async for piece in read_pieces(request):
        body += piece
        if len(body) > MAX_BODY:
            raise web.HTTPRequestEntityTooLarge(MAX_BODY, len(body))
    await access.check_after(request, began)
    try:
        return body.decode()
    except UnicodeDecodeError:
        raise web.HTTPBadRequest(reason="the body is not UTF-8") from None


class FleetRequests:
    """Passes requests on.

    Args:
        fleet: The link to planner and manager.
        access: Checks what users may do.
    """

    def __init__(self, fleet: FleetLink, access: AccessControl) -> None:
        self._fleet = fleet
        self._access = access

    async def handle(self, request: web.Request, action: str) -> web.StreamResponse:
        """Answer a request.

        Args:
            request: The request.
            action: What it does, for the audit log; empty: it only reads.
        """
        subject = _target(request)[:MAX_SUBJECT]
        given = {name: request.headers.get(name, "") if action else "" for name in (_KEY, hdrs.IF_MATCH)}
        for name, text in given.items():
            if len(text) > MAX_KEY or not text.isprintable():
                return problem(400, f"{name} must have at most {MAX_KEY} printable characters")
        if action and (refusal := self._access.control_refusal(request, action, subject)) is not None:
            return refusal
        answer = await self.ask(
            request.method,
            _target(request),
            user=request[USER],
            body=await read_body(request, self._access) if action else "",
            key=given[_KEY],
            revision=given[hdrs.IF_MATCH],
        )
        if action and answer["status"] < 400:  # noqa: PLR2004 - where errors begin
            self._access.audit(request, action, subject)
        return _response(request, answer)

    async def ask(
        self,
        method: str,
        path: str,
        *,
        user: StationUser | None,
        body: str = "",
        key: str = "",
        revision: str = "",
    ) -> dict[str, Any]:
        """Ask the manager; return its ``status``, ``body`` and ``revision``.

        Args:
            method: The HTTP method.
            path: Below ``/api/v1``, with its query.
            user: Who asks; None: the station itself, which only reads.
            body: JSON; empty: none.
            key: The Idempotency-Key; empty: none.
            revision: If-Match; empty: none.

        Raises:
            PlannerUnavailableError: The manager does not answer.
        """
        try:
            return await self._fleet.request(
                {
                    "method": method,
                    "path": path,
                    "body": body,
                    "user": "" if user is None else user.name,
                    "role": "viewer" if user is None else role_of(user),
                    "key": key,
                    "revision": revision,
                }
            )
        except PlannerUnavailableError as error:
            if method == "GET":
                raise
            raise PlannerUnavailableError(f"{_UNKNOWN_OUTCOME} ({error})") from error


def _target(request: web.Request) -> str:
    """Return path and query for the manager, without the station's own parameters."""
    url = request.rel_url.without_query_params("token", "format")
    return url.raw_path.removeprefix(PREFIX) + (f"?{url.raw_query_string}" if url.raw_query_string else "")


def _response(request: web.Request, answer: dict[str, Any]) -> web.Response:
    status, revision = int(answer["status"]), str(answer["revision"])
    headers: dict[str, str] = {hdrs.ETAG: revision} if revision else {}
    if status in (429, 503):
        headers["Retry-After"] = _RETRY_S
    # Tasks and chargers also say what changes without a revision: when a task ends, which robots charge.
    is_whole = request.method == "GET" and request.path.startswith(f"{PREFIX}/zones/")
    if is_whole and revision and request.headers.get(hdrs.IF_NONE_MATCH) == revision:
        return web.Response(status=304, headers=headers)
    return web.Response(
        status=status, text=str(answer["body"]), content_type="application/json", headers=headers
    )


def _route(
    method: str,
    path: str,
    action: str,
    summary: str,
    *,
    reply: type[BaseModel],
    body: type[BaseModel] | None = None,
    status: int = 200,
    also: tuple[int, ...] = (),
    query: tuple[Query, ...] = (),
    name: str = "",
) -> Route[str]:
    group = path.split("/")[1]
    return Route(
        method=method,
        path=path,
        handler=action,
        summary=summary,
        group=group,
        name=name or action or f"list_{group}",
        body=body,
        reply=reply,
        status=status,
        also=also,
        query=query,
        errors=_CHANGES if action else _READS,
    )


ROUTES: list[Route[str]] = [
    _route(
        *(
            "POST",
            "/tasks",
            "create_task",
            "Create a task; the same Idempotency-Key returns the same task (200)",
        ),
        body=TaskRequest,
        reply=TaskModel,
        status=201,
        also=(200,),
    ),
    _route(
        *("GET", "/tasks", "", "List tasks, by growing number"),
        reply=TaskPage,
        query=(
            *_WHICH_TASKS,
            Query(
                name="deadline_before",
                description="Only those with a deadline before this time, seconds since 1970.",
                type="number",
            ),
            Query(name="order", description="asc (default) or desc."),
            _CURSOR,
            _LIMIT,
        ),
    ),
    _route(
        *(
            "DELETE",
            "/tasks",
            "cancel_tasks",
            "Cancel many tasks, the oldest first: of some states, of a robot or of a user",
        ),
        reply=CancelledTasks,
        query=(
            *_WHICH_TASKS,
            Query(name="limit", description="1000 at most, and by default.", type="integer"),
        ),
    ),
    _route("GET", "/tasks/{id}", "", "Return a task", reply=TaskModel, name="get_task"),
    _route("PATCH", "/tasks/{id}", "change_task", "Change a task", body=TaskChange, reply=TaskModel),
    _route(
        *(
            "DELETE",
            "/tasks/{id}",
            "cancel_task",
            "Cancel a task; one that has ended recurs no further",
        ),
        reply=TaskModel,
    ),
    _route("POST", "/tasks/{id}/hold", "hold_task", "Hold a task", body=HoldRequest, reply=TaskModel),
    _route("POST", "/tasks/{id}/resume", "resume_task", "End the hold of a task", reply=TaskModel),
    _route(
        *("POST", "/tasks/{id}/confirm", "confirm_action", "Confirm the action of a task that is under way"),
        reply=TaskModel,
    ),
    _route(
        *("POST", "/tasks/{id}/load", "settle_load", "Say where a load is whose robot does not come back"),
        body=LoadRequest,
        reply=TaskModel,
    ),
    _route(
        *("POST", "/tasks/{id}/reassign", "reassign_task", "Give a task to another robot"),
        reply=TaskModel,
    ),
    _route(
        *("GET", "/robots", "", "List robots, by name; all of them without limit"),
        reply=RobotList,
        query=(
            Query(name="state", description="States, separated by commas."),
            Query(name="activity", description="Activities, separated by commas."),
            Query(
                name="since",
                description="The version of an answer: only robots that changed after it; 0: all of them.",
                type="integer",
            ),
            _CURSOR,
            _LIMIT,
        ),
    ),
    _route(
        *("GET", "/robots/{robot}/manager", "", "Return a robot as the fleet manager knows it"),
        reply=FleetRobotModel,
        name="get_managed_robot",
    ),
    _route(
        *("PATCH", "/robots/{robot}", "change_robot", "Change what a robot can do"),
        body=RobotChange,
        reply=FleetRobotModel,
    ),
    _route(
        *("POST", "/robots/{robot}/pause", "pause_robot", "Let a robot stand still; it keeps its task"),
        body=HoldRequest,
        reply=FleetRobotModel,
    ),
    _route(
        "POST", "/robots/{robot}/resume", "resume_robot", "End the pause of a robot", reply=FleetRobotModel
    ),
    _route(
        *(
            "POST",
            "/robots/{robot}/take-out",
            "take_out_robot",
            "Take a robot out of service; others get its tasks",
        ),
        body=HoldRequest,
        reply=FleetRobotModel,
    ),
    _route(
        *("POST", "/robots/{robot}/put-in", "put_in_robot", "Put a robot into service"),
        body=PutInRequest,
        reply=FleetRobotModel,
    ),
    _route("GET", "/chargers", "", "Return chargers, parking places and return cells", reply=ChargersState),
    _route(
        *("PUT", "/chargers", "set_chargers", "Replace chargers, parking places and return cells"),
        body=ChargersModel,
        reply=ChargersState,
    ),
    _route(
        *("GET", "/zones", "", "List zones, by name; all of them without limit"),
        reply=ZoneList,
        query=(Query(name="kind", description="Kinds, separated by commas."), _CURSOR, _LIMIT),
    ),
    _route("GET", "/zones/{id}", "", "Return a zone", reply=ZoneModel, name="get_zone"),
    _route(
        *("PUT", "/zones/{id}", "set_zone", "Make (201) or replace a zone"),
        body=ZoneRequest,
        reply=ZoneModel,
        also=(201,),
    ),
    _route("DELETE", "/zones/{id}", "remove_zone", "Remove a zone", reply=ZoneModel),
    _route(
        "GET", "/map", "", "Return the grid, its walls and blocked cells", reply=FleetMapModel, name="get_map"
    ),
    _route(
        *("GET", "/statistics", "", "Return what the fleet did in the last seconds"),
        reply=StatisticsModel,
        query=(Query(name="seconds", description="Length of the time; default 3600.", type="number"),),
        name="get_statistics",
    ),
]
"""Requests that are passed on as they are; the handler is the name of the action in the audit log."""
