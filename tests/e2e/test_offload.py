"""A robot whose localization and navigation run in its container drives; it stops while they are silent."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import hypot
from pathlib import Path

import pytest
from support.engine import Engine, Program, running_engine, until

from rce.config.documents import write_items
from rce.ros.node import Node
from rce.ros.types import Message
from rce_fleet.turtlebot_wiring import offloaded_config
from rce_fleet.wiring import FleetAccount, fleet_config

pytestmark = [pytest.mark.e2e, pytest.mark.needs("pymunk")]

CONFIGS = Path(__file__).parents[2] / "configs"
BIN = Path(sys.executable).parent
START, GOAL = (0.5, 0.5), (2.5, 0.5)
WAIT_S = 150.0


class Truth:
    """Where the robot really is."""

    def __init__(self) -> None:
        self.x = self.y = self.speed = 0.0

    def take(self, message: Message) -> None:
        place = message.pose.pose.position
        self.x, self.y = place.x, place.y
        self.speed = abs(message.twist.twist.linear.x)

    def far_from(self, place: tuple[float, float]) -> float:
        return hypot(self.x - place[0], self.y - place[1])


@asynccontextmanager
async def started(engine: Engine, uri: str, ready: str, name: str, *words: str) -> AsyncIterator[Program]:
    env = {**engine.env, "ROS_MASTER_URI": uri, "ROS_LOG_DIR": str(engine.folder / "log")}
    program = Program(name, [str(BIN / words[0]), *words[1:]], env, engine.folder)
    await program.start(ready=ready)
    try:
        yield program
    finally:
        if program.running:
            await program.stop()
        print(program.output())  # noqa: T201 - shown if the test fails


@asynccontextmanager
async def simulated(engine: Engine) -> AsyncIterator[str]:
    """The fleet's floor with sensors and wheels only; gives the master of robot 1."""
    words = ("rce", "sim", str(CONFIGS / "scene.yaml"), "--no-stand-ins", "--core-port", "0")
    async with started(engine, "", "simulation ready", "sim", *words, "--world-port", "0") as sim:
        line = next(line for line in sim.output().splitlines() if line.startswith("robot Robot1 "))
        yield line.partition("ROS_MASTER_URI=")[2]


def written(folder: Path, name: str, config: dict[str, object]) -> str:
    file = folder / name
    file.write_text(write_items(config))
    return str(file)


async def test_an_offloaded_robot_drives_and_stops_without_its_cloud(tmp_path: Path) -> None:
    async with running_engine() as engine, simulated(engine) as uri:
        account = FleetAccount(url=engine.url)
        robot = written(tmp_path, "robot.config", offloaded_config(1, account, initial_pose=(*START, 0.0)))
        fleet = written(tmp_path, "fleet.config", fleet_config(account))
        launch = ("rce", "launch", str(CONFIGS / "turtlebot" / "botmotion.launch"), "offload:=true")
        async with (
            started(engine, uri, "/velocity_limiter: started", "launch", *launch),
            started(engine, uri, " ready: ", "fleet", "rce-ros", fleet),
            started(engine, uri, " ready: ", "bridge", "rce-ros", robot) as bridge,
            Node("judge", argv=[], master_uri=uri, signals=False) as judge,
        ):
            truth = Truth()
            await judge.subscribe("/ground_truth/pose", "nav_msgs/Odometry", truth.take)
            goals = await judge.advertise("/move_base_simple/goal", "geometry_msgs/PoseStamped")
            async with asyncio.timeout(WAIT_S):
                await goals.wait_for_subscribers()

            def send_goal() -> None:
                goals.publish(
                    header={"frame_id": "map", "stamp": judge.now()},
                    pose={"position": {"x": GOAL[0], "y": GOAL[1]}, "orientation": {"w": 1.0}},
                )

            async def is_driving() -> bool:
                send_goal()
                await asyncio.sleep(3.0)
                return truth.far_from(START) > 0.3

            await until(is_driving, timeout=WAIT_S, what="the robot drives")
            assert bridge.process is not None
            bridge.process.send_signal(signal.SIGSTOP)  # the network hangs
            try:
                await until(lambda: truth.speed < 0.02, timeout=10.0, what="the robot stands")
                assert truth.far_from(GOAL) > 0.3
            finally:
                bridge.process.send_signal(signal.SIGCONT)

            async def has_arrived() -> bool:
                send_goal()  # move_base may have given the goal up meanwhile
                await asyncio.sleep(5.0)
                return truth.far_from(GOAL) < 0.25

            await until(has_arrived, timeout=WAIT_S, what="the robot arrives")
