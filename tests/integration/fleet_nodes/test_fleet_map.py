"""The grid of a fleet on ``/fleet/map``, and on ``/map`` for robot files from before."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from rce.ros.core import Core
from rce.ros.node import Node, RosError
from rce.ros.types import Message
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.nodes import move_client
from rce_fleet.nodes.fleet_planner import PlannerNode
from rce_fleet.nodes.grid_messages import grid_fields
from rce_fleet.nodes.grid_topics import LEAST_PAUSE
from rce_fleet.nodes.move_client import MoveClientNode
from rce_fleet.planning.grid import GridMap

PATIENCE = 60.0
GRID = GridMap(3, 4, 0.5, (1.0, 2.0), frozenset({5}), yaw=0.5)
TYPE = "nav_msgs/OccupancyGrid"


@asynccontextmanager
async def planning(uri: str, grid: GridMap = GRID) -> AsyncIterator[Node]:
    async with Node("fleet_planner", argv=[], master_uri=uri) as node:
        task = asyncio.create_task(PlannerNode(node, FleetPlanner(grid)).run([2]))
        yield node
        node.shutdown("the test is over")
        await task


async def test_the_planner_publishes_its_grid() -> None:
    async with Core(port=0) as core, planning(core.uri), Node("judge", argv=[], master_uri=core.uri) as judge:
        grids = await judge.subscribe("/fleet/map", TYPE)
        async with asyncio.timeout(PATIENCE):
            async for message in grids:
                if message.data[2]:
                    break
        info = message.info
        assert (info.height, info.width, info.resolution) == (3, 4, 0.5)
        assert (info.origin.position.x, info.origin.position.y) == (1.0, 2.0)
        assert info.origin.orientation.z == pytest.approx(0.2474, abs=1e-4)
        assert [cell for cell, value in enumerate(message.data) if value] == [2, 5]


async def test_a_service_that_another_planner_took_along_is_back() -> None:
    """Of two that start together one stops, maybe after it has registered a service as the last one."""
    async with (
        Core(port=0) as core,
        planning(core.uri),
        Node("other", argv=[], master_uri=core.uri) as other,
        asyncio.timeout(PATIENCE),
    ):
        await other.wait_for_service("/fleet/get_state")
        taken = await other.advertise_service("/fleet/get_state", "fleet/GetState", lambda _: {})
        await taken.close()
        client, rows = other.service_client("/fleet/get_state", "fleet/GetState", persistent=False), 0
        while not rows:
            await asyncio.sleep(0.05)
            with contextlib.suppress(RosError):
                rows = (await client.call({}, timeout=PATIENCE)).state.rows
        assert rows == GRID.rows


async def test_a_flood_of_blocked_cells_is_published_together() -> None:
    """Each message has the whole grid, for every robot; the last one has all cells."""
    floor = GridMap(40, 40)
    async with (
        Core(port=0) as core,
        planning(core.uri, floor),
        Node("judge", argv=[], master_uri=core.uri) as judge,
    ):
        blocked: list[int] = []
        whole = asyncio.Event()

        def take(message: Message) -> None:
            blocked.append(sum(map(bool, message.data)))
            if blocked[-1] == 401:
                whole.set()

        await judge.subscribe("/fleet/map", TYPE, take)
        block = judge.service_client("/fleet/block_cell", "fleet/BlockCell")
        async with asyncio.timeout(PATIENCE):
            await judge.wait_for_service("/fleet/block_cell")
            began = asyncio.get_running_loop().time()
            for cell in range(1000, 1400):
                assert (await block.call({"cell": cell, "blocked": True}, timeout=PATIENCE)).ok
            await whole.wait()
            took = asyncio.get_running_loop().time() - began
        assert len(blocked) <= 3 + took / LEAST_PAUSE
        assert blocked == sorted(blocked)


async def test_an_old_robot_file_gets_the_grid_on_map() -> None:
    async with Core(port=0) as core, planning(core.uri):
        async with Node("rce_environment", argv=[], master_uri=core.uri) as environment:
            grids = await environment.subscribe("/map", TYPE)
            async with asyncio.timeout(PATIENCE):
                message = await anext(aiter(grids))
        assert [cell for cell, value in enumerate(message.data) if value] == [2, 5]


@pytest.mark.parametrize("resolution", [0.5, 0.05])
async def test_a_move_client_takes_an_old_grid(resolution: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(move_client, "OLD_MAP_AFTER", 0.2)
    async with Core(port=0) as core, Node("rce_environment", argv=[], master_uri=core.uri) as environment:
        grids = await environment.advertise("/map", TYPE, latch=True)
        fields = grid_fields(GRID, (), environment.now())
        grids.publish(fields | {"info": fields["info"] | {"resolution": resolution}})
        async with Node("move_client", namespace="Robot1", argv=[], master_uri=core.uri) as node:
            client = MoveClientNode(node)
            task = asyncio.create_task(client.run())
            async with asyncio.timeout(PATIENCE):
                while not grids.connections:
                    await asyncio.sleep(0.05)
                reports = await environment.subscribe("/Robot1/moveClient/status", "fleet/MoveStatus")
                if resolution == 0.5:
                    assert (await anext(aiter(reports))).target == -1
                else:  # it is a map that robots localize on
                    await asyncio.sleep(1.0)
                    new = await environment.advertise("/fleet/map", TYPE, latch=True)
                    new.publish(grid_fields(GRID, (), environment.now()))
                    assert (await anext(aiter(reports))).target == -1
            assert client._client is not None
            assert client._client.grid == GridMap(3, 4, 0.5, (1.0, 2.0), yaw=client._client.grid.yaw)
            node.shutdown("the test is over")
            await task


async def test_move_client_warns_of_goals_past_the_planner() -> None:
    """A goal that a person gave in rviz is cancelled when the move client starts, and it says why."""
    async with Core(port=0) as core, Node("rviz", argv=[], master_uri=core.uri) as rviz:
        grids = await rviz.advertise("/fleet/map", TYPE, latch=True)
        grids.publish(grid_fields(GRID, (), rviz.now()))
        logs = await rviz.subscribe("/rosout", "rosgraph_msgs/Log")
        stops = await rviz.subscribe("/Robot1/move_base/cancel", "actionlib_msgs/GoalID")
        states = await rviz.advertise("/Robot1/move_base/status", "actionlib_msgs/GoalStatusArray")

        async def publish_states() -> None:
            goals = [{"goal_id": {"id": name}, "status": 1} for name in ("/rviz-1", "Robot1-5.0-1")]
            while await rviz.sleep(0.1):
                states.publish(status_list=goals)

        async with Node("move_client", namespace="Robot1", argv=[], master_uri=core.uri) as node:
            tasks = [asyncio.create_task(MoveClientNode(node).run()), asyncio.create_task(publish_states())]
            async with asyncio.timeout(PATIENCE):
                found = await anext(line.msg async for line in logs if "is cancelled" in line.msg)
                await anext(aiter(stops))
            assert "the goal '/rviz-1' is cancelled: robots of a fleet enter only cells" in found
            node.shutdown("the test is over")
            await tasks[0]
            tasks[1].cancel()
