"""Runs a world and its robots in real time."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import frames
from rce_fleet.drivers.report import look_at, write_report
from rce_fleet.drivers.robot_driver import RobotDriver
from rce_fleet.simulation.boxes import BoxKeeper

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    from rce.ros.types import TypeRegistry
    from rce_fleet.drivers.cell_watch import CellWatch
    from rce_fleet.drivers.scene import Scene
    from rce_fleet.simulation.world import World

REPORT_EVERY = 0.5
"""Seconds between two reports."""
ROBOT_NODE = "robot"
"""Name of a robot's node in its namespace, if it joins an existing graph."""
PERIOD = 0.05
"""Seconds between two updates of the robots."""
MAX_LAG = 0.5
"""Maximum delay behind the clock that is caught up, seconds."""


@dataclass(frozen=True, slots=True)
class Cores:
    """URIs of ROS masters. A robot without one gets its own graph and no namespace."""

    default: str | None = None
    """For robots that are not listed."""
    robots: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, texts: Iterable[str]) -> Cores:
        """Read ``URI`` (for all robots) and ``ROBOT=URI``."""
        default, robots = None, {}
        for text in texts:
            robot, separator, uri = text.partition("=")
            if separator and "/" not in robot:
                robots[robot] = uri
            else:
                default = text
        return cls(default, robots)

    def of(self, robot: str) -> str | None:
        """Return the master of a robot's graph; None for its own graph."""
        return self.robots.get(robot, self.default)


class Simulation:
    """Runs a world in real time, with a ROS node for each robot.

    Args:
        scene: Map, boxes and robots.
        types: Where message types come from.
        say: Prints a line for the user and for the program that started this one.
        report: File that the report is written to; none if None.
        watch: Watches the cells that the planner blocks; None if no planner does.
        cores: The ROS graphs that the robots join.
    """

    def __init__(
        self,
        scene: Scene,
        types: TypeRegistry,
        say: Callable[[str], None],
        *,
        report: Path | None = None,
        watch: CellWatch | None = None,
        cores: Cores = Cores(),
    ) -> None:
        self._scene = scene
        self._types = types
        self._say = say
        self._report = report
        self._world = scene.build()
        self._boxes = BoxKeeper(self._world)
        self._watch = watch
        self._cores = cores

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
                        work.append(tasks.create_task(self._watch.run(self._boxes.follow)))
                    work.append(tasks.create_task(self._announce()))
                    await stop.wait()
                    for task in work:
                        task.cancel()
        finally:
            self._write_report()

    async def _start_robot(self, graphs: AsyncExitStack, robot: str) -> RobotDriver:
        uri = self._cores.of(robot)
        if uri is None:
            core = await graphs.enter_async_context(Core(port=0))
            uri, name, namespace, prefix = core.uri, robot, "", ""
        else:
            name, namespace, prefix = ROBOT_NODE, robot, robot
        node = await graphs.enter_async_context(
            Node(name, namespace=namespace, argv=(), master_uri=uri, types=self._types, signals=False)
        )
        if prefix:
            await node.set_param(frames.PARAMETER, prefix)
        driver = RobotDriver(node, self._world, robot, tf_prefix=prefix)
        await driver.start()
        self._say(f"robot {robot} ROS_MASTER_URI={uri}")
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


async def run_world(
    world: World,
    drivers: Iterable[RobotDriver],
    *,
    after_update: Callable[[], None] | None = None,
    pace: float = 1.0,
) -> None:
    """Run a world in real time until cancelled.

    On a machine that is too slow the world runs slower; delays above MAX_LAG are not caught up.

    Args:
        world: The world.
        drivers: The robots in it.
        after_update: Called after each update.
        pace: Simulated seconds per second.
    """
    loop = asyncio.get_running_loop()
    robots = list(drivers)
    due = loop.time()
    while True:
        world.step(PERIOD)
        for robot in robots:
            robot.update()
        if after_update is not None:
            after_update()
        due = max(due + PERIOD / pace, loop.time() - MAX_LAG)
        await asyncio.sleep(max(0.0, due - loop.time()))
