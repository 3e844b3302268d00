"""Layers on the page: real nodes on a real core, the station's WebSocket, a browser."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from aiohttp import ClientWebSocketResponse, WSMsgType, web
from aiohttp.test_utils import TestClient, TestServer
from support.browser import CHROMIUM
from support.layers import ROBOT, STATE, RobotTopics, pose, scan
from support.multimaster import DiscoveryNetwork

from rce.ros.core import Core
from rce.ros.multimaster.discovery import Discovery
from rce.ros.multimaster.listing import list_masters
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.ros.xmlrpc import RpcClient
from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.layers.hub import LayerHub
from rce_fleet.station.layers.ros_source import RosLayerSource
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

TYPES = TypeRegistry(PackageIndex([]))
ARTIFACTS = Path(__file__).parents[3] / "artifacts"
LIMIT_S = 40


class World:
    """A core, a robot's topics in its namespace, and a station."""

    def __init__(self, core: Core) -> None:
        self.core = core
        self.view = FleetView()
        self.feed = Feed(self.view)
        self.hub = LayerHub(RosLayerSource(core.uri, TYPES), self.view, TYPES)
        fleet = FleetLink.__new__(FleetLink)  # no test steers
        self.app = Station(self.view, fleet, self.feed.pages, layers=self.hub).make_app()
        self.client: TestClient[web.Request, web.Application]
        self.topics: RobotTopics
        self.feed.on_change(self.view.on_state(STATE))

    async def subscriptions(self) -> set[str]:
        """Topics that the station subscribes to."""
        async with RpcClient() as rpc:
            state = await MasterClient(self.core.uri, "/test", "", rpc).call("getSystemState")
        return {
            topic for topic, names in state[1] if any(name.startswith("/operator_station") for name in names)
        }

    async def nodes(self) -> set[str]:
        """The station's nodes in the graph."""
        async with RpcClient() as rpc:
            state = await MasterClient(self.core.uri, "/test", "", rpc).call("getSystemState")
        return {name for _, names in state[1] for name in names if name.startswith("/operator_station")}

    async def until_subscribed(self, condition: Callable[[set[str]], bool]) -> None:
        async with asyncio.timeout(LIMIT_S):
            while not condition(await self.subscriptions()):
                await asyncio.sleep(0.1)


@asynccontextmanager
async def world() -> AsyncIterator[World]:
    async with (
        Core(port=0) as core,
        Node("nodes", namespace="Robot1", argv=[], master_uri=core.uri, types=TYPES) as node,
    ):
        made = World(core)
        made.topics = RobotTopics(node)
        await made.topics.start()
        publishing = asyncio.create_task(made.topics.run())
        try:
            async with TestClient(TestServer(made.app)) as made.client:
                yield made
        finally:
            publishing.cancel()
            await asyncio.gather(publishing, return_exceptions=True)
            await made.hub.close()


def read_frame(frame: bytes) -> tuple[dict[str, Any], bytes]:
    length = int.from_bytes(frame[:4], "little")
    return json.loads(frame[4 : 4 + length]), frame[4 + length :]


async def receive(
    socket: ClientWebSocketResponse, wanted: Callable[[dict[str, Any]], bool]
) -> tuple[dict[str, Any], bytes]:
    """Wait for a frame or a text that is wanted."""
    async with asyncio.timeout(LIMIT_S):
        async for message in socket:
            is_text = message.type is WSMsgType.TEXT
            header, numbers = (json.loads(message.data), b"") if is_text else read_frame(message.data)
            if wanted(header):
                return header, numbers
    raise AssertionError("the socket was closed")


async def receive_all(socket: ClientWebSocketResponse, *layers: str) -> dict[str, bytes]:
    """Wait for a frame of each layer; return their numbers."""
    found: dict[str, bytes] = {}
    while len(found) < len(layers):
        header, numbers = await receive(socket, lambda one: "pose" in one and one["layer"] in layers)
        found[header["layer"]] = numbers
    return found


