"""Runs a world and its robots until told to stop."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from rce.fleet.simulation.boxes import BoxKeeper
from rce.ros.core import Core
from rce.ros.node import Node
from rce_client.simulation.block_watch import BlockWatch
from rce_client.simulation.report import look_at, write_report
from rce_client.simulation.robot_driver import RobotDriver
from rce_client.simulation.runner import run_world

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rce.fleet.simulation.world import World
    from rce.ros.types import TypeRegistry
    from rce_client.simulation.account import Account
    from rce_client.simulation.scene import Scene

REPORT_EVERY = 0.5
"""Seconds between two reports."""


class Simulation:
    """A world in real time, each robot with a ROS graph of its own.

    Args:
        scene: What stands where.
        types: Where message types come from.
        say: Gets lines for people and for programs that start this one.
        report: File that the report is written to; none if None.
        account: The engine whose planner blocks cells; none if None.
        container: Tag of the planner's container.
    """

    def __init__(
        self,
        scene: Scene,
        types: TypeRegistry,
        say: Callable[[str], None],
        *,
        report: Path | None = None,
        account: Account | None = None,
        container: str = "cTag_fleet",
    ) -> None:
        self._scene = scene
        self._types = types
        self._say = say
        self._report = report
        self._world = scene.build()
        self._boxes = BoxKeeper(self._world)
        self._watch = None if account is None else BlockWatch(account, container, self._boxes.follow)

    @property
    def world(self) -> World:
        """The world."""
        return self._world

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; the last report is written at the end."""
        try:
            async with AsyncExitStack() as graphs:
                drivers = [await self._start_robot(graphs, robot.id) for robot in self._scene.robots]
                async with asyncio.TaskGroup() as tasks:
                    work = [
                        tasks.create_task(run_world(self._world, drivers, after_update=self._after_update)),
                        tasks.create_task(self._keep_report()),
                    ]
                    if self._watch is not None:
                        work.append(tasks.create_task(self._watch.run()))
                    work.append(tasks.create_task(self._announce()))
                    await stop.wait()
                    for task in work:
                        task.cancel()
        finally:
            self._write_report()

    async def _start_robot(self, graphs: AsyncExitStack, robot: str) -> RobotDriver:
        core = await graphs.enter_async_context(Core(port=0))
        node = Node(robot, argv=(), master_uri=core.uri, types=self._types, signals=False)
        driver = RobotDriver(await graphs.enter_async_context(node), self._world, robot)
        await driver.start()
        self._say(f"robot {robot} ROS_MASTER_URI={core.uri}")
        return driver

    async def _announce(self) -> None:
        if self._watch is not None:
            await self._watch.joined.wait()
        self._say(f"simulation ready: {len(self._scene.robots)} robots, {len(self._scene.boxes)} boxes")

    def _after_update(self) -> None:
        self._boxes.update()

    async def _keep_report(self) -> None:
        while True:
            self._write_report()
            await asyncio.sleep(REPORT_EVERY)

    def _write_report(self) -> None:
        if self._report is not None:
            write_report(look_at(self._world), self._report)
