"""Layers of the page through a real engine: from a robot's own graph, and from its container."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from support.engine import Engine, Program, running_engine, until
from support.layers import STATE, RobotTopics, room

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.ros.xmlrpc import RpcClient
from rce_client.connection import Connection
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ros_map import save_map
from rce_fleet.station.engine_watch import EngineWatch
from rce_fleet.station.layers.engine_source import EngineLayerSource
from rce_fleet.station.layers.hub import LayerHub
from rce_fleet.station.live import Broadcast, Page
from rce_fleet.station.view import FleetView
from rce_fleet.wiring import FleetAccount, robot_config

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(300)]

TYPES = TypeRegistry(PackageIndex([]))


def config_of(engine: Engine) -> dict[str, Any]:
    """What the shipped config of robot 1 offers to the page, without the rest."""
    whole = robot_config(1, FleetAccount(url=engine.url))
    return {key: whole[key] for key in ("url", "userID", "password", "robotID", "interfaces")}


class Station:
    """The station's layers, with a page."""

    def __init__(self, hub: LayerHub, page: Page, connection: Connection) -> None:
        self.hub, self.page, self.connection = hub, page, connection
        self.texts: list[str] = []

    async def frame(self, layer: str, wanted: Callable[[dict[str, Any]], bool] = bool) -> dict[str, Any]:
        async with asyncio.timeout(60):
            while True:
                for message in await self.page.take():
                    if isinstance(message, str):
                        self.texts.append(message)
                        continue
                    header = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
                    if header["layer"] == layer and wanted(header):
                        found: dict[str, Any] = header
                        return found


@asynccontextmanager
async def station(engine: Engine) -> AsyncIterator[Station]:
    view = FleetView()
    view.on_state(STATE)
    pages = Broadcast()
    watch = EngineWatch(engine.url, "testUser", "testUser", on_state=lambda _: None)
    watching = asyncio.create_task(watch.run())
    try:
        async with Connection(engine.url, "testUser", "testUser", "fleetOperator") as connection:
            hub = LayerHub(EngineLayerSource(lambda: connection, watch.read_items), view, TYPES)
            try:
                yield Station(hub, pages.open(), connection)
            finally:
                await hub.close()
                await connection.remove_all()
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)


async def subscribed(core: Core) -> set[str]:
    """Topics that ``rce-ros`` subscribes to in the robot's graph."""
    async with RpcClient() as rpc:
        state = await MasterClient(core.uri, "/test", "", rpc).call("getSystemState")
    return {topic for topic, names in state[1] if any("rce_ros" in name for name in names)}


async def test_layers_come_from_robots_and_containers_on_demand() -> None:
    async with running_engine() as engine:
        await check_robot(engine)
        await check_container(engine)


async def check_robot(engine: Engine) -> None:
    """A robot's scan reaches the page, and costs nothing before and after; a restarted robot comes back."""
    async with (
        Core(port=0) as core,
        Node("nodes", argv=[], master_uri=core.uri, types=TYPES) as node,
    ):
        topics = RobotTopics(node)
        await topics.start()
        publishing = asyncio.create_task(topics.run())
        file = engine.folder / "robot1.config"
        file.write_text(json.dumps(config_of(engine)))
        env = {**engine.env, "ROS_MASTER_URI": core.uri}
        bridge = Program("rce-ros", [_program("rce-ros"), str(file)], env, engine.folder)
        try:
            await bridge.start()
            async with station(engine) as operator:
                assert await subscribed(core) == set()
                operator.hub.show(operator.page, "Robot1", ["scan", "map"])
                scan = await operator.frame("scan", lambda header: len(header["notes"]) == 1)
                assert scan["pose"] == pytest.approx([2.58, 3.06, 0.6], abs=0.01)
                assert {"/scan", "/map", "/tf", "/tf_static"} <= await subscribed(core)
                operator.hub.show(operator.page, "Robot1", ["map"])
                await until(lambda: _is_subscribed(core, {"/map"}), what="rce-ros subscribes to the map only")
                operator.hub.show(operator.page, "Robot1", ["map", "local_costmap"])
                assert (await operator.frame("local_costmap"))["columns"] == 60
                await bridge.stop()
                await bridge.start()
                operator.hub.show(operator.page, "Robot1", ["scan"])
                await operator.frame("scan")
                operator.hub.leave(operator.page)
                await until(lambda: _is_subscribed(core, set()), what="rce-ros subscribes to nothing")
        finally:
            publishing.cancel()
            await asyncio.gather(publishing, return_exceptions=True)
            if bridge.running:
                await bridge.stop()


async def check_container(engine: Engine) -> None:
    """Show the map of a node in the robot's namespace; the interface exists only meanwhile."""
    async with station(engine) as operator:
        save_map(OccupancyMap(room()), engine.folder / "room")
        operator.hub.show(operator.page, "Robot2", ["map"])
        await until(lambda: _tells(operator, "layer_Robot2_map"), what="the page is told what is missing")
        robot = operator.connection
        await robot.create_container("cTag_02")
        await robot.add_node(
            *("cTag_02", "map", "map_server", "map_server"),
            args=str(engine.folder / "room.yaml"),
            namespace="Robot2",
        )
        header = await operator.frame("map")
        assert (header["rows"], header["columns"]) == (160, 160)
        operator.hub.leave(operator.page)

        async def is_removed() -> bool:
            found = engine.get("/api/v1/interfaces")["interfaces"]
            return not found

        await until(is_removed, what="the interfaces are removed")


async def _is_subscribed(core: Core, topics: set[str]) -> bool:
    return await subscribed(core) == topics


async def _tells(operator: Station, text: str) -> bool:
    for message in await operator.page.take():
        if isinstance(message, str):
            operator.texts.append(message)
    return text in "".join(operator.texts)


def _program(name: str) -> str:
    return str(Path(sys.executable).parent / name)
