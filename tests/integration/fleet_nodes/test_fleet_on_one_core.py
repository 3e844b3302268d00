"""A fleet on one ROS core, without the engine: nodes as processes, simulated robots, a cell blocked."""

from __future__ import annotations

import asyncio
import os
from contextlib import AsyncExitStack, asynccontextmanager
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, TypeRegistry
from rce_fleet.drivers.program import run_world
from rce_fleet.drivers.robot_driver import RobotDriver
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.scenario import Scenario, make_scenario, midway_cell
from rce_fleet.simulation.boxes import BoxKeeper
from rce_fleet.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

EXAMPLES = Path(__file__).parents[3] / "examples"
PACKAGES = PackageIndex([EXAMPLES])


@asynccontextmanager
async def program(core: Core, exe: str, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A node of the package ``fleet``; at the end it is asked to stop and has to."""
    command = [*PACKAGES.find("fleet").executable(exe), *arguments]
    environ = {**os.environ, "ROS_MASTER_URI": core.uri, "RCE_PACKAGE_PATH": str(EXAMPLES)}
    process = await asyncio.create_subprocess_exec(*command, env=environ)
    try:
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
        assert await asyncio.wait_for(process.wait(), 60) == 0


class Fleet:
    """A scenario on one core, and what its planner says."""

    def __init__(self, scenario: Scenario, core: Core, seed: int) -> None:
        self.scenario = scenario
        self.core = core
        self.world = World(scenario.grid, seed=seed)
        self.keeper = BoxKeeper(self.world)
        self.newest: Message | None = None
        self._changed = asyncio.Event()
        self._node: Node
        for robot, cell, yaw in zip(scenario.robots, scenario.starts, scenario.headings, strict=True):
            self.world.add_robot(robot, cell, yaw)
        for cell in scenario.boxes:
            self.world.add_box(cell)

    async def start(self, stack: AsyncExitStack) -> None:
        types = TypeRegistry(PACKAGES)
        boxes = list(self.scenario.known_boxes)
        await stack.enter_async_context(program(self.core, "fleet_planner.py", f"_blocked:={boxes}"))
        for robot in self.scenario.robots:
            await stack.enter_async_context(program(self.core, "move_client.py", f"__ns:={robot}"))
        drivers = []
        for robot in self.scenario.robots:
            node = Node("robot", namespace=robot, argv=[], master_uri=self.core.uri, types=types)
            driver = RobotDriver(await stack.enter_async_context(node), self.world, robot)
            await driver.start()
            drivers.append(driver)
        self._node = await stack.enter_async_context(
            Node("operator", argv=[], master_uri=self.core.uri, types=types)
        )
        await self._node.subscribe("/fleet/state", "fleet/FleetState", self._take_state)
        await self._node.subscribe(
            "/fleet/blockedCells",
            "std_msgs/Int32MultiArray",
            lambda message: self.keeper.follow(message.data),
        )
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        running = tasks.create_task(run_world(self.world, drivers, after_update=self._after_update, pace=2.0))
        stack.callback(running.cancel)

    def _after_update(self) -> None:
        self.keeper.update()

    def _take_state(self, message: Message) -> None:
        self.newest = message
        self._changed.set()

    async def until(self, condition: Callable[[], bool], timeout: float = 50.0) -> None:
        async with asyncio.timeout(timeout):
            while self.newest is None or not condition():
                self._changed.clear()
                await self._changed.wait()

    async def ask(self, service: str, kind: str, **fields: object) -> Message:
        await self._node.wait_for_service(service, timeout=10)
        reply = await self._node.service_client(service, kind)(**fields)
        assert reply.ok, reply.message
        return reply

    @property
    def state(self) -> Message:
        """What the planner said last."""
        assert self.newest is not None
        return self.newest

    def robots_in(self, *states: str) -> int:
        return sum(robot.state in states for robot in self.state.robots)


async def test_three_robots_drive_around_a_blocked_cell() -> None:
    """Three robots reach their goals around a cell blocked midway."""
    seed = 6
    scenario = make_scenario(GridMap(), 3, seed=seed)
    async with Core(port=0) as core, AsyncExitStack() as stack:
        fleet = Fleet(scenario, core, seed)
        await fleet.start(stack)
        await fleet.until(lambda: fleet.robots_in("idle") == 3)
        for robot, goal in zip(scenario.robots, scenario.goals, strict=True):
            await fleet.ask("/fleet/set_goal", "fleet/SetGoal", robot=robot, cell=goal)
        await fleet.until(lambda: fleet.robots_in("driving") == 3)
        grid = scenario.grid.with_blocked(fleet.world.boxes)
        plans = {robot.id: list(robot.plan) for robot in fleet.state.robots}
        cell = midway_cell(grid, plans, dict(zip(scenario.robots, scenario.goals, strict=True)))
        assert cell is not None
        await fleet.ask("/fleet/block_cell", "fleet/BlockCell", cell=cell, blocked=True)
        await fleet.until(lambda: fleet.robots_in("arrived") == 3)
        assert cell in fleet.world.boxes
        assert set(fleet.state.blocked) >= {cell, *scenario.known_boxes}
        assert sum(robot.replans for robot in fleet.state.robots) >= 1
        assert fleet.world.collisions.total == 0
        assert 0.1 < fleet.world.min_separation < inf
        for robot, goal in zip(scenario.robots, scenario.goals, strict=True):
            pose = fleet.world.robots[robot].pose
            assert scenario.grid.cell_at(pose.x, pose.y) == goal
        await fleet.ask("/fleet/block_cell", "fleet/BlockCell", cell=cell, blocked=False)
        await fleet.until(lambda: cell not in fleet.state.blocked)
