"""The station's HTTP server: the page, its live socket, and the API for an ERP."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

from aiohttp import WSCloseCode, WSMsgType, hdrs, web
from pydantic import BaseModel, ValidationError

from rce.aio.tasks import cancel_and_wait
from rce.web.bodies import read_whole
from rce.web.openapi import PREFIX, build_document
from rce.web.origin import ServerNames
from rce.web.routes import Route, RouteTable
from rce_fleet.station.access import COOKIE, USER, AccessControl, problem, set_cookie, token_of
from rce_fleet.station.api import (
    MAX_CELL,
    Answer,
    CellRequest,
    FleetModel,
    GoalRequest,
    GridAnswer,
    GridRequest,
    LayersRequest,
    LoginRequest,
    MapModel,
    Problem,
    RobotModel,
    UserModel,
)
from rce_fleet.station.authentication import AuthenticationError, Authenticator, TokenAuthenticator
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.grids import complete_grid, grid_answer
from rce_fleet.station.layers.hub import LayerHub
from rce_fleet.station.live import Broadcast, Page
from rce_fleet.station.planner_client import PlannerError, PlannerUnavailableError
from rce_fleet.station.view import FleetView

STATIC = Path(__file__).parent / "static"
MAX_BODY = 1 << 16
MAX_DIGITS = 20
"""Digits of a cell's number; Python parses at most 4300."""
SHOWN = 80
"""Characters of an invalid name that an error repeats."""
MIN_FRAME_S = 0.05
"""Minimum time between two batches of messages to one page."""
HEARTBEAT_S = 20.0
CHECK_S = 5.0
"""How often the login of an open page is checked."""

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
    ) -> None:
        self._layers = layers
        self._view = view
        self._fleet = fleet
        self._pages = pages
        self._authenticator = authenticator or TokenAuthenticator()
        self._access = AccessControl(self._authenticator, names or ServerNames())

    def make_app(self) -> web.Application:
        """Build the application."""
        app = web.Application(middlewares=[_problems, self._access.check], client_max_size=MAX_BODY)
        for route in ROUTES:
            app.router.add_route(route.method, PREFIX + route.path, partial(route.handler, self))
        document = build_document(
            [route.operation for route in ROUTES],
            title="RCE operator station",
            description="Control a fleet of robots: set goals, block cells. Used by the page and by an ERP.",
            error=Problem,
        )

        async def describe(request: web.Request) -> web.StreamResponse:
            del request
            return web.json_response(document)

        app.router.add_get(f"{PREFIX}/openapi.json", describe)
        app.router.add_get(f"{PREFIX}/live", self.live)
        app.router.add_get("/login", self.login_page)
        app.router.add_get("/", self.page)
        app.router.add_static("/static", STATIC)
        return app

    # Handlers

    async def page(self, request: web.Request) -> web.StreamResponse:
        """Return the page."""
        del request
        return web.FileResponse(STATIC / "index.html", headers={hdrs.CACHE_CONTROL: "no-cache"})

    async def login_page(self, request: web.Request) -> web.StreamResponse:
        """Return the login page."""
        del request
        return web.FileResponse(STATIC / "login.html", headers={hdrs.CACHE_CONTROL: "no-cache"})

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
        set_cookie(response, token, secure=request.secure)
        return response

    @ROUTES.route(
        "DELETE", "/login", "Revoke the token of this request", group="login", status=204, errors=(403, 421)
    )
    async def log_out(self, request: web.Request) -> web.StreamResponse:
        """Revoke the request's token and delete the cookie."""
        await self._authenticator.log_out(token_of(request))
        response = web.Response(status=204)
        response.del_cookie(COOKIE)
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
                logged_in=self._authenticator.has_logins,
            )
        )

    @ROUTES.route("GET", "/fleet", "The whole fleet", reply=FleetModel, errors=_VIEW_ERRORS)
    async def get_fleet(self, request: web.Request) -> web.StreamResponse:
        """Return the state of the fleet."""
        del request
        grid = self._view.map()
        return _reply(
            FleetModel(
                map=None if grid is None else MapModel(**grid),
                robots=[RobotModel(**robot) for robot in self._view.robots()],
                blocked=self._view.blocked(),
                pending=self._view.pending(),
            )
        )

    @ROUTES.route("GET", "/robots/{robot}", "One robot", reply=RobotModel, errors=(*_VIEW_ERRORS, 404))
    async def get_robot(self, request: web.Request) -> web.StreamResponse:
        """Return one robot."""
        wanted = request.match_info["robot"]
        for robot in self._view.robots():
            if robot["id"] == wanted:
                return _reply(RobotModel(**robot))
        known = ", ".join(self._view.robot_ids()) or "none yet"
        return problem(404, f"robot {wanted!r} is unknown; known robots: {known}")

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
        asked = GoalRequest.model_validate_json(await read_whole(request))
        message = await self._fleet.set_goal(robot, asked.cell)
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
        asked = CellRequest.model_validate_json(await read_whole(request))
        message = await self._fleet.block_cell(int(number), blocked=asked.blocked)
        self._access.audit(request, "block_cell" if asked.blocked else "free_cell", number)
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
        asked = GridRequest.model_validate_json(await read_whole(request))
        choice = complete_grid(asked, self._view.map())
        answer = await self._fleet.set_grid(choice, preview=preview)
        made = grid_answer(choice, answer)
        if not preview:
            detail = f"{made.columns} x {made.rows} cells of {made.cell_size:g} m at {tuple(made.origin)},"
            self._access.audit(request, "set_grid", "grid", f"{detail} yaw {made.yaw:g}")
        return _reply(made)

    async def live(self, request: web.Request) -> web.StreamResponse:
        """Send changes to a page until it disconnects.

        Without ``?changes=1`` it gets everything whenever something changes, as pages of 0.1 expect.
        """
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, compress=False, max_msg_size=MAX_BODY)
        await socket.prepare(request)
        page = self._pages.open(takes_changes=request.query.get("changes") == "1")
        writer = asyncio.create_task(_write(socket, page))
        watcher = asyncio.create_task(self._close_when_logged_out(socket, request))
        try:
            async for message in socket:
                if message.type is WSMsgType.TEXT and self._layers is not None:
                    self._show_layers(self._layers, page, message.data)
        finally:
            self._pages.close(page)
            if self._layers is not None:
                self._layers.leave(page)
            await cancel_and_wait(writer, watcher)
        return socket

    def _show_layers(self, layers: LayerHub, page: Page, text: str) -> None:
        """Set the layers that a page shows; tell the page if it cannot be read."""
        try:
            wanted = LayersRequest.model_validate_json(text)
        except ValidationError as error:
            fault = f"a page asked for something else than layers: {error.errors()[0]['msg']}"
            page.put_event(json.dumps({"type": "event", "text": fault, "tone": "bad"}))
            return
        layers.show(page, wanted.robot, wanted.layers)

    async def _close_when_logged_out(self, socket: web.WebSocketResponse, request: web.Request) -> None:
        """Close a page's socket when its user may not see the fleet any more."""
        while True:
            await asyncio.sleep(CHECK_S)
            if not await self._access.is_still_allowed(request):
                break
        await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=b"your login has ended; log in again")


async def _write(socket: web.WebSocketResponse, page: Page) -> None:
    with contextlib.suppress(ConnectionError):
        while True:
            for message in await page.take():
                if isinstance(message, bytes):
                    await socket.send_bytes(message)
                else:
                    await socket.send_str(message)
            await asyncio.sleep(MIN_FRAME_S)


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
    except PlannerError as error:
        return problem(409, str(error))
    except web.HTTPException as error:
        kept = {"Allow": error.headers["Allow"]} if "Allow" in error.headers else None
        return problem(error.status, error.reason, kept)


def _reply(model: BaseModel) -> web.Response:
    return web.Response(text=model.model_dump_json(), content_type="application/json")
