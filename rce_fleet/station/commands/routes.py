"""The routes of what reaches robots without the planner: emergency stop, initial pose, driving by hand."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import TYPE_CHECKING, Literal

from aiohttp import WSCloseCode, WSMsgType, web
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rce.aio.tasks import cancel_and_wait
from rce.web.bodies import read_whole
from rce.web.closing import close_socket
from rce.web.routes import Route, RouteTable
from rce_fleet.station.access import EMERGENCY_STOP, IS_CHECKED, USER, AccessControl, problem
from rce_fleet.station.api import Answer
from rce_fleet.station.commands.driving import DEAD_S, DriveFrame, DriveGuard
from rce_fleet.station.commands.sources import CommandError
from rce_fleet.station.commands.velocity_sender import velocity_sender
from rce_fleet.station.planner_client import PlannerError

if TYPE_CHECKING:
    from rce_fleet.station.commands.control import RobotControl
    from rce_fleet.station.commands.manual_mode import ManualHold, ManualModes
    from rce_fleet.station.commands.velocity_sender import VelocitySender
    from rce_fleet.station.fleet_api import FleetApi

MAX_FRAME = 1 << 12
CHECK_S = 2.0
"""How often the login of a user who drives a robot is checked."""
END_S = 3.0
"""How long the station's end waits until robots that are driven have their own modes again."""
_ENDS = "the station ends"
_ERRORS = (400, 401, 403, 404, 408, 409, 413, 421, 503)

Method = Callable[["ControlRoutes", web.Request], Awaitable[web.StreamResponse]]
ROUTES: RouteTable[Route[Method]] = RouteTable("fleet", Route)
"""Routes that do not need the planner."""


class StopRequest(BaseModel):
    """An emergency stop."""

    model_config = ConfigDict(extra="forbid")

    stopped: bool = Field(description="True: stand at once; false: release.")


class StopAnswer(Answer):
    """What an emergency stop, or its release, has reached."""

    missed: list[str] = Field(description="Robots that were not reached; they get it as soon as they are.")


class ModeRequest(BaseModel):
    """Whether the fleet drives."""

    model_config = ConfigDict(extra="forbid")

    mode: Literal["automatic", "paused"] = Field(description="paused: robots get no new cells and stand.")
    reason: str = Field(default="", max_length=500)


