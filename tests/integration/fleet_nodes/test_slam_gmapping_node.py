"""``slam_gmapping`` on a real core: topics, service, frames, saved maps, and what it does with bad input."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from math import hypot, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.simulated_scans import Robot, hall

from rce.ros.core import Core
from rce.ros.errors import ServiceFaultError
from rce.ros.node import Node
from rce.ros.tf import TransformListener
from rce.ros.types import Message, Time
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.ros_map import load_map
from rce_fleet.nodes import map_saver
from rce_fleet.nodes.planar import pose_of, read_map
from rce_fleet.nodes.slam_gmapping import SlamGmappingNode, SlamGmappingParameters

PATIENCE = 240.0
START = Pose(1.0, 1.0, 0.3)
SETTINGS = SlamGmappingParameters(
    particles=3, linear_update=0.2, angular_update=0.2, map_update_interval=0.0, seed=1
)


class World:
    """A core with the node, a robot, and a judge who hears everything."""

    def __init__(self, core: Core, judge: Node, robot: Robot) -> None:
        self.core = core
        self.judge = judge
        self.robot = robot
        self.maps: list[Message] = []
        self.entropies: list[float] = []
        self.logs: list[str] = []
        self.states: list[str] = []
        self.changed = asyncio.Event()

    async def listen(self, stack: AsyncExitStack) -> None:
        def keep(into: list[Any], read: Callable[[Message], Any]) -> Callable[[Message], None]:
            def take(message: Message) -> None:
                into.append(read(message))
                self.changed.set()

            return take

        judge = self.judge
        await judge.subscribe("map", "nav_msgs/OccupancyGrid", keep(self.maps, lambda m: m))
        await judge.subscribe(
            "slam_gmapping/entropy", "std_msgs/Float64", keep(self.entropies, lambda m: m.data)
        )
        await judge.subscribe("/rosout", "rosgraph_msgs/Log", keep(self.logs, lambda m: m.msg))
        await judge.subscribe(
            "/diagnostics",
            "diagnostic_msgs/DiagnosticArray",
            keep(self.states, lambda m: m.status[0].message),
        )
        self.tf = await stack.enter_async_context(TransformListener(judge))

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not condition():
                self.changed.clear()
                await self.changed.wait()

    async def says(self, text: str) -> None:
        await self.until(lambda: any(text in line for line in self.logs))

    async def drive(self, steps: int) -> None:
        """Drive in steps that each make a new map."""
        for _ in range(steps):
            number = len(self.maps)
            self.robot.drive(0.21, 0.12)
            self.robot.publish()
            await self.until(lambda: len(self.maps) > number)  # noqa: B023 - called within the step


@asynccontextmanager
async def world() -> AsyncIterator[World]:
    async with AsyncExitStack() as stack:
        core = await stack.enter_async_context(Core(port=0))

        async def node(name: str) -> Node:
            return await stack.enter_async_context(Node(name, argv=[], master_uri=core.uri))

        judge, source = await node("judge"), await node("robot")
        robot = Robot(source, START)
        made = World(core, judge, robot)
        await made.listen(stack)
        await robot.start(stack)
        slam = await node("slam_gmapping")
        running = asyncio.create_task(SlamGmappingNode(slam, SETTINGS).run())
        try:
            async with asyncio.timeout(PATIENCE):
                while not robot._scans.connections:
                    await asyncio.sleep(0.05)
            yield made
            assert not running.done()
        finally:
            slam.shutdown("the test is over")
            await running


async def test_a_driving_robot_makes_a_map(tmp_path: Path) -> None:
    async with world() as here:
        dynamic_map = here.judge.service_client("dynamic_map", "nav_msgs/GetMap")
        with pytest.raises(ServiceFaultError, match="no map yet"):
            await dynamic_map.call({}, timeout=PATIENCE)
        here.robot.publish()
        await here.until(lambda: here.maps)
        await here.drive(7)
        drawn = read_map(here.maps[-1])
        assert here.maps[-1].header.frame_id == "map"
        assert drawn.resolution == pytest.approx(0.05)
        seen = (hall().cell_to_world(np.argwhere(hall().occupied)) - (START.x, START.y)) @ np.array(
            [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
        )
        away = np.hypot(*(drawn.cell_to_world(np.argwhere(drawn.occupied))[:, None] - seen[None]).T).min(
            axis=0
        )
        assert np.median(away) < 0.05
        assert drawn.occupied.sum() > 150
        answer = await dynamic_map.call({}, timeout=PATIENCE)
        assert answer.map.info.width == here.maps[-1].info.width
        await here.until(lambda: here.entropies)
        assert 0 <= here.entropies[-1] <= np.log(3) + 1e-9
        tf = await here.tf.wait_for("map", "odom", timeout=PATIENCE)
        base = pose_of(tf.transform).compose(here.robot.odometry)
        truth = here.robot.pose.relative_to(START)
        assert hypot(base.x - truth.x, base.y - truth.y) < 0.15
        await here.until(lambda: "mapping" in here.states)
        saved = await save(here, tmp_path / "hall")
        assert (load_map(saved).data == drawn.data).all()


async def save(here: World, path: Path) -> Path:
    async with Node("map_saver", argv=[], master_uri=here.core.uri) as node:
        async with asyncio.timeout(PATIENCE):
            written = await map_saver.save(node, map_saver.parse(["-f", str(path)]))
    assert written is not None
    return written


async def test_bad_scans_are_reported_and_left_out() -> None:
    async with world() as here:
        stamp = here.robot.publish()
        await here.until(lambda: here.maps)
        here.robot.publish(Time.from_sec(stamp.to_sec() - 5.0))
        await here.says("older than the last one and is left out")
        here.robot.publish(angle_increment=nan)
        await here.says("must be finite")
        here.robot.publish(ranges=np.ones(7))
        await here.until(lambda: any("it has 7 ranges" in text for text in here.states))
        here.robot.publish(Time.from_sec(here.judge.time() + 50.0), transform=False)
        await here.says("in the future) cannot be used")
        here.robot.publish(ranges=np.full(90, nan))
        await here.drive(2)


async def test_odometry_that_jumps_is_reported_and_bridged() -> None:
    async with world() as here:
        here.robot.publish()
        await here.until(lambda: here.maps)
        await here.drive(2)
        here.robot.odometry = Pose(80.0, -40.0, 2.0)
        here.robot.publish()
        await here.says("the odometry jumped")
        await here.drive(2)
        async with asyncio.timeout(PATIENCE):
            while True:
                tf = await here.tf.wait_for("map", "odom", timeout=PATIENCE)
                base = pose_of(tf.transform).compose(here.robot.odometry)
                truth = here.robot.pose.relative_to(START)
                if hypot(base.x - truth.x, base.y - truth.y) < 0.2:
                    break
                await asyncio.sleep(0.05)
