"""Runs a world and its robots, each with its ROS graph."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce.ros.core import Core
from rce.ros.errors import MasterError
from rce.ros.node import Node, TypeRegistry
from rce.ros.node.clock import PARAMETER as USE_SIM_TIME
from rce.ros.tf import frames
from rce_fleet.drivers.light_driver import LightDriver
from rce_fleet.drivers.report import look_at, write_report
from rce_fleet.drivers.robot_driver import RobotDriver
from rce_fleet.drivers.runner import WorldRunner, run_world
from rce_fleet.drivers.world_services import WorldServices
from rce_fleet.exceptions import FleetError
from rce_fleet.simulation.boxes import BoxKeeper

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping
    from pathlib import Path

    from rce_fleet.drivers.cell_watch import CellWatch
    from rce_fleet.drivers.scene import RobotStart, Scene
    from rce_fleet.simulation.world import World

__all__ = ["Cores", "RunOptions", "Simulation", "run_world"]

MAX_PORT = 65535
REPORT_EVERY = 0.5
"""Seconds between two reports."""
ROBOT_NODE = "robot"
"""Name of a robot's node in its namespace, if it joins an existing graph."""
WORLD_NODE = "simulation"


@dataclass(frozen=True, slots=True)
class Cores:
    """URIs of ROS masters. A robot without one gets its own graph and no namespace."""

    default: str | None = None
    """For robots that are not listed."""
    robots: Mapping[str, str] = field(default_factory=dict)
    namespaces: bool = True
    """Whether robots join them in namespaces, with prefixes of their frames."""

    @classmethod
    def read(cls, texts: Iterable[str], *, namespaces: bool = True) -> Cores:
        """Read ``URI`` (for all robots) and ``ROBOT=URI``."""
        default, robots = None, {}
        for text in texts:
            robot, separator, uri = text.partition("=")
            if separator and "/" not in robot:
                robots[robot] = uri
            else:
                default = text
        return cls(default, robots, namespaces)

    def of(self, robot: str) -> str | None:
        """Return the master of a robot's graph; None for its own graph."""
        return self.robots.get(robot, self.default)


@dataclass(frozen=True, slots=True)
class RunOptions:
    """How a world runs.

    Attributes:
        factor: Simulated seconds per second; 0: as many as the machine can.
        clock: Whether time is simulated: ``/clock``, and the parameter ``use_sim_time``.
        core_port: Port of the first robot's core, the others' follow; 0: any free ports.
        world_port: Port of the core with the world's services; 0: any free port; None: no services.
        stand_ins: Whether robots run what stands for ``amcl`` and ``move_base``; None: as the scene says.
    """

    factor: float = 1.0
    clock: bool = False
    core_port: int = 0
    world_port: int | None = None
    stand_ins: bool | None = None


class PortTakenError(Exception):
    """The port of a core is in use, or there is none left."""


