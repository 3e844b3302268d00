"""The station's HTTP server: the page, and the API for the page and an ERP."""

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from aiohttp import hdrs, web
from pydantic import BaseModel, ValidationError

from rce.web.bodies import read_whole
from rce.web.openapi import PREFIX, Operation, build_document
from rce.web.origin import ServerNames
from rce.web.routes import Route, RouteTable
from rce_fleet.api.fleet import CellBlockModel
from rce_fleet.exceptions import EventsRestartedError, RequestRefusedError
from rce_fleet.station import masters_watch, replay_routes, world_link
from rce_fleet.station.access import (
    USER,
    AccessControl,
    delete_cookie,
    problem,
    set_cookie,
    token_of,
    with_known_query,
)
from rce_fleet.station.api import (
    MAX_CELL,
    Answer,
    CellRequest,
    FleetModel,
    GoalRequest,
    GridAnswer,
    GridRequest,
    LoginRequest,
    MapModel,
    Problem,
    RobotModel,
    UserModel,
)
from rce_fleet.station.authentication import (
    AuditedAction,
    AuthenticationError,
    Authenticator,
    TokenAuthenticator,
)
from rce_fleet.station.commands import routes as control_routes
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.manual_mode import ManualModes
from rce_fleet.station.fleet_api import FleetApi
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.grids import complete_grid, grid_answer
from rce_fleet.station.layers.hub import LayerHub
from rce_fleet.station.live import Broadcast
from rce_fleet.station.page_socket import PageSocket
from rce_fleet.station.planner_client import PlannerError, PlannerUnavailableError
from rce_fleet.station.recording import Records
from rce_fleet.station.replay_routes import ReplayRoutes
from rce_fleet.station.view import FleetView
from rce_fleet.station.world_link import WorldLink

STATIC = Path(__file__).parent / "static"
MAX_BODY = 1 << 16
MAX_DIGITS = 20
"""Digits of a cell's number; Python parses at most 4300."""
SHOWN = 80
"""Characters of an invalid name that an error repeats."""

_VIEW_ERRORS = (401, 403, 421, 503)
"""Error statuses of requests that read."""
_CONTROL_ERRORS = (*_VIEW_ERRORS, 400, 404, 408, 409, 413)

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
Method = Callable[["Station", web.Request], Awaitable[web.StreamResponse]]
"""A handler as it is written in :class:`Station`."""

ROUTES: RouteTable[Route[Method]] = RouteTable("fleet", Route)
"""The API for an ERP and the page."""


