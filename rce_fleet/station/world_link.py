"""The link to a simulated world: its truth, and what an operator changes in it.

The world's services are those of ``docs/reference/simulation.md``. Places of robots, boxes and people come as
``gazebo_msgs/ModelStates``; what each of them is, and whether time stands still, on ``/simulation/things``.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Awaitable, Callable
from math import cos, sin
from typing import TYPE_CHECKING, Any, Literal

from aiohttp import web
from pydantic import BaseModel, ConfigDict, Field

from rce.ros.closing import release
from rce.ros.errors import RosError
from rce.ros.node import Node
from rce.web.routes import Route, RouteTable
from rce_fleet.geometry.angles import yaw_of
from rce_fleet.station.access import AccessControl, problem
from rce_fleet.station.api import Answer
from rce_fleet.station.ros_subscriptions import subscribe_when_reachable

if TYPE_CHECKING:
    from rce.ros.types import Message, TypeRegistry

_log = logging.getLogger(__name__)

STATES_EVERY_S = 0.1
CALL_S = 5.0
LOOK_AWAY_S = 2.0
"""Seconds between two looks whether there is still a page."""
_ERRORS = (400, 401, 403, 404, 408, 409, 413, 421, 503)


class WorldRequest(BaseModel):
    """What is done with the simulated world."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    action: Literal["pause", "resume", "reset", "add_box", "add_robot", "add_person", "move", "remove"]
    name: str = Field(default="", description="What is added, moved or removed.", max_length=100)
    x: float = Field(default=0.0, description="Metres, in the map frame.", ge=-1e6, le=1e6)
    y: float = Field(default=0.0, description="Metres.", ge=-1e6, le=1e6)
    yaw: float = Field(default=0.0, description="Radians.", ge=-10, le=10)
    to: tuple[float, float] | None = Field(
        default=None, description="Where an added person walks to and comes back from, metres; null: nowhere."
    )


class WorldError(Exception):
    """The world refused something, or cannot be reached."""