def is_frame(layer: str) -> Callable[[dict[str, Any]], bool]:
    return lambda header: header.get("layer") == layer and "pose" in header


async def test_pages_share_subscriptions_until_none_looks() -> None:
    """A robot's topic is subscribed to once for all pages, and not when no page shows it."""
    async with world() as made:
        assert await made.subscriptions() == set()
        async with made.client.ws_connect("/api/v1/live") as first:
            async with made.client.ws_connect("/api/v1/live") as second:
                for page in (first, second):
                    await page.send_json({"robot": "Robot1", "layers": ["scan", "map"]})
                    assert len((await receive_all(page, "scan", "map"))["scan"]) == 4 * 360
                assert made.hub.streams == {("Robot1", "scan"), ("Robot1", "map")}
                await made.until_subscribed(lambda topics: {"/Robot1/scan", "/Robot1/map", "/tf"} <= topics)
                assert len(await made.nodes()) == 1, "one node for all topics"
            await receive(first, is_frame("scan"))
            await first.send_json({"robot": "Robot1", "layers": ["map"]})
            await made.until_subscribed(lambda topics: topics == {"/Robot1/map", "/map"})
        await made.until_subscribed(lambda topics: not topics)
        assert made.hub.streams == frozenset()


async def test_a_scan_is_placed_by_the_transforms_of_its_stamp() -> None:
    async with world() as made, made.client.ws_connect("/api/v1/live") as page:
        await page.send_json({"robot": "Robot1", "layers": ["scan"]})
        placed, _ = await receive(page, lambda header: is_frame("scan")(header) and len(header["notes"]) == 1)
        assert placed["notes"] == ["1 of 360 ranges are not a number"]
        assert placed["pose"] == pytest.approx([ROBOT[0] + 0.0825, ROBOT[1] + 0.0565, ROBOT[2]], abs=1e-3)


async def test_bad_messages_are_reported_and_replaced() -> None:
    """A scan that cannot be shown is told to the page; the next good one clears it."""
    async with world() as made, made.client.ws_connect("/api/v1/live") as page:
        await page.send_json({"robot": "Robot1", "layers": ["scan"]})
        await receive(page, is_frame("scan"))
        sending = asyncio.create_task(_send_bad_scans(made))
        try:
            told, _ = await receive(page, lambda header: "angle_min" in header.get("text", ""))
        finally:
            sending.cancel()
        assert told["layer"] == "scan"
        cleared, _ = await receive(page, lambda header: header.get("text") == "")
        assert cleared["layer"] == "scan"


async def _send_bad_scans(made: World) -> None:
    while True:
        made.topics.send("scan", **scan("laser", 1.0, angle_min=float("nan")))
        await asyncio.sleep(0.02)


async def test_a_page_that_asks_nonsense_stays_connected() -> None:
    async with world() as made, made.client.ws_connect("/api/v1/live") as page:
        await page.send_str("no json")
        told, _ = await receive(page, lambda header: header["type"] == "event")
        assert "layers" in told["text"]
        await page.send_json({"robot": "Robot9", "layers": ["scan"]})
        await page.send_json({"robot": "Robot1", "layers": ["scan", "sonar"]})
        await receive(page, is_frame("scan"))
        assert made.hub.streams == {("Robot1", "scan")}


async def test_layers_come_from_a_robots_own_graph() -> None:
    """With discovery, topics of a robot's master are subscribed to there, without a namespace."""
    network = DiscoveryNetwork()
    async with (
        Core(port=0) as planner,
        Core(port=0) as robot,
        Discovery(network.settings(planner.uri, name="planner")),
        Discovery(network.settings(robot.uri, name="Robot1")),
        Node("nodes", argv=[], master_uri=robot.uri, types=TYPES) as node,
    ):
        topics = RobotTopics(node)
        await topics.start()
        async with asyncio.timeout(LIMIT_S):
            while "Robot1" not in {master.name for master in await list_masters(planner.uri)}:
                await asyncio.sleep(0.1)
        made = World(planner)
        async with TestClient(TestServer(made.app)) as client, client.ws_connect("/api/v1/live") as page:
            await page.send_json({"robot": "Robot1", "layers": ["map"]})
            header, _ = await receive(page, is_frame("map"))
            assert header["rows"] == 160
        await made.hub.close()


