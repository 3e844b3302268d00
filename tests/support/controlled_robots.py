"""A station that stops and drives robots of a real ROS graph, and a page's side of it."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

from aiohttp import ClientWebSocketResponse
from aiohttp.test_utils import TestClient, TestServer

from rce.ros.core import Core
from rce.ros.node import Node, Subscriber
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, TypeRegistry
from rce_fleet.station.authentication import Authenticator, StationUser, TokenAuthenticator
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.sources import RosCommandSource
from rce_fleet.station.feed import Feed
from rce_fleet.station.layers.ros_source import RosLayerSource
from rce_fleet.station.planner_client import PlannerError
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView
from support.planner_states import robot, state

TYPES = TypeRegistry(PackageIndex([]))
LIMIT_S = 60


class RecordingFleet:
    """Stands for the planner: its services are not what is tested here."""

    knows_modes = True

    def __init__(self, view: FleetView) -> None:
        self.view = view
        self.run = ""
        self.modes: list[tuple[str, str]] = []
        self.refuses: set[str] = set()
        self.events: list[str] = []
        self.may_restore = asyncio.Event()
        self.may_restore.set()

    async def set_mode(self, robot: str, mode: str, *, reason: str, user: str) -> str:
        del reason, user
        if mode in self.refuses:
            raise PlannerError(f"{mode} is refused")
        self.modes.append((robot, mode))
        self.show(robot, mode, self.run)
        if mode != "manual":
            await self.may_restore.wait()
        return ""

    def show(self, robot: str, mode: str, run: str = "") -> None:
        """Have the view show another mode of a robot, of this run of the planner."""
        known = self.view.state
        assert known is not None
        shown = [{**one, "mode": mode} if one["id"] == robot else one for one in known["robots"]]
        self.view.on_state({**known, "robots": shown, "mode": self.view.mode, "started": run})

    def take_event(self, text: str, tone: str) -> None:
        assert tone == "bad"
        self.events.append(text)


@dataclass
class Site:
    """A station, and a robot in the same ROS graph."""

    client: TestClient[Any, Any]
    fleet: RecordingFleet
    control: RobotControl
    view: FleetView
    login: Login
    station: Station
    motor: Subscriber | None = None
    """The robot's subscription to velocities."""
    answers: bool = False
    """Whether the robot answers the times of velocities."""
    stops: deque[bool] = field(default_factory=deque)
    velocities: deque[tuple[float, float]] = field(default_factory=deque)
    poses: deque[Message] = field(default_factory=deque)

    async def until(self, holds: Callable[[], object]) -> None:
        async with asyncio.timeout(LIMIT_S):
            while not holds():
                await asyncio.sleep(0.02)

    async def put(self, path: str, body: dict[str, Any], token: str = "") -> tuple[int, str]:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        async with self.client.put(f"/api/v1{path}", json=body, headers=headers) as reply:
            answer = await reply.json()
            return reply.status, answer.get("message") or answer["error"]


class Login(TokenAuthenticator):
    """A login whose user can be changed; None: it was revoked."""

    def __init__(self) -> None:
        super().__init__()
        self.user: StationUser | None = StationUser("operator", "operator")

    async def authenticate(self, token: str) -> StationUser | None:
        del token
        return self.user


@asynccontextmanager
async def site(authenticator: Authenticator | None = None, robots: int = 2) -> AsyncIterator[Site]:
    """Run a station; all robots but Robot2 listen to emergency stops."""
    view = FleetView()
    feed = Feed(view)
    feed.on_change(view.on_state(state(*(robot(f"Robot{number}") for number in range(1, robots + 1)))))
    fleet = RecordingFleet(view)
    async with (
        Core(port=0) as core,
        Node("hardware", argv=[], master_uri=core.uri, types=TYPES) as node,
    ):
        source = RosCommandSource(RosLayerSource(core.uri, TYPES))
        control = RobotControl(
            source,
            view.robot_ids,
            lambda: feed.on_control(
                control.stopped, control.driven, control.fleet_stopped_by, control.undelivered
            ),
        )
        login = Login()
        station = Station(view, fleet, feed.pages, authenticator=authenticator or login, control=control)  # type: ignore[arg-type]  # as wide as what is called
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(control.close)
            client = await stack.enter_async_context(TestClient(TestServer(station.make_app())))
            made = Site(client, fleet, control, view, login, station)
            await node.subscribe(
                "/Robot1/emergency_stop", "std_msgs/Bool", lambda said: made.stops.append(said.data)
            )
            for number in range(3, robots + 1):
                await node.subscribe(f"/Robot{number}/emergency_stop", "std_msgs/Bool", lambda _said: None)
            made.motor = await node.subscribe(
                "/Robot1/raw_cmd_vel",
                "geometry_msgs/Twist",
                lambda said: made.velocities.append((said.linear.x, said.angular.z)),
            )
            echo = await node.advertise("/Robot1/drive_echo", "std_msgs/Float64")

            def answer(said: Message) -> None:
                if made.answers:
                    echo.publish(data=said.data)

            await node.subscribe("/Robot1/drive_clock", "std_msgs/Float64", answer)
            await node.subscribe(
                "/Robot1/initialpose", "geometry_msgs/PoseWithCovarianceStamped", made.poses.append
            )
            yield made


async def driven_shortly(made: Site, robot_id: str) -> None:
    """Open the page's drive of a robot, send one frame if it listens, and leave."""
    async with made.client.ws_connect(f"/api/v1/robots/{robot_id}/drive") as page:
        if robot_id == "Robot1":
            await frame(page, 0)
        else:
            assert "raw_cmd_vel" in json.loads(await page.receive_str(timeout=LIMIT_S))["error"]
    await made.until(lambda: robot_id not in made.control.driven)


async def frame(page: ClientWebSocketResponse, number: int, **fields: object) -> dict[str, Any]:
    """Send a frame of the page, and return the station's answer."""
    sent = {"number": number, "sent": asyncio.get_running_loop().time(), "held": True, "speed": 0.2}
    await page.send_str(json.dumps({**sent, **fields}))
    answer: dict[str, Any] = json.loads(await page.receive_str(timeout=LIMIT_S))
    return answer


async def drive_until(
    page: ClientWebSocketResponse, holds: Callable[[dict[str, Any]], object]
) -> dict[str, Any]:
    """Send frames until the answer to one is as expected, and return it."""
    async with asyncio.timeout(LIMIT_S):
        for number in itertools.count(round(1000 * asyncio.get_running_loop().time())):
            answer = await frame(page, number)
            if holds(answer):
                break
            await asyncio.sleep(0.02)
    return answer