class Simulation:
    """Runs a world, with a ROS node for each robot.

    Args:
        scene: Map, boxes and robots.
        types: Where message types come from.
        say: Prints a line for the user and for the program that started this one.
        report: File that the report is written to; none if None.
        watch: Watches the cells that the planner blocks; None if no planner does.
        cores: The ROS graphs that the robots join.
        options: How it runs.

    Raises:
        ConfigError: Something in the scene is wrong.
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
        options: RunOptions = RunOptions(),
    ) -> None:
        self._scene = scene
        self._types = types
        self._say = say
        self._report = report
        self._world = scene.build()
        self._boxes = BoxKeeper(self._world)
        self._watch = watch
        self._cores = cores
        self._options = options
        self._runner = WorldRunner(self._world, factor=options.factor, simulated_clock=options.clock)
        self._runner.on_update.append(self._update_boxes)
        self._runner.on_slow = self._report_speed
        self._tasks: asyncio.TaskGroup | None = None
        self._graphs: dict[str, _RobotGraph] = {}
        self._ports = 0
        self._unwritten = ""
        """Why the last report was not written; empty if it was."""

    @property
    def world(self) -> World:
        """The world."""
        return self._world

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; the last report is written at the end.

        Raises:
            PortTakenError: The port of a core is in use (in an exception group).
        """
        try:
            async with asyncio.TaskGroup() as tasks, AsyncExitStack() as stack:
                self._tasks = tasks
                stack.push_async_callback(self._stop_graphs)
                for robot in self._scene.robots:
                    await self._start_graph(robot.id)
                await self._start_light_robots(stack)
                await self._start_services(stack)
                work = [tasks.create_task(self._runner.run()), tasks.create_task(self._keep_report())]
                if self._watch is not None:
                    work.append(tasks.create_task(self._watch.run(self._boxes.follow)))
                work.append(tasks.create_task(self._announce()))
                await stop.wait()
                for task in work:
                    task.cancel()
        finally:
            self._write_report()

    # Robots that come and go

    async def add_robot(self, start: RobotStart) -> str:
        """Put a robot into the world, and start its node; return the URI of its ROS master.

        Raises:
            ConfigError: Its model is not known.
            FleetError: It has no room, or its node cannot be started; then it is not in the world.
        """
        self._scene.place(start, self._world)
        try:
            return await self._start_graph(start.id)
        except BaseException as error:
            await self.remove_robot(start.id)
            if isinstance(error, (PortTakenError, MasterError)):
                raise FleetError(f"{start.id} was not put in: {error}") from error
            raise

    async def remove_robot(self, robot: str) -> None:
        """Stop a robot's node, and take the robot out of the world."""
        graph = self._graphs.pop(robot, None)
        if graph is None:  # another request removes it
            return
        await graph.stop()
        self._world.remove_robot(robot)

    # Inside

    async def _start_graph(self, robot: str) -> str:
        assert self._tasks is not None, "robots start while the simulation runs"
        graph = self._graphs[robot] = _RobotGraph(robot)
        graph.task = self._tasks.create_task(graph.keep(self._enter_graph), name=f"robot {robot}")
        # A request that is cancelled must not cancel the start, which the graph's task completes.
        return await asyncio.shield(graph.started)

    async def _stop_graphs(self) -> None:
        for graph in list(self._graphs.values()):
            await graph.stop()
        self._graphs.clear()

    async def _enter_graph(self, robot: str, stack: AsyncExitStack) -> str:
        """Start a robot's core and node, which the stack ends; return the core's URI."""
        uri = self._cores.of(robot)
        if uri is None:
            uri = await self._start_core(stack, self._next_port(), f"robot {robot}")
            name, namespace, prefix = robot, "", ""
        else:
            prefix = robot if self._cores.namespaces else ""
            name, namespace = ROBOT_NODE, prefix
        node = await self._join(stack, name, uri, namespace)
        if prefix:
            await node.set_param(frames.PARAMETER, prefix)
        stack.callback(self._runner.drop_clock, uri)
        stand_ins = self._scene.stand_ins if self._options.stand_ins is None else self._options.stand_ins
        driver = RobotDriver(
            node, self._world, robot, tf_prefix=prefix, stand_in=stand_ins, now=self._runner.stamp
        )
        await driver.start()
        self._runner.drivers[robot] = driver
        stack.callback(self._runner.drivers.pop, robot, None)
        self._say(f"robot {robot} ROS_MASTER_URI={uri}")
        return uri

    async def _start_light_robots(self, stack: AsyncExitStack) -> None:
        """Start the graphs of light robots: many robots share one, by namespaces."""
        light, share = self._world.light, self._scene.light_per_graph
        if light is None:
            return
        drivers = []
        for first in range(0, len(light), share):
            rows = range(first, min(first + share, len(light)))
            names = f"{light.names[rows[0]]} to {light.names[rows[-1]]}"
            uri = self._cores.default or await self._start_core(stack, self._next_port(), f"robots {names}")
            node = await self._join(stack, f"light_robots_{first + 1}", uri)
            driver = LightDriver(node, light, rows, self._runner.stamp)
            await driver.start()
            drivers.append(driver)
            self._say(f"robots {names} ROS_MASTER_URI={uri}")

        def update() -> None:
            ended = light.take_ended()
            for driver in drivers:
                driver.update(ended)

        self._runner.on_update.append(update)
        self._runner.on_reset.extend(driver.reset for driver in drivers)

    def _next_port(self) -> int:
        """Return the port of the next robot's core."""
        if not self._options.core_port:
            return 0
        port = self._options.core_port + self._ports
        if port > MAX_PORT:
            first = self._options.core_port
            raise PortTakenError(
                f"there are too few ports from {first} on for all cores; choose smaller ones"
            )
        self._ports += 1
        return port

    async def _start_core(self, stack: AsyncExitStack, port: int, whose: str) -> str:
        core = Core(port=port)
        try:
            await stack.enter_async_context(core)
        except OSError as error:
            text = f"the core of {whose} cannot listen on port {port}: {error.strerror or error}"
            raise PortTakenError(f"{text}; end the program that does, or choose other ports") from error
        return core.uri

    async def _join(self, stack: AsyncExitStack, name: str, uri: str, namespace: str = "") -> Node:
        """Return a node of a graph, which the stack ends; the graph has the world's clock then."""
        node = Node(name, namespace=namespace, argv=(), master_uri=uri, types=self._types, signals=False)
        await stack.enter_async_context(node)
        if self._options.clock:
            await node.set_param(USE_SIM_TIME, value=True)
        await self._runner.publish_clock(node)
        return node

    async def _start_services(self, stack: AsyncExitStack) -> None:
        port = self._options.world_port
        if port is None:
            return
        uri = self._cores.default or await self._start_core(stack, port, "the world")
        node = await self._join(stack, WORLD_NODE, uri)
        await WorldServices(node, self._runner, self).start()
        self._say(f"world ROS_MASTER_URI={uri}")

    async def _announce(self) -> None:
        if self._watch is not None:
            await self._watch.joined.wait()
        robots = len(self._scene.robots) + len(self._scene.light_robots)
        self._say(f"simulation ready: {robots} robots, {len(self._scene.boxes)} boxes")

    def _update_boxes(self) -> None:
        self._boxes.update()

    def _report_speed(self, speed: float) -> None:
        self._say(f"simulation: runs at {speed:.2f} of real time, not at {self._runner.factor:g}")

    async def _keep_report(self) -> None:
        while True:
            self._write_report()
            await asyncio.sleep(REPORT_EVERY)

    def _write_report(self) -> None:
        if self._report is None:
            return
        try:
            write_report(look_at(self._world), self._report)
        except OSError as error:
            text = f"simulation: the report {self._report} cannot be written: {error.strerror or error}"
            if text != self._unwritten:
                self._say(text)
            self._unwritten = text
        else:
            self._unwritten = ""


class _RobotGraph:
    """Keeps a robot's core and node in a task of their own, which starts and ends them."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.started: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self.task: asyncio.Task[None] | None = None
        self._stop = asyncio.Event()

    async def keep(self, enter: Callable[[str, AsyncExitStack], Awaitable[str]]) -> None:
        """Start, wait until :meth:`stop` is called, end."""
        try:
            async with AsyncExitStack() as stack:
                self.started.set_result(await enter(self.robot, stack))
                await self._stop.wait()
        except Exception as error:
            if self.started.done():
                raise
            self.started.set_exception(error)

    async def stop(self) -> None:
        """End core and node, and wait until they have ended."""
        self._stop.set()
        if self.task is not None:
            await asyncio.wait([self.task])
