"""Light robots as a ROS node: what reaches them without the planner."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
import pytest
from support.ros_requests import count_requests

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, TypeRegistry
from rce_fleet.drivers.light_driver import POSE, LightDriver
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.light.robots import LightRobots

TYPES = TypeRegistry(PackageIndex([]))
LIMIT_S = 60


async def until(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not holds():
            await asyncio.sleep(0.02)


async def test_light_robots_obey_stops_and_hands() -> None:
    robots = LightRobots({"Robot1": Pose(0, 0, 0), "Robot2": Pose(0, 5, 0)}, np.empty((0, 4)))
    async with (
        Core(port=0) as core,
        Node("world", argv=[], master_uri=core.uri, types=TYPES) as node,
        Node("station", argv=[], master_uri=core.uri, types=TYPES) as station,
    ):
        await LightDriver(node, robots, range(2)).start()
        stop = await station.advertise("/Robot2/emergency_stop", "std_msgs/Bool", latch=True)
        stop.publish(data=True)
        await until(lambda: robots.stopped.tolist() == [False, True])
        drive = await station.advertise("/Robot1/raw_cmd_vel", "geometry_msgs/Twist")
        await until(lambda: drive.connections)
        drive.publish(linear={"x": 0.4}, angular={"z": 0.1})

        def has_moved() -> bool:
            robots.advance(0.04)
            return bool(robots.bodies.poses[0, 0] > 0)

        await until(has_moved)
        stop.publish(data=False)
        await until(lambda: not robots.stopped.any())


async def test_robots_of_a_slow_world_stay_heard() -> None:
    """A world at a quarter of real time sent a status every 4 s; the fleet took robots for silent.

    A robot that was removed is silent.
    """
    robots = LightRobots({"Robot1": Pose(0, 0, 0), "Robot2": Pose(0, 5, 0)}, np.empty((0, 4)))
    async with (
        Core(port=0) as core,
        Node("world", argv=[], master_uri=core.uri, types=TYPES) as node,
        Node("client", argv=[], master_uri=core.uri, types=TYPES) as client,
    ):
        driver = LightDriver(node, robots, range(2))
        await driver.start()
        robots.remove(1)
        heard: list[float] = []
        removed: list[Message] = []

        def hear(_: Message) -> None:
            heard.append(robots.time)

        for topic, type_name in (("move_base/status", "actionlib_msgs/GoalStatusArray"), ("amcl_pose", POSE)):
            await client.subscribe(f"/Robot2/{topic}", type_name, removed.append)
        await client.subscribe("/Robot1/move_base/status", "actionlib_msgs/GoalStatusArray", hear)

        def update() -> bool:
            robots.advance(0.001)
            driver.update(())
            return len(heard) >= 4

        await until(update)
        assert robots.time < 2
        assert not removed


async def test_topics_of_many_robots_are_registered_in_few_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """A world of a thousand robots was ready after nine thousand of them, one after the other."""
    requests = count_requests(monkeypatch)
    poses = {f"Robot{number}": Pose(0, 5.0 * number, 0) for number in range(100)}
    robots = LightRobots(poses, np.empty((0, 4)))
    async with (
        Core(port=0) as core,
        Node("world", argv=[], master_uri=core.uri, types=TYPES) as node,
        asyncio.timeout(LIMIT_S),
    ):
        before = len(requests)
        await LightDriver(node, robots, range(100)).start()
        assert len(requests) - before < 9 * 100 / 5
        assert len(core.graph.published("/Robot99/")) == 4