class Station:
    """Handlers of all routes.

    Args:
        view: The state of the fleet.
        fleet: Sends goals and blocked cells to the planner.
        pages: The open pages.
        authenticator: Finds the user of a token; if None, every request may do everything.
        names: Host names under which the station may be requested.
        layers: Sends layers to the pages that ask for them; if None, there are none.
        control: Reaches robots without the planner; if None, nothing does.
        records: What the fleet did, for replays; if None, there are none.
        world: The simulated world in which the fleet drives; if None, there is none.
        webhooks: File in which webhooks are kept; if None, they end with the program.
        kill_leader: Kills the leading master of a demo; if None, this is not one.
        modes: Gives robots that are driven by hand their own modes again; in memory only if None.

    Attributes:
        fleet_api: The part of the API that the fleet manager answers.
    """

    def __init__(
        self,
        view: FleetView,
        fleet: FleetLink,
        pages: Broadcast,
        *,
        authenticator: Authenticator | None = None,
        names: ServerNames | None = None,
        layers: LayerHub | None = None,
        control: RobotControl | None = None,
        records: Records | None = None,
        world: WorldLink | None = None,
        webhooks: Path | None = None,
        kill_leader: Callable[[], None] | None = None,
        modes: ManualModes | None = None,
    ) -> None:
        self._view = view
        self._fleet = fleet
        self._pages = pages
        self._authenticator = authenticator or TokenAuthenticator()
        self._access = AccessControl(self._authenticator, names or ServerNames())
        self._access.on_audit = self._tell_audit
        self._socket = PageSocket(pages, layers, self._access)
        self._replay = ReplayRoutes(records)
        self._world = world_link.WorldRoutes(world, self._access)
        self._masters = masters_watch.MastersRoutes(kill_leader, self._access)
        has_roles = self._authenticator.has_logins
        self.fleet_api = FleetApi(fleet, self._access, webhooks, has_roles=has_roles)
        self._control = control_routes.ControlRoutes(
            control, self.fleet_api, modes or ManualModes(fleet, view), self._access
        )
        self.fleet_api.feed.on_restart = self._tell_restart
        self.fleet_api.manager.on_change = self._tell_manager

    def make_app(self) -> web.Application:
        """Build the application."""
        app = web.Application(middlewares=[_problems, self._access.check], client_max_size=MAX_BODY)
        app.on_response_prepare.append(_set_headers)
        tables: tuple[tuple[RouteTable[Any], object], ...] = (
            (ROUTES, self),
            (control_routes.ROUTES, self._control),
            (world_link.ROUTES, self._world),
            (masters_watch.ROUTES, self._masters),
            (replay_routes.ROUTES, self._replay),
        )
        for table, owner in tables:
            for route in table:
                handler = with_known_query(route, partial(route.handler, owner))
                app.router.add_route(route.method, PREFIX + route.path, handler)
        self.fleet_api.add_to(app)
        routes = (route for table, _ in tables for route in table)
        operations = [*(route.operation for route in routes), *self.fleet_api.operations]
        document = cache(partial(_document_of, operations))

        async def describe(request: web.Request) -> web.StreamResponse:
            del request
            return web.Response(text=document(), content_type="application/json")

        app.router.add_get(f"{PREFIX}/openapi.json", describe)
        app.router.add_get(f"{PREFIX}/live", self._socket.handle)
        app.router.add_get(f"{PREFIX}/robots/{{robot}}/drive", self._control.drive)
        app.router.add_get("/login", self.login_page)
        app.router.add_get("/", self.page)
        app.router.add_static("/static", STATIC)
        return app

    async def end_drives(self) -> None:
        """Stop robots that are driven by hand, and give them their own modes again: the station ends."""
        await self._control.end_drives()

    # Handlers

    async def page(self, request: web.Request) -> web.StreamResponse:
        """Return the page."""
        del request
        return web.FileResponse(STATIC / "index.html")

    async def login_page(self, request: web.Request) -> web.StreamResponse:
        """Return the login page."""
        del request
        return web.FileResponse(STATIC / "login.html")

    @ROUTES.route(
        "POST",
        "/login",
        "Log in as a user of the engine; the token comes as a cookie",
        group="login",
        body=LoginRequest,
        status=204,
        open=True,
        errors=(400, 401, 403, 404, 408, 413, 421, 429, 503),
    )
    async def log_in(self, request: web.Request) -> web.StreamResponse:
        """Check a password at the engine; the token goes into a cookie, never to the page."""
        login = LoginRequest.model_validate_json(await read_whole(request))
        token = await self._authenticator.log_in(login.userID, login.password, request.remote or "")
        response = web.Response(status=204)
        set_cookie(request, response, token)
        return response

    @ROUTES.route(
        "DELETE", "/login", "Revoke the token of this request", group="login", status=204, errors=(403, 421)
    )
    async def log_out(self, request: web.Request) -> web.StreamResponse:
        """Revoke the request's token and delete the cookie."""
        await self._authenticator.log_out(token_of(request))
        response = web.Response(status=204)
        delete_cookie(request, response)
        return response

    @ROUTES.route(
        "GET",
        "/me",
        "The user of this request and their permissions",
        name="get_person",
        reply=UserModel,
        errors=_VIEW_ERRORS,
    )
    async def get_user(self, request: web.Request) -> web.StreamResponse:
        """Return the user of the request."""
        user = request[USER]
        return _reply(
            UserModel(
                name=user.name,
                role=user.role,
                steers=user.may_control,
                logged_in=self._authenticator.has_logins and not user.is_anonymous,
            )
        )

    @ROUTES.route("GET", "/fleet", "The whole fleet", reply=FleetModel, errors=_VIEW_ERRORS)
    async def get_fleet(self, request: web.Request) -> web.StreamResponse:
        """Return the state of the fleet."""
        del request
        grid = self._view.map()
        now = time.monotonic()
        return _reply(
            FleetModel(
                map=None if grid is None else MapModel(**grid),
                robots=[self._model(robot, now) for robot in self._view.robots()],
                blocked=self._view.blocked(),
                pending=self._view.pending(),
                blocks=[CellBlockModel(**block) for block in self._view.blocks()],
                age=self._view.planner_age(now),
            )
        )

    @ROUTES.route("GET", "/robots/{robot}", "One robot", reply=RobotModel, errors=(*_VIEW_ERRORS, 404))
    async def get_robot(self, request: web.Request) -> web.StreamResponse:
        """Return one robot."""
        wanted = request.match_info["robot"]
        for robot in self._view.robots():
            if robot["id"] == wanted:
                return _reply(self._model(robot, time.monotonic()))
        known = ", ".join(self._view.robot_ids()) or "none yet"
        return problem(404, f"robot {wanted!r} is unknown; known robots: {known}")

    def _model(self, robot: dict[str, Any], now: float) -> RobotModel:
        age = self._view.age(robot["id"], now)
        return RobotModel(**robot, age=self._view.planner_age(now) if age is None else age)

    @ROUTES.route(
        "PUT",
        "/robots/{robot}/goal",
        "Send a robot to a cell",
        body=GoalRequest,
        reply=Answer,
        errors=_CONTROL_ERRORS,
    )
    async def put_goal(self, request: web.Request) -> web.StreamResponse:
        """Send a robot to a cell."""
        robot = request.match_info["robot"]
        refusal = self._access.control_refusal(request, "set_goal", robot)
        if refusal is not None:
            return refusal
        asked = GoalRequest.model_validate_json(await self._access.read_body(request))
        message = await self.fleet_api.set_goal(robot, asked.cell, user=request[USER])
        self._access.audit(request, "set_goal", robot, "stop" if asked.cell is None else f"cell {asked.cell}")
        return _reply(Answer(message=message))

    @ROUTES.route(
        "PUT",
        "/cells/{cell}",
        "Block or free a cell",
        body=CellRequest,
        reply=Answer,
        errors=_CONTROL_ERRORS,
    )
    async def put_cell(self, request: web.Request) -> web.StreamResponse:
        """Block or free a cell."""
        number = request.match_info["cell"]
        if not number.isdecimal() or len(number) > MAX_DIGITS or int(number) > MAX_CELL:
            return problem(404, f"{number[:SHOWN]!r} is not the number of a cell")
        refusal = self._access.control_refusal(request, "block_cell", number)
        if refusal is not None:
            return refusal
        asked = CellRequest.model_validate_json(await self._access.read_body(request))
        user = request[USER]
        message = await self.fleet_api.block_cell(int(number), asked, user=user)
        detail = asked.reason if asked.blocked else ""
        self._access.audit(request, "block_cell" if asked.blocked else "free_cell", number, detail)
        return _reply(Answer(message=message))

    @ROUTES.route(
        "POST",
        "/grid/preview",
        "Another grid of cells, without taking it over",
        body=GridRequest,
        reply=GridAnswer,
        errors=_CONTROL_ERRORS,
    )
    async def preview_grid(self, request: web.Request) -> web.StreamResponse:
        """Return another grid."""
        return await self._lay_grid(request, preview=True)

    @ROUTES.route(
        "PUT",
        "/grid",
        "Change the grid of cells; robots must stand, and their goals are removed",
        body=GridRequest,
        reply=GridAnswer,
        errors=_CONTROL_ERRORS,
    )
    async def put_grid(self, request: web.Request) -> web.StreamResponse:
        """Change the grid."""
        return await self._lay_grid(request, preview=False)

    async def _lay_grid(self, request: web.Request, *, preview: bool) -> web.StreamResponse:
        refusal = self._access.control_refusal(request, "set_grid", "grid")
        if refusal is not None:
            return refusal
        asked = GridRequest.model_validate_json(await self._access.read_body(request))
        choice = complete_grid(asked, self._view.map())
        answer = await self._fleet.set_grid(choice, preview=preview)
        made = grid_answer(choice, answer)
        if not preview:
            detail = f"{made.columns} x {made.rows} cells of {made.cell_size:g} m at {tuple(made.origin)},"
            self._access.audit(request, "set_grid", "grid", f"{detail} yaw {made.yaw:g}")
        return _reply(made)

    def _tell_manager(self, here: bool) -> None:
        """Tell all pages whether there is a fleet manager, which they may ask.

        What went to the planner while the manager was away is the manager's matter from now on.
        """
        if here:
            self._fleet.forget_requests()
        self._pages.send("manager", json.dumps({"type": "manager", "here": here}))

    def _tell_restart(self) -> None:
        """Tell all pages that the fleet manager lost its journal."""
        text = str(EventsRestartedError(self.fleet_api.feed.journal))
        self._pages.send_kept_event(json.dumps({"type": "event", "text": text, "tone": "bad"}))

    def _tell_audit(self, user: str, action: AuditedAction) -> None:
        """Show all pages who did what."""
        told = {"type": "audit", "time": time.time(), "user": user, "name": action.name}
        told |= {"subject": action.subject, "detail": action.detail, "done": action.done}
        self._pages.send_kept_event(json.dumps(told))


