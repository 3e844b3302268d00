"""A robot whose localization and navigation run in its container stops without them, and then goes on."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import hypot
from pathlib import Path

import aiohttp
import psutil
import pytest
from support.engine import Engine, Program, command_line, running_engine, until

from rce.config.documents import write_items
from rce.ros.node import Node
from rce.ros.types import Message
from rce_fleet.exceptions import StationError
from rce_fleet.station.client import StationClient
from rce_fleet.turtlebot_wiring import offloaded_config
from rce_fleet.wiring import FleetAccount, fleet_config

pytestmark = [pytest.mark.e2e, pytest.mark.needs("pymunk")]

CONFIGS = Path(__file__).parents[2] / "configs"
BIN = Path(sys.executable).parent
START = (0.5, 0.5)
GOAL_CELL, GOAL = 6, (6.5, 0.5)
WAIT_S = 150.0
STOP_S = 0.5 + 0.6 + 3.0
"""``command_timeout``, braking, and what a busy machine may add."""


class Judge:
    """What the robot really does, and what it is told."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.x, self.y = START
        self.speed = 0.0
        self.commanded_at = 0.0
        self.localized: list[tuple[float, float]] = []
        """Time stamps of the poses of amcl, and how far they are from the truth, metres."""
        self._truth: dict[float, tuple[float, float]] = {}

    async def listen(self) -> None:
        node = self.node
        await node.subscribe("/ground_truth/pose", "nav_msgs/Odometry", self._take_truth)
        await node.subscribe("/raw_cmd_vel", "geometry_msgs/Twist", self._take_command)
        await node.subscribe("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped", self._take_pose)

    def far_from(self, place: tuple[float, float]) -> float:
        return hypot(self.x - place[0], self.y - place[1])

    def is_silent(self) -> bool:
        """Whether no command came for longer than those of a busy machine are apart."""
        return asyncio.get_running_loop().time() - self.commanded_at > 1.0

    async def passes(self, x: float) -> None:
        """Wait until the robot drives at a place."""
        await until(lambda: self.x > x and self.speed > 0.1, timeout=WAIT_S, what=f"it drives at x = {x}")

    async def stops(self) -> None:
        """Wait until the robot stands because it is not commanded any more, in time."""
        await until(self.is_silent, timeout=WAIT_S, what="no commands come")
        limit = self.commanded_at + STOP_S - asyncio.get_running_loop().time()
        await until(lambda: self.speed < 0.02, timeout=limit, what="the robot stands")
        assert self.far_from(GOAL) > 1.0

    def _take_truth(self, message: Message) -> None:
        place = message.pose.pose.position
        self.x, self.y = place.x, place.y
        self._truth[message.header.stamp.to_sec()] = (place.x, place.y)
        self.speed = abs(message.twist.twist.linear.x)

    def _take_command(self, _message: Message) -> None:
        self.commanded_at = asyncio.get_running_loop().time()

    def _take_pose(self, message: Message) -> None:
        place, stamp = message.pose.pose.position, message.header.stamp.to_sec()
        if not self._truth:  # the latched pose came first; the robot has not been driving yet
            return
        x, y = self._truth[min(self._truth, key=lambda known: abs(known - stamp))]
        self.localized.append((stamp, hypot(place.x - x, place.y - y)))


@asynccontextmanager
async def started(engine: Engine, uri: str, ready: str, name: str, *words: str) -> AsyncIterator[Program]:
    home = {"ROS_HOME": str(engine.folder / "ros"), "ROS_LOG_DIR": str(engine.folder / "log")}
    env = {**engine.env, "ROS_MASTER_URI": uri, **home}
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


def environment_of(engine: Engine, node: str) -> psutil.Process:
    """The environment of the container that a node runs in."""
    for environment in engine.processes_of("rce_container.environment"):
        with contextlib.suppress(psutil.NoSuchProcess):
            children = environment.children(recursive=True)
            if any(node in " ".join(command_line(child)) for child in children):
                return environment
    raise AssertionError(f"{node} runs in no container")


async def state_of(station: StationClient, robot: str) -> str:
    with contextlib.suppress(StationError):
        for one in (await station.fleet()).robots:
            if one.id == robot:
                return one.state
    return ""


async def has_state(station: StationClient, state: str) -> None:
    async def has_it() -> bool:
        return await state_of(station, "Robot1") == state

    await until(has_it, timeout=WAIT_S, what=f"Robot1 is {state}")


async def test_offloaded_robot_goes_on_after_its_cloud_was_away(tmp_path: Path) -> None:
    """The goal is set once; the network hangs under way, and the container is killed; the robot arrives."""
    async with running_engine() as engine, simulated(engine) as uri:
        account = FleetAccount(url=engine.url)
        robot = written(tmp_path, "robot.config", offloaded_config(1, account, initial_pose=(*START, 0.0)))
        fleet = written(tmp_path, "fleet.config", fleet_config(account))
        launch = ("rce", "launch", str(CONFIGS / "turtlebot" / "botmotion.launch"), "offload:=true")
        async with (
            started(engine, uri, "/pose_keeper: started", "launch", *launch),
            started(engine, uri, "rce ui ready: ", "station", "rce", "ui", fleet, "--port", "0") as page,
            started(engine, uri, " ready: ", "bridge", "rce-ros", robot) as bridge,
            Node("judge", argv=[], master_uri=uri, signals=False) as node,
            aiohttp.ClientSession() as session,
        ):
            station = StationClient(session, page.output().partition("rce ui ready: ")[2].split()[0])
            judge = Judge(node)
            await judge.listen()
            await has_state(station, "idle")
            await station.set_goal("Robot1", GOAL_CELL)

            await judge.passes(1.2)
            assert bridge.process is not None
            bridge.process.send_signal(signal.SIGSTOP)  # the network hangs
            try:
                await judge.stops()
            finally:
                bridge.process.send_signal(signal.SIGCONT)

            await judge.passes(judge.x + 0.3)
            killed = environment_of(engine, "move_base")
            killed.kill()
            killed.wait(WAIT_S)
            killed_at = node.time()
            await judge.stops()

            await has_state(station, "arrived")
            assert environment_of(engine, "move_base").pid != killed.pid
            assert judge.far_from(GOAL) < 0.25
            anew = [error for stamp, error in judge.localized if stamp > killed_at]
            assert anew
            assert max(anew) < 0.3