class PoseRequest(BaseModel):
    """Where a robot is, for its localization."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    x: float = Field(description="Metres, in the map frame.", ge=-1e6, le=1e6)
    y: float = Field(description="Metres.", ge=-1e6, le=1e6)
    yaw: float = Field(default=0.0, description="Radians, counter-clockwise from x.", ge=-10, le=10)


class ControlRoutes:
    """Handlers of these routes.

    Args:
        control: Reaches the robots; None: this station cannot.
        fleet: Sets the fleet's mode.
        modes: Tells the planner which robot is driven by hand.
        access: Checks what users may do.
    """

    def __init__(
        self, control: RobotControl | None, fleet: FleetApi, modes: ManualModes, access: AccessControl
    ) -> None:
        self._control = control
        self._fleet = fleet
        self._modes = modes
        self._access = access
        self._ending = asyncio.Event()
        self._drives: set[asyncio.Future[None]] = set()
        """Of each robot that is driven; done when it stands and the planner was told."""

    @ROUTES.route(
        "PUT",
        EMERGENCY_STOP,
        "Stop all robots at once, or release them; works without the planner",
        body=StopRequest,
        reply=StopAnswer,
        errors=_ERRORS,
    )
    async def stop_all(self, request: web.Request) -> web.StreamResponse:
        """Stop or release all robots."""
        return await self._stop(request, None)

    @ROUTES.route(
        "PUT",
        f"/robots/{{robot}}{EMERGENCY_STOP}",
        "Stop a robot at once, or release it; works without the planner",
        body=StopRequest,
        reply=StopAnswer,
        errors=_ERRORS,
    )
    async def stop_one(self, request: web.Request) -> web.StreamResponse:
        """Stop or release a robot."""
        return await self._stop(request, request.match_info["robot"])

    async def _stop(self, request: web.Request, robot: str | None) -> web.StreamResponse:
        subject = robot or "all robots"
        refusal = self._access.control_refusal(request, "emergency_stop", subject)
        if refusal is not None:
            return refusal
        began = time.monotonic()
        asked = StopRequest.model_validate_json(await read_whole(request))
        if not asked.stopped and not request[IS_CHECKED]:
            return problem(503, "robots are released when the engine can be reached to check the login")
        if not asked.stopped:
            await self._access.check_after(request, began)
        if self._control is None:
            return problem(409, "this station cannot reach robots")
        robots = None if robot is None else [robot]
        result = await self._control.emergency_stop(robots, request[USER].name, stopped=asked.stopped)
        done = (bool(result.reached) or not asked.stopped) and not result.missed
        name = "emergency_stop" if asked.stopped else "release_emergency_stop"
        self._access.audit(request, name, subject, result.text, done=done)
        if asked.stopped and not result.reached and not result.missed:
            return problem(409, "no robot is known yet; robots are stopped when they appear")
        if result.missed and not (robot is None and result.reached):
            return problem(409, result.text)
        text = f"{'stopped' if asked.stopped else 'released'}: {result.text}"
        return _reply(StopAnswer(message=text, missed=sorted(result.missed)))

    @ROUTES.route(
        "PUT",
        "/robots/{robot}/pose",
        "Tell a robot's localization where the robot is",
        body=PoseRequest,
        reply=Answer,
        errors=_ERRORS,
    )
    async def put_pose(self, request: web.Request) -> web.StreamResponse:
        """Set a robot's initial pose."""
        robot = request.match_info["robot"]
        refusal = self._access.control_refusal(request, "set_pose", robot)
        if refusal is not None:
            return refusal
        asked = PoseRequest.model_validate_json(await self._access.read_body(request))
        if self._control is None:
            return problem(409, "this station cannot reach robots")
        try:
            await self._control.set_pose(robot, asked.x, asked.y, asked.yaw)
        except CommandError as error:
            return problem(409, str(error))
        self._access.audit(request, "set_pose", robot, f"x {asked.x:g}, y {asked.y:g}, yaw {asked.yaw:g}")
        return _reply(Answer(message=f"{robot} is told that it is at ({asked.x:.2f}, {asked.y:.2f})"))

    @ROUTES.route(
        "PUT",
        "/mode",
        "Pause the fleet, or let it drive again",
        body=ModeRequest,
        reply=Answer,
        errors=_ERRORS,
    )
    async def put_mode(self, request: web.Request) -> web.StreamResponse:
        """Set the fleet's mode."""
        refusal = self._access.control_refusal(request, "set_mode", "fleet")
        if refusal is not None:
            return refusal
        asked = ModeRequest.model_validate_json(await self._access.read_body(request))
        message = await self._fleet.set_mode(asked.mode, reason=asked.reason, user=request[USER])
        self._access.audit(request, "set_mode", "fleet", asked.mode)
        return _reply(Answer(message=message))

    # Driving by hand

    async def drive(self, request: web.Request) -> web.StreamResponse:
        """Let a page drive a robot over a WebSocket, until it disconnects.

        The page sends frames (:class:`DriveFrame`) and gets an answer to each: its number, what the robot was
        told, why it stands, and the round trip from the station to the robot. The robot stops if no frame
        comes for 0.4 s. Driving ends when the robot is not manual any more.
        """
        robot = request.match_info["robot"]
        refusal = self._access.control_refusal(request, "drive", robot)
        if refusal is not None:
            return refusal
        control = self._control
        if control is None:
            return problem(409, "this station cannot reach robots")
        if self._ending.is_set():
            return problem(503, _ENDS)
        socket = web.WebSocketResponse(heartbeat=5.0, compress=False, max_msg_size=MAX_FRAME)
        await socket.prepare(request)
        user = request[USER].name
        if not control.begin_driving(robot, user):
            await _refuse(request, socket, f"{robot} is driven by {control.driven[robot]}")
            return socket
        ended = asyncio.get_running_loop().create_future()
        self._drives.add(ended)
        try:
            async with (
                self._modes.manual(robot, user) as hold,
                self._sender(request, control, robot) as sender,
            ):
                may_drive = partial(self._access.is_still_allowed, request, to_control=True)
                await _drive(request, socket, sender, hold, may_drive, self._ending)
        except (CommandError, PlannerError) as error:
            await _refuse(request, socket, str(error))
        finally:
            control.end_driving(robot)  # last: the next one to drive it shall not lose the mode manual
            self._drives.discard(ended)
            ended.set_result(None)
        if self._ending.is_set():  # the page may be away, so nothing waits for it
            await close_socket(request, socket, code=WSCloseCode.GOING_AWAY, reason=_ENDS)
        return socket

    async def end_drives(self) -> None:
        """Stop all robots that are driven by hand, and give them their own modes again; drive no others.

        It takes a few seconds at most; the planner may be away.
        """
        self._ending.set()
        if self._drives:
            await asyncio.wait(self._drives, timeout=END_S)

    @contextlib.asynccontextmanager
    async def _sender(
        self, request: web.Request, control: RobotControl, robot: str
    ) -> AsyncIterator[VelocitySender]:
        """Give what sends velocities; the robot stands at the end."""
        async with velocity_sender(control, robot) as sender:
            self._access.audit(request, "drive", robot, "begin")
            try:
                yield sender
            finally:
                self._access.audit(request, "drive", robot, "end")