@web.middleware
async def _problems(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Turn exceptions into error responses."""
    try:
        return await handler(request)
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, fault['loc'])) or 'body'}: {fault['msg']}" for fault in error.errors()]
        return problem(400, "; ".join(faults))
    except AuthenticationError as error:
        headers = {"Retry-After": str(error.retry_after)} if error.retry_after else None
        return problem(error.status, str(error), headers)
    except PlannerUnavailableError as error:
        return problem(503, str(error))
    except (PlannerError, RequestRefusedError) as error:
        return problem(409, str(error))
    except web.HTTPException as error:
        kept = {"Allow": error.headers["Allow"]} if "Allow" in error.headers else None
        return problem(error.status, error.reason, kept)


async def _set_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Have browsers ask whether pages and scripts have changed, and show them in no other site's frame.

    Scripts of another release would not fit the page, and clicks on a hidden frame would control robots.
    """
    if not request.path.startswith(PREFIX):
        response.headers.setdefault(hdrs.CACHE_CONTROL, "no-cache")
    response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
    response.headers["X-Frame-Options"] = "DENY"
    response.headers["X-Content-Type-Options"] = "nosniff"


def _reply(model: BaseModel) -> web.Response:
    return web.Response(text=model.model_dump_json(), content_type="application/json")


def _document_of(operations: list[Operation]) -> str:
    document = build_document(
        [replace(each, errors=tuple({*each.errors, 422, 429})) for each in operations],
        title="RCE operator station",
        description="Control a fleet of robots: tasks, goals, zones, events. For the page and an ERP.",
        error=Problem,
    )
    return json.dumps(document)
