"""The fleet manager beside a planner whose grid is turned, and is then turned further."""

from __future__ import annotations

import asyncio
import json
import time
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest

from rce.ros.core import Core
from rce.ros.errors import ServiceError
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.journal.journal import Journal
from rce_fleet.nodes.fleet_manager import ManagerNode
from rce_fleet.nodes.grid_topics import GridTopics
from rce_fleet.nodes.manager_parameters import ManagerParameters
from rce_fleet.nodes.state_publisher import StatePublisher
from rce_fleet.planning.grid import GridMap

LONGEST_S = 60.0


class Planner:
    """What a planner publishes of its state."""

    def __init__(self, node: Node, grid: GridMap) -> None:
        self._planner = FleetPlanner(grid)
        self._state = StatePublisher(node, self._planner)
        self._grid = GridTopics(node)

    async def start(self) -> None:
        await self._grid.start()
        self._publish_grid()
        await self._state.start()

    async def publish(self) -> None:
        while True:
            self._state.update(time.monotonic())
            await asyncio.sleep(0.05)

    def take(self, grid: GridMap) -> None:
        """Begin anew with another grid."""
        self._planner = FleetPlanner(grid)
        self._state.restart(self._planner)
        self._publish_grid()
        self._state.publish_whole()

    def _publish_grid(self) -> None:
        self._grid.publish(self._planner.state, self._state.started, ())


async def test_a_turned_grid_is_another_one(tmp_path: Path) -> None:
    """The map of the API says how the grid is turned; tasks on a grid that is turned further are held."""
    types = TypeRegistry(PackageIndex([]))
    async with asyncio.timeout(4 * LONGEST_S), AsyncExitStack() as stack:
        core = await stack.enter_async_context(Core(port=0))

        async def node(name: str) -> Node:
            made = Node(name, argv=[], master_uri=core.uri, types=types, signals=False)
            return await stack.enter_async_context(made)

        planner = Planner(await node("fleet_planner"), GridMap(4, 4, yaw=0.3))
        await planner.start()
        parameters, journal = ManagerParameters(chargers=(3,)), Journal(tmp_path / "j.sqlite")
        stack.callback(journal.close)
        manager = ManagerNode(await node("fleet_manager"), parameters, journal)
        request = (await node("erp")).service_client("/fleet/request", "fleet/Request")

        async def ask(method: str, path: str, body: Any = None) -> Any:
            text = "" if body is None else json.dumps(body)
            fields = {"method": method, "path": path, "body": text, "user": "erp", "role": "operator"}
            while True:
                try:
                    answer = await request.call(fields, timeout=LONGEST_S)
                except ServiceError:
                    await asyncio.sleep(0.05)  # it has not started yet
                    continue
                return json.loads(answer.body)

        async def until(path: str, field: str, value: Any) -> dict[str, Any]:
            while (found := await ask("GET", path)).get(field) != value:
                await asyncio.sleep(0.05)
            return dict(found)

        async with asyncio.TaskGroup() as tasks:
            running = [tasks.create_task(planner.publish()), tasks.create_task(manager.run())]
            assert (await until("/map", "yaw", pytest.approx(0.3)))["rows"] == 4
            assert (await ask("POST", "/tasks", {"stops": [{"cell": 5}]}))["state"] == "queued"
            planner.take(GridMap(4, 4, yaw=1.2))
            assert "another grid" in (await until("/tasks/T1", "state", "held"))["reason"]
            assert (await ask("GET", "/map"))["yaw"] == pytest.approx(1.2)
            assert (await ask("GET", "/chargers"))["chargers"] == []
            for task in running:
                task.cancel()