async def _drive(
    request: web.Request,
    socket: web.WebSocketResponse,
    sender: VelocitySender,
    hold: ManualHold,
    may_drive: Callable[[], Awaitable[bool]],
    ending: asyncio.Event,
) -> None:
    """Pass frames on until the page leaves, the robot has another mode, or user or station end."""
    guard = DriveGuard(sender.round_trip)
    reader = asyncio.create_task(_pass_on(request, socket, sender, hold, guard))
    watcher, checker = asyncio.create_task(_stop(sender, hold, guard)), asyncio.create_task(_check(may_drive))
    other, end = asyncio.create_task(hold.until_other_mode()), asyncio.create_task(ending.wait())
    try:
        await asyncio.wait([reader, checker, other, end], return_when=asyncio.FIRST_COMPLETED)
        if reader.done():
            reader.result()
            return
        if end.done():
            return
        if checker.done():
            checker.result()
        why = other.result() if other.done() else ""
    finally:
        await cancel_and_wait(reader, watcher, checker, other, end)
    sender.send(0.0, 0.0)
    if why:
        await _refuse(request, socket, why)
    else:
        text = "you may not drive this robot any more; log in again"
        await close_socket(request, socket, code=WSCloseCode.POLICY_VIOLATION, reason=text)


async def _stop(sender: VelocitySender, hold: ManualHold, guard: DriveGuard) -> None:
    """Stop the robot while frames or answers are missing, or the planner may drive it, until cancelled."""
    loop = asyncio.get_running_loop()
    while True:
        await asyncio.sleep(DEAD_S / 4)
        if guard.check(loop.time()) or _why_not(sender, hold):
            sender.send(0.0, 0.0)


def _why_not(sender: VelocitySender, hold: ManualHold) -> str:
    """Return why the robot must stand, whatever the page asks for; empty: it may drive."""
    return hold.why_not or ("" if sender.is_connected else "the robot is not connected")


async def _check(may_drive: Callable[[], Awaitable[bool]]) -> None:
    """Wait until the user may not drive any more."""
    while True:
        await asyncio.sleep(CHECK_S)
        if not await may_drive():
            break


async def _pass_on(
    request: web.Request,
    socket: web.WebSocketResponse,
    sender: VelocitySender,
    hold: ManualHold,
    guard: DriveGuard,
) -> None:
    """Send the robot what the frames of a page say, until the page leaves."""
    loop = asyncio.get_running_loop()
    with contextlib.suppress(ConnectionError):  # the page leaves while it is answered
        async for message in socket:
            if message.type is not WSMsgType.TEXT:
                break
            try:
                frame = DriveFrame.model_validate_json(message.data)
            except ValidationError as error:
                sender.send(0.0, 0.0)
                await _refuse(request, socket, f"not a frame: {error.errors()[0]['msg']}")
                break
            speed, turn_rate = guard.take(frame, loop.time(), _why_not(sender, hold))
            sender.send(speed, turn_rate)
            answer = {
                "number": frame.number,
                "speed": speed,
                "turn_rate": turn_rate,
                "reason": guard.reason,
                "robot_round_trip": sender.round_trip.seconds(loop.time()),
            }
            await socket.send_str(json.dumps(answer))


async def _refuse(request: web.Request, socket: web.WebSocketResponse, text: str) -> None:
    await close_socket(request, socket, last=json.dumps({"error": text}))


def _reply(model: BaseModel) -> web.Response:
    return web.Response(text=model.model_dump_json(), content_type="application/json")
