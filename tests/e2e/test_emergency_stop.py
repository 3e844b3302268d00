"""Emergency stops, velocities and initial poses reach a robot through a real engine, without any planner."""

from __future__ import annotations

import asyncio
import json
import sys
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from support.engine import Program, running_engine, until

from rce.aio.tasks import cancel_and_wait
from rce.config.client import loads
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_client.connection import Connection
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.desired_stops import DesiredStops, stops_file
from rce_fleet.station.commands.sources import CommandError, EngineCommandSource
from rce_fleet.station.commands.velocity_sender import velocity_sender
from rce_fleet.station.engine_planner_client import EnginePlannerClient
from rce_fleet.station.engine_watch import EngineWatch
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.layers.frames import LayerError
from rce_fleet.station.view import FleetView
from rce_fleet.wiring import FleetAccount, robot_config

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(300)]

TYPES = TypeRegistry(PackageIndex([]))


@dataclass
class Site:
    """An engine, and a robot behind its bridge."""

    url: str
    folder: Path
    bridge: Program
    got: deque[bool]
    told: deque[tuple[float, float]]
    """What the robot was told: of velocities speed and turn rate, of poses x and y."""
    watch: EngineWatch


@asynccontextmanager
async def robot_at_engine() -> AsyncIterator[Site]:
    async with (
        running_engine() as engine,
        Core(port=0) as core,
        Node("safety", argv=[], master_uri=core.uri, types=TYPES) as node,
    ):
        got: deque[bool] = deque()
        await node.subscribe("emergency_stop", "std_msgs/Bool", lambda message: got.append(message.data))
        told: deque[tuple[float, float]] = deque()
        await node.subscribe(
            "raw_cmd_vel",
            "geometry_msgs/Twist",
            lambda message: told.append((message.linear.x, message.angular.z)),
        )
        await node.subscribe(
            "initialpose",
            "geometry_msgs/PoseWithCovarianceStamped",
            lambda message: told.append((message.pose.pose.position.x, message.pose.pose.position.y)),
        )
        echo = await node.advertise("drive_echo", "std_msgs/Float64")
        await node.subscribe(
            "drive_clock", "std_msgs/Float64", lambda message: echo.publish(data=message.data)
        )
        whole = robot_config(1, FleetAccount(url=engine.url))
        kept: dict[str, Any] = {key: whole[key] for key in ("url", "userID", "password", "robotID")}
        kept["interfaces"] = [item for item in whole["interfaces"] if item["iTag"].startswith("command_")]
        file = engine.folder / "robot1.config"
        file.write_text(json.dumps(kept))
        env = {**engine.env, "ROS_MASTER_URI": core.uri}
        program = Path(sys.executable).parent / "rce-ros"
        bridge = Program("rce-ros", [str(program), str(file)], env, engine.folder)
        watch = EngineWatch(engine.url, "testUser", "testUser", on_state=lambda _: None)
        watching = asyncio.create_task(watch.run())
        await bridge.start()
        tags = {item["iTag"] for item in kept["interfaces"]}

        async def offers_all() -> bool:
            with suppress(LayerError):
                return tags <= {item["tag"] for item in await watch.read_items("interfaces")}
            return False

        try:
            # A drive that begins before measures no round trip.
            await until(offers_all, what="the engine knows all interfaces of the robot")
            yield Site(engine.url, engine.folder, bridge, got, told, watch)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            await bridge.stop()


async def test_an_emergency_stop_needs_no_planner() -> None:
    """The robot stands; it also does after its bridge was restarted, until it is released."""
    async with robot_at_engine() as site:
        got, bridge = site.got, site.bridge
        async with Connection(site.url, "testUser", "testUser", "fleetOperator") as connection:
            source = EngineCommandSource(lambda: connection, site.watch.read_items)
            control = RobotControl(source, lambda: ["Robot1"])

            async def stopped() -> bool:
                result = await control.emergency_stop(None, "op", stopped=True)
                return result.reached == ("Robot1",)

            async def gets(expected: bool) -> bool:
                return expected in got

            keeping = asyncio.create_task(control.run())
            await until(stopped, what="the station reaches the robot")
            await until(lambda: gets(True), what="the robot is stopped")
            await bridge.stop()
            got.clear()
            await bridge.start()
            await until(lambda: gets(True), what="the robot is stopped again")
            await control.emergency_stop(["Robot1"], "op", stopped=False)
            await until(lambda: gets(False), what="the robot is released")
            other = await control.emergency_stop(["Robot7"], "op", stopped=True)
            assert "command_Robot7_emergency_stop" in other.missed["Robot7"]
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
            await control.close()
            await connection.remove_all()


async def test_a_robot_is_driven_and_localized_by_the_engine() -> None:
    """It answers the time of velocities; once its bridge has ended, the station knows that it gets none."""
    async with (
        robot_at_engine() as site,
        Connection(site.url, "testUser", "testUser", "fleetOperator") as connection,
    ):
        source = EngineCommandSource(lambda: connection, site.watch.read_items)
        control = RobotControl(source, lambda: ["Robot1"])

        async def localized() -> bool:
            with suppress(CommandError):
                await control.set_pose("Robot1", 1.5, 2.5, 0.0)
            return (1.5, 2.5) in site.told

        await until(localized, what="the robot is told where it is")
        now = asyncio.get_running_loop().time
        async with velocity_sender(control, "Robot1") as sender:

            async def drives() -> bool:
                sender.send(0.25, -0.5)
                return (0.25, -0.5) in site.told and sender.round_trip.seconds(now()) is not None

            async def is_away() -> bool:
                return not sender.is_connected

            await until(drives, what="the robot is driven, and answers")
            assert sender.is_connected
            await site.bridge.stop()
            await until(is_away, what="the station knows that the robot is away")
        await connection.remove_all()


async def nothing() -> None: ...


async def test_a_station_without_its_planner_reaches_robots() -> None:
    """Its container has no planner. The robot is stopped, and again by a station that restarts."""
    async with robot_at_engine() as site:
        account = {"url": site.url, "userID": "testUser", "password": "testUser", "robotID": "fleetOperator"}
        config = loads(json.dumps({**account, "containers": [{"cTag": "planner"}]}), "station.config")
        file = stops_file(site.folder, "fleet")

        @asynccontextmanager
        async def station() -> AsyncIterator[RobotControl]:
            client, stops = EnginePlannerClient(config), DesiredStops(file)
            stops.load()
            source = EngineCommandSource(lambda: client.connection, site.watch.read_items)
            control = RobotControl(source, list, stops=stops)
            link = FleetLink(
                client,
                FleetView(),
                on_change=lambda _: None,
                on_pose=lambda _: None,
                on_event=lambda *_: None,
            )
            work = [
                asyncio.create_task(link.run(nothing)),
                asyncio.create_task(control.run()),
            ]
            try:
                yield control
            finally:
                await control.close()
                await cancel_and_wait(*work)

        async with station() as control:

            async def stopped() -> bool:
                return (await control.emergency_stop(None, "op", stopped=True)).reached == ("Robot1",)

            await until(stopped, what="the station reaches the robot")
            await until(lambda: True in site.got, what="the robot is stopped")
        site.got.clear()
        async with station() as control:
            assert (control.stopped, control.fleet_stopped_by) == ({"Robot1": "op"}, "op")
            await until(lambda: True in site.got, what="the robot is stopped again")
            await control.emergency_stop(None, "op", stopped=False)
            await until(lambda: False in site.got, what="the robot is released")