class WorldLink:
    """A node in the graph of a simulated world.

    Args:
        master_uri: The ROS master of the world's graph.
        types: Where message types come from.
        on_states: Called with [name, x, y, yaw] of everything in the world, at most ten times a second.
        on_things: Called with what ``/simulation/things`` says, when that changed.
        wanted: Set while a page is open: the world's truth is received only then. None: always.
    """

    def __init__(
        self,
        master_uri: str,
        types: TypeRegistry,
        on_states: Callable[[list[list[Any]]], None],
        wanted: asyncio.Event | None = None,
        on_things: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self._node = Node(
            "operator_station_world",
            anonymous=True,
            argv=(),
            master_uri=master_uri,
            types=types,
            signals=False,
            master_timeout=None,
            rosout=False,
        )
        self._on_states = on_states
        self._wanted = wanted
        self._on_things = on_things
        self._told = float("-inf")
        self._newest: Message | None = None
        """What is not told yet."""

    async def run(self) -> None:
        """Receive the world's truth until cancelled."""
        async with self._node as node:
            if self._on_things is not None:
                await subscribe_when_reachable(
                    node, "/simulation/things", "std_msgs/String", self._take_things
                )
            while True:
                if self._wanted is not None:
                    await self._wanted.wait()
                states = await subscribe_when_reachable(
                    node, "/gazebo/model_states", "gazebo_msgs/ModelStates", self._take
                )
                # A page that is loaded again is back before it is noticed.
                while self._wanted is None or self._wanted.is_set():  # noqa: ASYNC110 - see above
                    await asyncio.sleep(LOOK_AWAY_S)
                await release(states)

    def _take_things(self, message: Message) -> None:
        try:
            things = json.loads(message.data)
        except ValueError as error:
            _log.warning("/simulation/things is ignored: expected JSON: %s", error)
            return
        if self._on_things is not None:
            self._on_things(things)

    def _take(self, message: Message) -> None:
        """Keep the newest places until they are due: a paused world says them only once."""
        if self._newest is None:
            loop = asyncio.get_running_loop()
            loop.call_later(max(0.0, self._told + STATES_EVERY_S - loop.time()), self._tell)
        self._newest = message

    def _tell(self) -> None:
        message, self._newest = self._newest, None
        if message is None:
            return
        self._told = asyncio.get_running_loop().time()
        self._on_states(
            [
                [
                    name,
                    round(pose.position.x, 3),
                    round(pose.position.y, 3),
                    round(yaw_of(*(getattr(pose.orientation, axis) for axis in "xyzw")), 3),
                ]
                for name, pose in zip(message.name, message.pose, strict=True)
            ]
        )

    async def act(self, asked: WorldRequest) -> str:
        """Change the world; return what was done.

        Raises:
            WorldError: The world refused it, or cannot be reached.
        """
        half = asked.yaw / 2
        orientation = {"x": 0.0, "y": 0.0, "z": sin(half), "w": cos(half)}
        pose = {"position": {"x": asked.x, "y": asked.y, "z": 0.0}, "orientation": orientation}
        said = ""
        match asked.action:
            case "pause" | "resume":
                await self._call(asked.action, "std_srvs/Empty", {})
            case "reset":
                await self._call("reset_world", "std_srvs/Empty", {})
            case "add_box" | "add_robot" | "add_person":
                request = {"model_name": asked.name, "model_xml": _description(asked), "initial_pose": pose}
                said = await self._call("spawn", "gazebo_msgs/SpawnModel", request)
            case "move":
                state = {"model_name": asked.name, "pose": pose, "reference_frame": "map"}
                said = await self._call("move", "gazebo_msgs/SetModelState", {"model_state": state})
            case "remove":
                said = await self._call("remove", "gazebo_msgs/DeleteModel", {"model_name": asked.name})
        return f"simulated world: {said or asked.action.replace('_', ' ')}"

    async def _call(self, name: str, type_name: str, request: dict[str, Any]) -> str:
        """Call a service of the world; return what it says."""
        try:
            client = self._node.service_client(f"/simulation/{name}", type_name, persistent=False)
            try:
                answer = await client.call(request, timeout=CALL_S)
            finally:
                await client.close()
        except RosError as error:
            raise WorldError(f"the simulated world does not answer: {error}") from error
        if not getattr(answer, "success", True):
            raise WorldError(answer.status_message)
        return str(getattr(answer, "status_message", ""))


def _description(asked: WorldRequest) -> str:
    """Return what is spawned, as in a scene."""
    if asked.action == "add_box":
        return "{box: [0.6, 0.6]}"
    if asked.action == "add_robot":
        return "{robot: turtlebot2, sensor: lidar}"
    return json.dumps({"walker": [] if asked.to is None else [asked.to]})


Method = Callable[["WorldRoutes", web.Request], Awaitable[web.StreamResponse]]
ROUTES: RouteTable[Route[Method]] = RouteTable("fleet", Route)
"""Routes of the simulated world."""


class WorldRoutes:
    """Handlers of these routes.

    Args:
        world: The world; None: there is none.
        access: Checks what users may do.
    """

    def __init__(self, world: WorldLink | None, access: AccessControl) -> None:
        self._world = world
        self._access = access

    @ROUTES.route(
        "POST",
        "/simulation",
        "Pause, reset or change the simulated world",
        body=WorldRequest,
        reply=Answer,
        errors=_ERRORS,
    )
    async def act(self, request: web.Request) -> web.StreamResponse:
        """Change the simulated world."""
        refusal = self._access.control_refusal(request, "simulation", "world")
        if refusal is not None:
            return refusal
        asked = WorldRequest.model_validate_json(await self._access.read_body(request))
        if self._world is None:
            return problem(404, "this station has no simulated world; start it with --world URI")
        try:
            message = await self._world.act(asked)
        except WorldError as error:
            return problem(409, str(error))
        self._access.audit(request, "simulation", asked.name or "world", asked.action)
        return web.Response(text=Answer(message=message).model_dump_json(), content_type="application/json")


def states_text(states: list[list[Any]]) -> str:
    """Return the message for pages: what is in the world."""
    return json.dumps({"type": "world", "models": states}, separators=(",", ":"))


def things_text(things: dict[str, Any]) -> str:
    """Return the message for pages: what the things in the world are, and whether time stands still."""
    return json.dumps({**things, "type": "things"}, separators=(",", ":"))
