"""The fleet gets another grid: by service, and on the page; planner, move client, station, browser."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from math import pi
from typing import TYPE_CHECKING

import aiohttp
import pytest
from aiohttp.test_utils import TestServer
from support.browser import BROWSER, CHROMIUM, FEW_FRAMES
from support.resting_robot import PACKAGES, STATUS, RestingRobot, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message, TypeRegistry
from rce_fleet.planning.grid import GridMap
from rce_fleet.station.api import GridRequest
from rce_fleet.station.client import StationClient
from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.ros_planner_client import RosPlannerClient
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

WAIT_MS = 60_000
PLACE = (2.5, 3.5)
WALLS = "_walls:=[0]"
TURNED = {"cell_size": 0.8, "origin_x": 7.7, "origin_y": -0.1, "origin_yaw": pi / 2, "blocked_share": -1.0}
"""A grid over the same floor, turned to the left: the robot stands in the middle of row 6, column 4."""
TURNED_CELL = 6 * 11 + 4
TURNED_CENTRES = ((2.5, 3.5), (2.5, 4.3))
"""Of this cell, and of the next one."""


class Floor:
    """One robot at rest with its move client, and the planner, on one core."""

    def __init__(self, core: Core, node: Node) -> None:
        self.core = core
        self.node = node
        self.robot = RestingRobot(node)
        self.grids: list[Message] = []
        self.goals: asyncio.Queue[Message] = asyncio.Queue()

    async def start(self) -> None:
        await self.robot.start(PLACE)
        await self.robot.beat(STATUS)
        await self.node.subscribe("/fleet/map", "nav_msgs/OccupancyGrid", self.grids.append)
        await self.node.subscribe(
            "move_base/goal", "move_base_msgs/MoveBaseActionGoal", self.goals.put_nowait
        )

    async def set_grid(self, *, preview: bool = False, **changed: float) -> Message:
        await self.node.wait_for_service("/fleet/set_grid", timeout=30)
        client = self.node.service_client("/fleet/set_grid", "fleet/SetGrid")
        return await client(**{**TURNED, **changed}, preview=preview)

    async def change(self, **changed: float) -> Message:
        """Change the grid as soon as the move client has finished its list."""
        async with asyncio.timeout(50):
            while True:
                reply = await self.set_grid(preview=False, **changed)
                if reply.ok or "has not finished" not in reply.message:
                    return reply
                await asyncio.sleep(0.2)


@asynccontextmanager
async def running_floor() -> AsyncIterator[Floor]:
    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(fleet_program(core, "move_client.py", "__ns:=Robot1"))
        types = TypeRegistry(PACKAGES)
        node = Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=types)
        floor = Floor(core, await stack.enter_async_context(node))
        await floor.start()
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        beating = tasks.create_task(floor.robot.keep_beating())
        stack.callback(beating.cancel)
        yield floor


async def test_planner_and_move_client_change_the_grid() -> None:
    """A goal on the new grid is a place of the new grid; a planner that crashed begins with it again."""
    async with running_floor() as floor:
        async with fleet_program(floor.core, "fleet_planner.py", WALLS) as planner:
            await floor.robot.until("idle", 26)
            requested = await floor.node.subscribe("/fleet/requestedCells", "std_msgs/Int32MultiArray")
            block = floor.node.service_client("/fleet/block_cell", "fleet/BlockCell")
            assert (await block(cell=63, blocked=True)).ok
            seen = await floor.set_grid(preview=True)
            assert (seen.ok, seen.rows, seen.columns) == (True, 10, 11)
            assert {88, 89, 99} <= set(seen.walls)  # the wall at the floor's corner, and beside the floor
            assert seen.blocked_share == 0.1
            assert "too small" in (await floor.set_grid(cell_size=0.4)).message
            assert "positive" in (await floor.set_grid(cell_size=-1.0)).message
            assert "finite" in (await floor.set_grid(origin_x=float("nan"))).message
            reply = await floor.change()
            assert reply.ok, reply.message
            await floor.robot.until("idle", TURNED_CELL)
            async with asyncio.timeout(50):
                layouts = {""}
                async for message in requested:
                    (dimension,) = message.layout.dim
                    layouts.add(dimension.label)
                    grid = GridMap.from_layout(dimension.label)
                    if grid.rows == 10:
                        break
            # The cell is now one of other numbers, which the layout finds again.
            assert GridMap(rows=8, columns=8).layout in layouts
            assert 63 in {GridMap(rows=8, columns=8).cell_at(*grid.centre(cell)) for cell in message.data}
            made = floor.grids[-1].info
            assert (made.width, made.height, made.origin.position.x) == (11, 10, 7.7)
            assert made.origin.orientation.z == pytest.approx(2**-0.5)
            while not floor.goals.empty():
                floor.goals.get_nowait()
            set_goal = floor.node.service_client("/fleet/set_goal", "fleet/SetGoal")
            assert (await set_goal(robot="Robot1", cell=TURNED_CELL + 1)).ok
            async with asyncio.timeout(50):
                place = (await floor.goals.get()).goal.target_pose.pose.position
            assert (place.x, place.y) in [pytest.approx(centre) for centre in TURNED_CENTRES]
            refusal = await floor.set_grid(cell_size=1.0)
            assert not refusal.ok
            assert "Robot1" in refusal.message, "it drives"
            planner.kill()
            await planner.wait()
        async with fleet_program(floor.core, "fleet_planner.py", WALLS):
            await floor.robot.until("idle", TURNED_CELL)


async def test_clients_with_a_grid_of_their_own_forbid_it() -> None:
    """They would drive to cells of the grid before."""
    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", WALLS))
        await stack.enter_async_context(fleet_program(core, "move_client.py", "__ns:=Robot1", "_rows:=8"))
        node = Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=TypeRegistry(PACKAGES))
        floor = Floor(core, await stack.enter_async_context(node))
        await floor.start()
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        stack.callback(tasks.create_task(floor.robot.keep_beating()).cancel)
        await floor.robot.until("idle", 26)
        reply = await floor.change()
        assert not reply.ok
        assert "Robot1 does not take its grid from /fleet/map" in reply.message


@asynccontextmanager
async def running_station(core: Core) -> AsyncIterator[str]:
    """A station of the planner's graph; its URL."""
    view = FleetView()
    feed = Feed(view)
    client = RosPlannerClient(core.uri, TypeRegistry(PACKAGES))
    link = FleetLink(client, view, on_change=feed.on_change, on_pose=feed.on_pose, on_event=feed.on_event)
    ready = asyncio.Event()

    async def announce() -> None:
        ready.set()

    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(link.run(announce)), tasks.create_task(feed.run())]
        try:
            async with TestServer(Station(view, link, feed.pages).make_app()) as server:
                await ready.wait()
                yield str(server.make_url("/"))
        finally:
            for task in running:
                task.cancel()