@pytest.mark.needs("chromium")
async def test_the_page_draws_layers_that_are_checked() -> None:
    from playwright.async_api import async_playwright

    args = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    problems: list[str] = []
    async with world() as made, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=args)
        try:
            page = await browser.new_page(
                viewport={"width": 1280, "height": 1000}, color_scheme="light", reduced_motion="reduce"
            )
            page.on("console", lambda said: problems.append(said.text) if said.type == "error" else None)
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.set_default_timeout(LIMIT_S * 1000)
            await page.goto(str(made.client.make_url("/")))
            await page.get_by_label("of robot").select_option("Robot1")
            for name in ("Map", "Local costmap", "Planned path", "Scan", "Particle cloud"):
                box = page.get_by_label(name, exact=True)
                await box.focus()
                await page.keyboard.press("Space")
            await page.wait_for_function(
                """() => {
                    const { newest } = rceFleet.layers;
                    return newest.get("map")?.cells?.length === 25600
                        && newest.get("local_costmap")?.cells?.length === 3600
                        && newest.get("scan")?.points?.length === 2 * 358
                        && newest.get("particles")?.values?.length === 600
                        && newest.get("plan")?.values?.length === 90;
                }"""
            )
            await page.wait_for_function(
                "document.querySelector('#layer-note-scan').textContent.includes('not a number')"
            )
            ARTIFACTS.mkdir(exist_ok=True)
            await page.locator("main").screenshot(path=ARTIFACTS / "layers.png")
            drawn = await page.evaluate(_PIXEL, [0.05, 4.0])
            assert drawn[:3] != await page.evaluate(_PIXEL, [1.5, 6.5]), "a wall differs from the floor"
            corner = await page.evaluate("rceFleet.fleet.centre(0)")
            turned = {"orientation": pose(0.0, 0.0, 0.5)["orientation"]}
            made.feed.on_change(made.view.on_grid({"info": {"origin": turned}}))
            await page.wait_for_function("rceFleet.fleet.map.yaw > 0.4")
            there = await page.evaluate("rceFleet.fleet.centre(0)")
            assert there == pytest.approx([0.199, 0.679], abs=1e-3)
            assert there != corner
            assert await page.evaluate("rceFleet.fleet.cellAt(...rceFleet.fleet.centre(37))") == 37
            await page.locator("main").screenshot(path=ARTIFACTS / "layers-turned.png")
            await page.emulate_media(color_scheme="dark")
            await page.wait_for_function(
                "before => String(eval(`(${before[0]})`)(before[1])) !== String(before[2])",
                arg=[_PIXEL, [0.05, 4.0], drawn],
            )
            await page.screenshot(path=ARTIFACTS / "layers-dark.png")
            await page.get_by_label("Scan", exact=True).uncheck()
            await made.until_subscribed(lambda topics: "/Robot1/scan" not in topics)
            another = await browser.new_page()
            another.set_default_timeout(LIMIT_S * 1000)
            await another.goto(f"{made.client.make_url('/')}#robot=Robot1&layers=map,scan")
            await another.wait_for_function("rceFleet.layers.newest.get('map')?.cells?.length === 25600")
            assert await another.get_by_label("of robot").input_value() == "Robot1"
            assert await another.evaluate("[...rceFleet.layers.shown].join()") == "map,scan"
        finally:
            await browser.close()
    assert problems == []


_PIXEL = """([x, y]) => {
    const { view } = rceFleet;
    const [column, row] = [view.left + x * view.scale, view.bottom - y * view.scale];
    return [...view.context.getImageData(column, row, 1, 1).data];
}"""
