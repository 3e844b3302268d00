"""Emergency stops, initial poses and driving by hand over HTTP, in a real ROS graph."""

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

import pytest
from aiohttp import ClientWebSocketResponse, WSCloseCode, WSMsgType, web
from aiohttp.test_utils import TestClient, TestServer
from support.multimaster import DiscoveryNetwork
from unit.station.test_station_view import robot, state

from rce.aio.tasks import cancel_and_wait
from rce.ros.core import Core
from rce.ros.multimaster.discovery import Discovery
from rce.ros.node import Node, Subscriber
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, TypeRegistry
from rce_fleet.station.authentication import Authenticator, StationUser, TokenAuthenticator
from rce_fleet.station.commands import routes
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.sources import RosCommandSource
from rce_fleet.station.engine_authenticator import EngineAuthenticator, StationAccount
from rce_fleet.station.feed import Feed
from rce_fleet.station.layers.ros_source import RosLayerSource
from rce_fleet.station.planner_client import PlannerError
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

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


class Engine:
    """The part of a master that knows whose a token is; it may hang, or end."""

    def __init__(self) -> None:
        self.roles = {"t": "operator", "v": "viewer"}
        self.answers = asyncio.Event()
        self.answers.set()
        app = web.Application()
        app.router.add_get("/api/v1/user", self._answer)
        self.server = TestServer(app)

    async def _answer(self, request: web.Request) -> web.Response:
        await self.answers.wait()
        role = self.roles.get(request.headers["Authorization"].removeprefix("Bearer "))
        return web.json_response({"name": "op", "role": role} if role else {}, status=200 if role else 401)


