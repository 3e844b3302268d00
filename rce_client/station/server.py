"""The station's HTTP server: the page, its live socket, and the API for an ERP."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
from collections.abc import Awaitable, Callable
from pathlib import Path

from aiohttp import WSMsgType, hdrs, web
from pydantic import BaseModel, ValidationError

from rce.web.bodies import read_whole
from rce.web.openapi import PREFIX, Operation, build_document
from rce.web.origin import ServerNames, is_foreign
from rce_client.station.api import (
    Answer,
    CellRequest,
    FleetModel,
    GoalRequest,
    MapModel,
    Problem,
    RobotModel,
)
from rce_client.station.fleet_link import FleetError, FleetLink, PlannerAwayError
from rce_client.station.live import Broadcast, Page
from rce_client.station.view import FleetView

STATIC = Path(__file__).parent / "static"
MAX_BODY = 1 << 16
MIN_FRAME_S = 0.05
"""Least time between two batches of messages to one page."""
HEARTBEAT_S = 20.0

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Station:
    """Handlers of all routes.

    Args:
        view: What is known of the fleet.
        fleet: Carries wishes to the planner.
        pages: The open pages.
        token: If not empty, callers must show it as a bearer token; pages as ``?token=`` of the page's URL.
        names: By which the station may be asked for.
    """

    def __init__(
        self,
        view: FleetView,
        fleet: FleetLink,
        pages: Broadcast,
        *,
        token: str = "",
        names: ServerNames | None = None,
    ) -> None:
        self._names = names or ServerNames()
        self._view = view
        self._fleet = fleet
        self._pages = pages
        self._token = token

    def make_app(self) -> web.Application:
        """Build the application."""
        app = web.Application(middlewares=[self._guard, _problems], client_max_size=MAX_BODY)
        for known, handler in self._operations():
            app.router.add_route(known.method, PREFIX + known.path, handler)
        document = build_document(
            [known for known, _ in self._operations()],
            title="RCE operator station",
            description="Steers a fleet of robots: goals and blocked cells. For an ERP and for the page.",
            error=Problem,
        )

        async def describe(request: web.Request) -> web.StreamResponse:
            del request
            return web.json_response(document)

        app.router.add_get(f"{PREFIX}/openapi.json", describe)
        app.router.add_get(f"{PREFIX}/live", self.live)
        app.router.add_get("/", self.page)
        app.router.add_static("/static", STATIC)
        return app

    def _operations(self) -> list[tuple[Operation, Handler]]:
        return [
            (
                Operation(
                    name="get_fleet",
                    method="GET",
                    path="/fleet",
                    summary="The whole fleet",
                    group="fleet",
                    reply=FleetModel,
                ),
                self.get_fleet,
            ),
            (
                Operation(
                    name="get_robot",
                    method="GET",
                    path="/robots/{robot}",
                    summary="One robot",
                    group="fleet",
                    reply=RobotModel,
                ),
                self.get_robot,
            ),
            (
                Operation(
                    name="put_goal",
                    method="PUT",
                    path="/robots/{robot}/goal",
                    summary="Send a robot to a cell",
                    group="fleet",
                    body=GoalRequest,
                    reply=Answer,
                ),
                self.put_goal,
            ),
            (
                Operation(
                    name="put_cell",
                    method="PUT",
                    path="/cells/{cell}",
                    summary="Block or free a cell",
                    group="fleet",
                    body=CellRequest,
                    reply=Answer,
                ),
                self.put_cell,
            ),
        ]

    # Handlers

    async def page(self, request: web.Request) -> web.StreamResponse:
        """The page itself."""
        del request
        return web.FileResponse(STATIC / "index.html", headers={hdrs.CACHE_CONTROL: "no-cache"})

    async def get_fleet(self, request: web.Request) -> web.StreamResponse:
        """Everything that is known of the fleet."""
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

    async def get_robot(self, request: web.Request) -> web.StreamResponse:
        """One robot."""
        wanted = request.match_info["robot"]
        for robot in self._view.robots():
            if robot["id"] == wanted:
                return _reply(RobotModel(**robot))
        known = ", ".join(self._view.robot_ids()) or "none yet"
        return _problem(404, f"there is no robot {wanted!r}; known are: {known}")

    async def put_goal(self, request: web.Request) -> web.StreamResponse:
        """Send a robot to a cell."""
        wish = GoalRequest.model_validate_json(await read_whole(request))
        return _reply(Answer(message=await self._fleet.set_goal(request.match_info["robot"], wish.cell)))

    async def put_cell(self, request: web.Request) -> web.StreamResponse:
        """Block or free a cell."""
        number = request.match_info["cell"]
        if not number.isdecimal():
            return _problem(404, f"{number!r} is not the number of a cell")
        wish = CellRequest.model_validate_json(await read_whole(request))
        return _reply(Answer(message=await self._fleet.block_cell(int(number), blocked=wish.blocked)))

    async def live(self, request: web.Request) -> web.StreamResponse:
        """Send a page what changes, until it goes."""
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, compress=False)
        await socket.prepare(request)
        page = self._pages.open()
        writer = asyncio.create_task(_write(socket, page))
        try:
            async for message in socket:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    continue
        finally:
            self._pages.close(page)
            writer.cancel()
            await asyncio.gather(writer, return_exceptions=True)
        return socket

    # Who may come in

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        refusal = self._names.refusal(request.headers.get(hdrs.HOST, ""))
        if refusal is not None:
            return _problem(421, refusal)
        if is_foreign(request.headers.get(hdrs.ORIGIN), request.host):
            return _problem(403, "a page of another site may not use the station")
        if not self._token:
            return await handler(request)
        shown = request.query.get("token") or request.cookies.get("rce_station", "")
        bearer = request.headers.get(hdrs.AUTHORIZATION, "").removeprefix("Bearer ").strip()
        if not any(hmac.compare_digest(text.encode(), self._token.encode()) for text in (shown, bearer)):
            return _problem(401, "the station wants its token: as 'Authorization: Bearer', or ?token= once")
        response = await handler(request)
        if request.query.get("token") and not response.prepared:
            response.set_cookie(
                "rce_station", self._token, httponly=True, samesite="Strict", secure=request.secure
            )
        return response


async def _write(socket: web.WebSocketResponse, page: Page) -> None:
    with contextlib.suppress(ConnectionError):
        while True:
            for text in await page.take():
                await socket.send_str(text)
            await asyncio.sleep(MIN_FRAME_S)


@web.middleware
async def _problems(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Turn what goes wrong into an answer that says so."""
    try:
        return await handler(request)
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, fault['loc'])) or 'body'}: {fault['msg']}" for fault in error.errors()]
        return _problem(400, "; ".join(faults))
    except PlannerAwayError as error:
        return _problem(503, str(error))
    except FleetError as error:
        return _problem(409, str(error))
    except web.HTTPException as error:
        return _problem(error.status, error.reason)


def _reply(model: BaseModel) -> web.Response:
    return web.Response(text=model.model_dump_json(), content_type="application/json")


def _problem(status: int, text: str) -> web.Response:
    return web.json_response({"error": text}, status=status)
