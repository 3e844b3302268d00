"""The hardware of a simulated robot as a ROS node, advanced tick by tick in this process."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from rce.ros.core import Core
from rce.ros.node import Node, Subscriber
from rce.ros.types import Message
from rce_fleet.drivers.robot_driver import RobotDriver
from rce_fleet.drivers.robot_models import load_model
from rce_fleet.drivers.runner import WorldRunner
from rce_fleet.geometry.poses import Pose
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.battery import BatterySpec
from rce_fleet.simulation.models import RobotModel
from rce_fleet.simulation.world import World

pytestmark = pytest.mark.needs("pymunk")

LEFT, CENTER, RIGHT = 0, 1, 2


class Bench:
    """A robot in a world whose time stands still between ticks, and a node that hears and commands it."""

    def __init__(self, runner: WorldRunner, node: Node) -> None:
        self.runner = runner
        self.node = node

    async def hear(self, topic: str, message_type: str) -> list[Message]:
        """A list to which the messages of a topic are added."""
        heard: list[Message] = []
        subscriber: Subscriber = await self.node.subscribe(topic, message_type, heard.append)
        async with asyncio.timeout(30):
            while not subscriber.connections:
                await asyncio.sleep(0.01)
        return heard

    async def run(self, seconds: float, speed: float = 0.0, turn: float = 0.0) -> None:
        """Command the robot ten times a second."""
        for _ in range(round(seconds * 10)):
            self.commands.publish(linear={"x": speed}, angular={"z": turn})
            await asyncio.sleep(0.005)
            for _ in range(5):
                self.runner.tick()
        await asyncio.sleep(0.05)

    async def start(self) -> None:
        """Advertise commands."""
        self.commands = await self.node.advertise("cmd_vel", "geometry_msgs/Twist")
        await self.commands.wait_for_subscribers(1, timeout=30)


@asynccontextmanager
async def bench(model: RobotModel, pose: Pose) -> AsyncIterator[Bench]:
    world = World(GridMap())
    world.place_robot("R", pose, model)
    runner = WorldRunner(world, simulated_clock=True)
    async with Core(port=0) as core:
        hardware = Node("hardware", argv=(), master_uri=core.uri, signals=False)
        tester = Node("tester", argv=(), master_uri=core.uri, signals=False)
        async with hardware, tester:
            driver = RobotDriver(hardware, world, "R", stand_in=False, now=runner.stamp)
            await driver.start()
            runner.drivers["R"] = driver
            made = Bench(runner, tester)
            await made.start()
            yield made


async def test_bumpers_are_pressed_and_released() -> None:
    """A robot that drives against a wall presses its bumper, and releases it when it backs off."""
    async with bench(load_model("turtlebot2"), Pose(1.0, 4.0, math.pi)) as made:
        events = await made.hear("mobile_base/events/bumper", "kobuki_msgs/BumperEvent")
        await made.run(3.0, 0.5)
        assert [(event.bumper, event.state) for event in events] == [(CENTER, 1)]
        await made.run(1.0, -0.3)
        assert [(event.bumper, event.state) for event in events[1:]] == [(CENTER, 0)]


async def test_messages_carry_simulated_time_and_rates() -> None:
    async with bench(load_model("turtlebot2", "lidar"), Pose(4.0, 4.0, 0.0)) as made:
        scans = await made.hear("scan", "sensor_msgs/LaserScan")
        odometry = await made.hear("odom", "nav_msgs/Odometry")
        truth = await made.hear("ground_truth/pose", "nav_msgs/Odometry")
        await made.run(2.0, 0.2)
        assert len(scans) == pytest.approx(20, abs=1)
        # 25 a second, and those of the scans that come between them.
        assert len(odometry) == pytest.approx(60, abs=3)
        assert odometry[-1].header.stamp.to_sec() == pytest.approx(2.0, abs=0.05)
        assert odometry[-1].twist.twist.linear.x == pytest.approx(0.2)
        way = truth[-1].pose.pose.position.x - 4.0
        assert 0.3 < way < 0.4
        assert odometry[-1].pose.pose.position.x == pytest.approx(way, abs=0.05)
        assert odometry[-1].pose.pose.position.x != way


async def test_an_empty_battery_is_reported() -> None:
    battery = BatterySpec(capacity=0.01, idle=18.0, computing=18.0)
    async with bench(RobotModel(battery=battery), Pose(4.0, 4.0, 0.0)) as made:
        states = await made.hear("battery_state", "sensor_msgs/BatteryState")
        reports = await made.hear("/diagnostics", "diagnostic_msgs/DiagnosticArray")
        loads = await made.node.advertise("computing_load", "std_msgs/Float32")
        await loads.wait_for_subscribers(1, timeout=30)
        loads.publish(data=7.0)
        loads.publish(data=1.0)
        await asyncio.sleep(0.1)
        await made.run(3.0, 0.1)
        assert states[0].percentage > states[1].percentage >= states[-1].percentage == 0.0
        assert states[1].current == pytest.approx(-36.0 / states[1].voltage, rel=0.2)
        levels = {status.name: (status.level, status.message) for status in reports[-1].status}
        assert levels["R: battery"][0] == levels["R: drive"][0] == 2
        assert "dock" in levels["R: battery"][1]
        assert made.runner.world.robots["R"].twist.speed == 0.0