@pytest.mark.parametrize("way", ["hangs", "ended"])
async def test_robots_are_stopped_while_the_master_is_away(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By who was logged in; a release needs the check, and so does a token that was never valid."""
    engine = Engine()
    async with engine.server:
        account = StationAccount(str(engine.server.make_url("/")), "u", "p")
        async with EngineAuthenticator(account) as authenticator, site(authenticator) as made:
            stop, release = {"stopped": True}, {"stopped": False}
            for token, status in (("t", 200), ("v", 403), ("x", 401)):
                assert (await made.put("/robots/Robot1/emergency-stop", release, token))[0] == status
            await made.until(lambda: list(made.stops) == [False])
            monkeypatch.setattr("rce_fleet.station.engine_authenticator.CACHE_S", 0.0)
            monkeypatch.setattr("rce_fleet.station.engine_authenticator.OFFLINE_CACHE_S", 0.0)
            if way == "hangs":
                engine.answers.clear()
            else:
                await engine.server.close()
            zone = {"kind": "blocked", "cells": [1]}
            assert (await made.put("/zones/emergency-stop", zone, "t"))[0] == 503  # it is not a stop
            assert (await made.put("/robots/Robot1/emergency-stop", stop, "t"))[0] == 200
            await made.until(lambda: made.stops[-1])
            status, text = await made.put("/robots/Robot1/emergency-stop", release, "t")
            assert (status, "check the login" in text) == (503, True)
            assert (await made.put("/robots/Robot1/emergency-stop", stop, "v"))[0] == 403
            engine.answers.set()
            if way == "hangs":  # it answers again
                del engine.roles["t"]
                assert (await made.put("/robots/Robot1/emergency-stop", stop, "t"))[0] == 401


async def test_a_stop_reaches_those_who_listen() -> None:
    async with site() as made:
        status, text = await made.put("/emergency-stop", {"stopped": True})
        await made.until(lambda: True in made.stops)
        assert (status, "Robot1 reached" in text, "not Robot2" in text) == (200, True, True)
        assert set(made.control.stopped) == {"Robot1", "Robot2"}
        assert made.control.undelivered == ["Robot2"]
        status, _ = await made.put("/robots/Robot1/emergency-stop", {"stopped": False})
        await made.until(lambda: False in made.stops)
        assert (status, set(made.control.stopped)) == (200, {"Robot2"})
        status, text = await made.put("/robots/Robot2/emergency-stop", {"stopped": True})
        assert (status, "gets this when it is" in text) == (409, True)


async def test_a_stop_reaches_robots_that_the_planner_does_not_know() -> None:
    """As after a restart of the station while the planner is down."""
    async with site() as made:
        made.view.on_state(state())
        status, text = await made.put("/emergency-stop", {"stopped": True})
        await made.until(lambda: True in made.stops)
        assert (status, "Robot1 reached" in text, set(made.control.stopped)) == (200, True, {"Robot1"})


async def test_an_initial_pose_reaches_localization() -> None:
    async with site() as made:
        status, _ = await made.put("/robots/Robot1/pose", {"x": 1.5, "y": 2.5, "yaw": 3.0})
        await made.until(lambda: made.poses)
        pose = made.poses[0].pose.pose
        assert (status, pose.position.x, pose.position.y) == (200, 1.5, 2.5)
        assert made.poses[0].header.frame_id == "map"
        status, text = await made.put("/robots/Robot2/pose", {"x": 0.0, "y": 0.0})
        assert (status, "initialpose" in text) == (409, True)


@pytest.mark.parametrize("body", [{}, {"stopped": "perhaps"}, {"stopped": True, "more": 1}])
async def test_a_stop_that_cannot_be_read_is_refused(body: dict[str, Any]) -> None:
    async with site() as made:
        status, _ = await made.put("/emergency-stop", body)
        assert (status, made.control.stopped) == (400, {})


async def _driven_shortly(made: Site, robot_id: str) -> None:
    async with made.client.ws_connect(f"/api/v1/robots/{robot_id}/drive") as page:
        if robot_id == "Robot1":
            await _frame(page, 0)
        else:
            assert "raw_cmd_vel" in json.loads(await page.receive_str(timeout=LIMIT_S))["error"]
    await made.until(lambda: robot_id not in made.control.driven)


async def _frame(page: ClientWebSocketResponse, number: int, **fields: object) -> dict[str, Any]:
    sent = {"number": number, "sent": asyncio.get_running_loop().time(), "held": True, "speed": 0.2}
    await page.send_str(json.dumps({**sent, **fields}))
    answer: dict[str, Any] = json.loads(await page.receive_str(timeout=LIMIT_S))
    return answer


async def _drive_until(
    page: ClientWebSocketResponse, holds: Callable[[dict[str, Any]], object]
) -> dict[str, Any]:
    """Send frames until the answer to one is as expected, and return it."""
    async with asyncio.timeout(LIMIT_S):
        for number in itertools.count(round(1000 * asyncio.get_running_loop().time())):
            answer = await _frame(page, number)
            if holds(answer):
                break
            await asyncio.sleep(0.02)
    return answer


async def test_a_robot_is_driven_while_the_switch_is_held() -> None:
    """It stops when the switch is released, when frames stop, and when the page leaves."""
    async with site() as made:
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            assert (await _frame(page, 0))["speed"] == 0.2
            await made.until(lambda: (0.2, 0.0) in made.velocities)
            assert made.fleet.modes == [("Robot1", "manual")]
            assert (await _frame(page, 1, held=False))["reason"] == "the dead-man's switch is released"
            await made.until(lambda: made.velocities[-1] == (0.0, 0.0))
            await _frame(page, 2)
            made.velocities.clear()
            await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
            async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as second:
                assert "is driven by" in json.loads(await second.receive_str(timeout=LIMIT_S))["error"]
        await made.until(lambda: made.fleet.modes[-1] == ("Robot1", "automatic"))
        await made.until(lambda: made.control.driven == {})


async def test_a_robot_that_is_away_is_not_shown_as_driven() -> None:
    """The answers to frames say so, whatever they ask for."""
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
        assert (await _frame(page, 0))["speed"] == 0.2
        assert made.motor is not None
        await made.motor.close()
        async with asyncio.timeout(LIMIT_S):
            for number in range(1, 1_000_000):
                answer = await _frame(page, number)
                if answer["speed"] == 0.0:
                    break
                await asyncio.sleep(0.01)
        assert answer["reason"] == "the robot is not connected"


async def test_a_robot_whose_answers_fail_to_come_stands() -> None:
    """As behind a network with seconds of queue, which the page does not see by itself."""
    async with site() as made:
        made.answers = True
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await _drive_until(page, lambda answer: answer["robot_round_trip"] and answer["speed"] == 0.2)
            made.answers = False
            stands = await _drive_until(page, lambda answer: answer["speed"] == 0.0)
            assert "round trip to the robot" in stands["reason"]
            made.velocities.clear()
            await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
            made.answers = True
            await _drive_until(page, lambda answer: answer["speed"] == 0.2)


async def test_a_station_that_ends_gives_driven_robots_their_modes_back() -> None:
    """Before it closes the pages, which may be away; it lets no robot be driven any more."""
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
        await _frame(page, 0)
        await made.station.end_drives()
        assert made.fleet.modes == [("Robot1", "manual"), ("Robot1", "automatic")]
        assert (await page.receive(timeout=LIMIT_S)).data == WSCloseCode.GOING_AWAY
        await made.until(lambda: made.velocities[-1] == (0.0, 0.0))
        async with made.client.get("/api/v1/robots/Robot1/drive") as reply:
            assert reply.status == 503


async def test_a_robot_that_does_not_listen_is_not_driven() -> None:
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot2/drive") as page:
        assert "raw_cmd_vel" in json.loads(await page.receive_str(timeout=LIMIT_S))["error"]


@pytest.mark.parametrize("robot_id", ["Robot1", "Robot2"])
@pytest.mark.parametrize(
    ("mode", "fleet_mode", "own"),
    [
        ("out_of_service", "automatic", "out_of_service"),
        ("paused", "automatic", "paused"),
        ("paused", "paused", "automatic"),
        ("automatic", "automatic", "automatic"),
    ],
)
async def test_driving_gives_a_robot_its_own_mode_back(
    robot_id: str, mode: str, fleet_mode: str, own: str
) -> None:
    """Also if driving fails because the robot, as Robot2, does not listen."""
    async with site() as made:
        made.view.on_state(state(robot(robot_id, mode=mode), mode=fleet_mode))
        await _driven_shortly(made, robot_id)
        assert made.fleet.modes == [(robot_id, "manual"), (robot_id, own)]


async def test_a_mode_that_is_set_while_driving_stays() -> None:
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="automatic")))
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await _frame(page, 0)
            made.view.on_state(state(robot("Robot1", mode="out_of_service")))
        await made.until(lambda: not made.control.driven)
        assert made.fleet.modes == [("Robot1", "manual")]


async def _drive_to_the_end(page: ClientWebSocketResponse) -> list[str]:
    """Send frames until the station closes the drive; return the reasons and errors that it told."""
    told = []
    async with asyncio.timeout(LIMIT_S):
        for number in range(1, 1_000_000):
            frame = {"number": number, "sent": asyncio.get_running_loop().time(), "held": True}
            with contextlib.suppress(ConnectionError):  # the station has closed it: read on
                await page.send_str(json.dumps({**frame, "speed": 0.2}))
            message = await page.receive()
            if message.type is not WSMsgType.TEXT:
                break
            answer = json.loads(message.data)
            told.append(answer.get("reason") or answer.get("error", ""))
            await asyncio.sleep(0.01)
    return told


@pytest.mark.parametrize("mode", ["automatic", "paused"])
async def test_driving_ends_when_another_mode_is_set(mode: str) -> None:
    """As when another operator resumes the robot: the planner would drive it, too."""
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="automatic")))
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await _frame(page, 0)
            made.fleet.show("Robot1", mode)
            told = await _drive_to_the_end(page)
        assert f"Robot1 is {mode} now" in told[-1]
        await made.until(lambda: not made.control.driven)
        await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
        assert made.view.mode_of("Robot1") == mode


async def test_a_restarted_planner_gets_the_mode_manual_again() -> None:
    """The robot stands until the planner, which begins with automatic, has accepted it."""
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="paused")))
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await _frame(page, 0)
            made.fleet.refuses.add("manual")
            made.fleet.show("Robot1", "automatic", run="2")
            await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
            assert "was restarted" in (await _frame(page, 1))["reason"]
            made.fleet.run = "2"
            made.fleet.refuses.clear()
            await made.until(lambda: len(made.fleet.modes) > 1)
            assert made.fleet.modes == [("Robot1", "manual")] * 2
            assert (await _frame(page, 2))["speed"] == 0.2
        await made.until(lambda: not made.control.driven)
        assert made.fleet.modes[-1] == ("Robot1", "paused")


async def test_a_robot_whose_manual_mode_is_refused_keeps_its_mode() -> None:
    async with site() as made:
        made.fleet.refuses.add("manual")
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            assert "is refused" in json.loads(await page.receive_str(timeout=LIMIT_S))["error"]
        await made.until(lambda: not made.control.driven)
        assert (made.fleet.modes, made.fleet.events) == ([], [])


async def test_a_mode_that_cannot_be_restored_is_told_and_tried_again() -> None:
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="paused")))
        made.fleet.refuses.add("paused")
        await _driven_shortly(made, "Robot1")
        assert ["stays manual; it was paused before" in text for text in made.fleet.events] == [True]
        made.view.on_state(state(robot("Robot1", mode="manual")))
        made.fleet.refuses.clear()
        await _driven_shortly(made, "Robot1")
        assert made.fleet.modes[-1] == ("Robot1", "paused")


async def test_a_robot_is_driven_again_only_after_its_mode_is_restored() -> None:
    """The late request of the one who drove before would end the mode of the next one."""
    async with site() as made:
        made.fleet.may_restore.clear()
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await _frame(page, 0)
        await made.until(lambda: ("Robot1", "automatic") in made.fleet.modes)
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as second:
            assert "is driven by" in json.loads(await second.receive_str(timeout=LIMIT_S))["error"]
        made.fleet.may_restore.set()
        await made.until(lambda: not made.control.driven)
        await _driven_shortly(made, "Robot1")
        assert [mode for _, mode in made.fleet.modes] == ["manual", "automatic"] * 2


@pytest.mark.parametrize("user", [None, StationUser("operator", "viewer")])
async def test_driving_ends_with_the_permission(
    user: StationUser | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the login is revoked, or the role is taken away; the page still sends frames."""
    monkeypatch.setattr(routes, "CHECK_S", 0.05)
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
        assert (await _frame(page, 0))["speed"] == 0.2
        made.login.user = user
        await _drive_to_the_end(page)
        assert page.close_code == WSCloseCode.POLICY_VIOLATION
        await made.until(lambda: not made.control.driven)
        await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
        assert made.fleet.modes[-1] == ("Robot1", "automatic")


async def test_a_stop_follows_a_robot_into_its_own_graph() -> None:
    """Discovery knows the robot's master only after the stop was sent in the planner's graph."""
    network = DiscoveryNetwork()
    stops: deque[bool] = deque()
    async with (
        Core(port=0) as planner,
        Core(port=0) as robot_core,
        Node("safety", argv=[], master_uri=robot_core.uri, types=TYPES) as node,
        Discovery(network.settings(planner.uri, name="planner")),
    ):
        await node.subscribe("/emergency_stop", "std_msgs/Bool", lambda said: stops.append(said.data))
        source = RosCommandSource(RosLayerSource(planner.uri, TYPES))
        control = RobotControl(source, lambda: ["Robot1"])
        result = await control.emergency_stop(None, "op", stopped=True)
        assert (result.reached, list(stops)) == ((), [])
        async with Discovery(network.settings(robot_core.uri, name="Robot1")):
            keeping = asyncio.create_task(control.run())
            async with asyncio.timeout(LIMIT_S):
                while True not in stops:
                    await asyncio.sleep(0.05)
            await cancel_and_wait(keeping)
            result = await control.emergency_stop(None, "op", stopped=False)
            assert (result.reached, control.stopped) == (("Robot1",), {})
            await control.close()


async def test_a_stop_follows_a_robot_whose_master_moves() -> None:
    """The robot restarts, and its master has another port then. The station ends while it is away."""
    network = DiscoveryNetwork()
    stops: deque[bool] = deque()
    async with Core(port=0) as planner, Discovery(network.settings(planner.uri, name="planner")):
        control = RobotControl(RosCommandSource(RosLayerSource(planner.uri, TYPES)), lambda: ["Robot1"])
        await control.emergency_stop(None, "op", stopped=True)
        keeping = asyncio.create_task(control.run())
        for _ in range(2):
            stops.clear()
            async with (
                Core(port=0) as core,
                Node("safety", argv=[], master_uri=core.uri, types=TYPES) as node,
                Discovery(network.settings(core.uri, name="Robot1")),
            ):
                await node.subscribe("/emergency_stop", "std_msgs/Bool", lambda said: stops.append(said.data))
                async with asyncio.timeout(LIMIT_S):
                    while True not in stops:
                        assert not keeping.done()
                        await asyncio.sleep(0.05)
        await cancel_and_wait(keeping)
        await control.close()
