"""Emergency stops and initial poses over HTTP, in a real ROS graph."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.controlled_robots import LIMIT_S, TYPES, site
from support.multimaster import DiscoveryNetwork
from support.planner_states import state

from rce.aio.tasks import cancel_and_wait
from rce.ros.core import Core
from rce.ros.multimaster.discovery import Discovery
from rce.ros.node import Node
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.sources import RosCommandSource
from rce_fleet.station.engine_authenticator import EngineAuthenticator, StationAccount
from rce_fleet.station.layers.ros_source import RosLayerSource


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