@pytest.mark.needs("chromium")
async def test_the_grid_is_changed_on_the_page() -> None:
    """The proposed grid is a layer over the map; taking it over changes the fleet's grid and its rotation."""
    from playwright.async_api import async_playwright

    async with (
        running_floor() as floor,
        fleet_program(floor.core, "fleet_planner.py", WALLS),
        running_station(floor.core) as url,
        async_playwright() as playwright,
    ):
        await floor.robot.until("idle", 26)
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        try:
            page = await browser.new_page()
            await page.add_init_script(FEW_FRAMES)
            page.set_default_timeout(WAIT_MS)
            await page.goto(url)
            await page.wait_for_function("rceFleet.fleet.robots.get('Robot1')?.cell === 26")
            await page.click("#grid-editor summary")
            await page.wait_for_function("rceFleet.editor.proposed?.walls.has(0)")
            assert await page.input_value("#grid-share") == "10"
            await page.fill("#grid-size", "0.4")
            await page.wait_for_function(
                "document.querySelector('#grid-note').textContent.includes('too small')"
            )
            for field, value in {"size": "0.8", "x": "7.7", "y": "-0.1", "yaw": "90"}.items():
                await page.fill(f"#grid-{field}", value)
            await page.wait_for_function(
                "[88, 89, 99].every(cell => rceFleet.editor.proposed?.walls.has(cell))"
                " && !document.querySelector('#grid-take').disabled"
            )
            assert await page.evaluate("rceFleet.fleet.map.cell_size") == 1
            await page.click("#grid-take")
            await page.click("#question-yes")  # goals are removed
            await page.wait_for_function(
                "rceFleet.fleet.map.cell_size === 0.8 && rceFleet.editor.proposed === null"
            )
            await page.wait_for_function("Math.abs(rceFleet.fleet.map.yaw - Math.PI / 2) < 1e-6")
            await page.wait_for_function(f"rceFleet.fleet.robots.get('Robot1')?.cell === {TURNED_CELL}")
            assert "11 x 10 cells" in await page.inner_text("#message")
        finally:
            await browser.close()
        async with aiohttp.ClientSession() as session:
            client = StationClient(session, url)
            shown = await client.set_grid(GridRequest(cell_size=2.0), preview=True)
            assert (shown.rows, shown.columns) == (4, 5)
            assert shown.yaw == pytest.approx(pi / 2)
            grid = (await client.fleet()).map
            assert grid is not None
            assert grid.cell_size == 0.8
