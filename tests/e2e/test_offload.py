"""A robot whose localization and navigation run in its container stops without them, and then goes on."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from math import hypot
from pathlib import Path

import aiohttp
import psutil
import pytest
from support.by_hand import CONFIGS, WAIT_S, page_of, simulated, started, wait_state
from support.engine import Engine, command_line, running_engine, until

from rce.config.documents import write_items
from rce.ros.node import Node
from rce.ros.types import Message
from rce_fleet.station.client import StationClient
from rce_fleet.turtlebot_wiring import offloaded_config
from rce_fleet.wiring import FleetAccount, fleet_config

pytestmark = [pytest.mark.e2e, pytest.mark.needs("pymunk")]

START = (0.5, 0.5)
GOAL_CELL, GOAL = 6, (6.5, 0.5)
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


async def test_offloaded_robot_goes_on_after_its_cloud_was_away(tmp_path: Path) -> None:
    """The goal is set once; the network hangs under way, and the container is killed; the robot arrives."""
    async with running_engine() as engine, simulated(engine, "--no-stand-ins") as robots:
        uri = robots["Robot1"]
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
            station = StationClient(session, page_of(page))
            judge = Judge(node)
            await judge.listen()
            await wait_state(station, "idle", "Robot1")
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

            await wait_state(station, "arrived", "Robot1")
            assert environment_of(engine, "move_base").pid != killed.pid
            assert judge.far_from(GOAL) < 0.25
            anew = [error for stamp, error in judge.localized if stamp > killed_at]
            assert anew
            assert max(anew) < 0.3
