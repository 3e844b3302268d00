"""A robot's nodes on the robot and in its container: bandwidth, processor time and control latency of both.

A simulated TurtleBot drives between two cells of the demo's floor with real processes: ``amcl``,
``move_base``, the safety stage, ``rce-ros``, planner and engine. Measured are

* the bytes on the robot's connection to the engine (payload of TCP, by the kernel's counters),
* the processor time of all processes on the robot's side, without the simulation and its ROS core,
* that of the engine with its containers,
* the time from a scan's stamp until a command that takes this scan into account reaches the wheels.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import sys
import tempfile
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from time import perf_counter
from typing import Any

import aiohttp
import psutil
import yaml

from benchmarks.engine import BIN, RunningEngine
from benchmarks.figures import percentile
from rce.config.client import loads
from rce.config.documents import write_items
from rce.config.folders import configs_dir
from rce.ros.node import Node
from rce.ros.types import Message
from rce.supervision.process import Child
from rce_client.ros_bridge.explain import wires
from rce_fleet.exceptions import StationError
from rce_fleet.station.client import StationClient
from rce_fleet.turtlebot_wiring import LAUNCH_FILE, offloaded_config, onboard_config
from rce_fleet.wiring import FleetAccount, fleet_config

ROBOT, CONTAINER = "Robot1", "cTag_01"
START = (0.5, 0.5, 0.0)
GOALS = (6, 0)
"""Cells between which the robot drives."""
READY_S = 120.0
STAMPED = "/move_base/stamped_cmd_vel"
STAMPED_TYPE = "geometry_msgs/TwistStamped"
Command = tuple[float, float]
"""Speed and turn rate, m/s and rad/s."""
WIRINGS = {"nodes on the robot": False, "nodes in its container": True}


class Measurement:
    """Hears what passes in the robot's ROS graph.

    Attributes:
        bytes: Payload by topic.
        speed: Of the robot, m/s.
        measures: Whether messages count. They do not while this process looks at others, which takes a while.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.bytes: dict[str, int] = defaultdict(int)
        self.speed = 0.0
        self.measures = False
        self._stamps: dict[Command, list[float]] = defaultdict(list)
        self._at_wheels: dict[Command, float] = {}

    @property
    def latencies(self) -> list[float]:
        """From a scan's stamp to the wheels, seconds.

        Commands are matched by their numbers, which hardly repeat while a robot steers. Repeated ones,
        straight ones, and those that the safety stage changed do not count.
        """
        return [
            self._at_wheels[command] - stamps[0]
            for command, stamps in self._stamps.items()
            if command[1] and len(stamps) == 1 and command in self._at_wheels
        ]

    async def listen(self, topics: set[str]) -> None:
        """Subscribe to everything.

        Args:
            topics: Topics that the robot's connection carries.
        """
        node = self._node
        for topic in sorted(topics):

            def count(payload: bytes, _latched: bool, topic: str = topic) -> None:
                if self.measures:
                    self.bytes[topic] += len(payload)

            await node.subscribe_serialized(topic, "*", count)
        await node.subscribe("/ground_truth/pose", "nav_msgs/Odometry", self._take_truth)
        await node.subscribe(STAMPED, STAMPED_TYPE, self._take_stamped)
        await node.subscribe("/cmd_vel", "geometry_msgs/Twist", self._take_at_wheels)

    def begin(self) -> None:
        """Forget what was measured until now, and measure."""
        self.measures = True
        self.bytes.clear()
        self._stamps.clear()
        self._at_wheels.clear()

    def _take_truth(self, message: Message) -> None:
        self.speed = abs(message.twist.twist.linear.x)

    def _take_stamped(self, message: Message) -> None:
        command = message.twist.linear.x, message.twist.angular.z
        if self.measures:
            self._stamps[command].append(message.header.stamp.to_sec())

    def _take_at_wheels(self, message: Message) -> None:
        """Note the first arrival: the safety stage repeats commands between those of move_base."""
        if self.measures:
            self._at_wheels.setdefault((message.linear.x, message.angular.z), self._node.time())


@contextlib.asynccontextmanager
async def program(name: str, argv: list[str], env: dict[str, str], ready: str) -> AsyncIterator[list[str]]:
    """Run a program once it has printed a word; yields its pid and the lines until then."""
    child = await Child.start(name, argv, env={"ROS_LOG_DIR": tempfile.gettempdir(), **env})
    lines: list[str] = []
    reader: asyncio.Task[None] | None = None
    try:
        async with asyncio.timeout(READY_S):
            async for line in child.lines():
                lines.append(line)
                if ready in line:
                    break
            else:
                raise RuntimeError(f"{name} ended:\n" + "\n".join(lines[-20:]))
        reader = asyncio.create_task(_drain(child))
        yield [str(child.pid), *lines]
    finally:
        await child.stop()
        if reader is not None:
            await reader


async def _drain(child: Child) -> None:
    async for _ in child.lines():
        pass


async def until(condition: Callable[[], Awaitable[bool]], what: str) -> None:
    """Wait until something is true."""
    late = perf_counter() + READY_S
    while not await condition():
        if perf_counter() > late:
            raise RuntimeError(f"{what}: not within {READY_S:.0f} s")
        await asyncio.sleep(0.1)


def tree(pid: int) -> list[psutil.Process]:
    """A process and all that it started."""
    process = psutil.Process(pid)
    return [process, *process.children(recursive=True)]


def cpu(processes: list[psutil.Process]) -> float:
    """Processor time of processes, seconds; those that ended meanwhile do not count."""
    total = 0.0
    for process in processes:
        with contextlib.suppress(psutil.Error):
            total += sum(process.cpu_times()[:2])
    return total


def listening(processes: list[psutil.Process]) -> set[int]:
    """Return the TCP ports on which processes listen."""
    ports = set()
    for process in processes:
        with contextlib.suppress(psutil.Error):
            found = process.net_connections("tcp")
            ports |= {one.laddr.port for one in found if one.status == psutil.CONN_LISTEN}
    return ports


async def traffic(bridge: int, ports: set[int]) -> tuple[int, int]:
    """Return the bytes that a bridge sent to the engine and got from it, by the kernel's counters.

    Args:
        bridge: Process id of ``rce-ros``.
        ports: On which the engine accepts robots.
    """
    show = await asyncio.create_subprocess_exec("ss", "-tinpHO", stdout=asyncio.subprocess.PIPE)
    output, _ = await show.communicate()
    up = down = 0
    for line in output.decode().splitlines():
        peer = re.search(r":(\d+)\s+users:", line)
        if f"pid={bridge}," in line and peer is not None and int(peer[1]) in ports:
            up += int(_counter(line, "bytes_sent"))
            down += int(_counter(line, "bytes_received"))
    return up, down


def _counter(line: str, name: str) -> str:
    found = re.search(rf"\b{name}:(\d+)", line)
    return found[1] if found else "0"


def scene(folder: Path) -> str:
    """Write the demo's floor with one robot; return the file's name."""
    whole = yaml.safe_load((configs_dir() / "scene.yaml").read_text(encoding="utf-8"))
    whole["robots"] = [one for one in whole["robots"] if one["id"] == ROBOT]
    return written(folder, "scene.yaml", json.dumps(whole))


def written(folder: Path, name: str, text: str) -> str:
    """Write a file; return its name."""
    (folder / name).write_text(text, encoding="utf-8")
    return str(folder / name)


def probe(account: FleetAccount) -> dict[str, Any]:
    """Return the config of a second client, which brings stamped commands to the robot's graph."""
    login = {"url": account.url, "userID": account.user, "password": account.password}
    bridge = {"topic": STAMPED, "type": STAMPED_TYPE, "from": CONTAINER, "to": "robot"}
    return {**login, "robotID": "latencyProbe", "bridges": [bridge]}


async def measure(running: RunningEngine, name: str, *, offloaded: bool, seconds: float) -> dict[str, Any]:
    """Drive a robot for some time with one of the wirings; return the row."""
    account = FleetAccount(url=running.url)
    made = offloaded_config(1, account, initial_pose=START) if offloaded else onboard_config(1, account)
    text = write_items(made)
    ways: dict[str, set[str]] = {"up": set(), "down": set()}
    config = loads(text)
    for wire in wires(config):
        if not wire.is_service and config.robot in (wire.source, wire.target):
            up = wire.source == config.robot
            ways["up" if up else "down"].add(wire.source_name if up else wire.target_name)
    start = [f"initial_pose_{axis}:={value}" for axis, value in zip("xya", START, strict=True)]
    arguments = ["offload:=true"] if offloaded else [f"robot:={ROBOT}", *start]
    rce, bridge = str(BIN / "rce"), str(BIN / "rce-ros")
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rce-bench-")))
        options = ("--no-stand-ins", "--core-port", "0", "--world-port", "0")
        sim = [rce, "sim", scene(folder), *options]
        printed = await stack.enter_async_context(program("sim", sim, {}, "simulation ready"))
        uri = next(line for line in printed if line.startswith(f"robot {ROBOT} ")).partition("URI=")[2]
        env = {"ROS_MASTER_URI": uri}
        launch = [rce, "launch", str(configs_dir() / LAUNCH_FILE), *arguments]
        last = "/pose_keeper: started" if offloaded else "/obstacle_cells: started"
        pids = [int((await stack.enter_async_context(program("launch", launch, env, last)))[0])]
        fleet = written(folder, "fleet.config", write_items(fleet_config(account)))
        station = [rce, "ui", fleet, "--port", "0", "--state-dir", str(folder / "station")]
        printed = await stack.enter_async_context(program("station", station, {}, "rce ui ready: "))
        page = printed[-1].partition("rce ui ready: ")[2].split()[0]
        robot = [bridge, written(folder, "robot.config", text)]
        pids.append(int((await stack.enter_async_context(program("bridge", robot, env, " ready: ")))[0]))
        if offloaded:
            other = [bridge, written(folder, "probe.config", write_items(probe(account)))]
            await stack.enter_async_context(program("probe", other, env, " ready: "))
        node = Node("judge", argv=[], master_uri=uri, signals=False)
        found = Measurement(await stack.enter_async_context(node))
        await found.listen(ways["up"] | ways["down"])
        session = await stack.enter_async_context(aiohttp.ClientSession())
        return await _drive(running, StationClient(session, page), found, pids, seconds, ways) | {
            "wiring": name
        }


async def _drive(
    running: RunningEngine,
    station: StationClient,
    found: Measurement,
    pids: list[int],
    seconds: float,
    ways: dict[str, set[str]],
) -> dict[str, Any]:
    """Send the robot to and fro, and measure while it does."""
    states = {"idle", "arrived"}

    async def stands() -> bool:
        with contextlib.suppress(StationError):
            return any(one.id == ROBOT and one.state in states for one in (await station.fleet()).robots)
        return False

    async def drives() -> bool:
        return found.speed > 0.1

    async def shuttle() -> None:
        for number in range(sys.maxsize):
            await until(stands, "the robot has arrived")
            await station.set_goal(ROBOT, GOALS[number % 2])
            await until(drives, "the robot drives")

    moving = asyncio.create_task(shuttle())
    try:
        await until(drives, "the robot drives")
        robot, cloud = [one for pid in pids for one in tree(pid)], running.processes()
        ports = listening(running.named("rce_robot"))
        await asyncio.sleep(1.0)  # messages that waited meanwhile are late
        began, sent = perf_counter(), await traffic(pids[-1], ports)
        used = cpu(robot), cpu(cloud)
        found.begin()
        done, _ = await asyncio.wait([moving], timeout=seconds)
        found.measures = False
        for task in done:
            task.result()  # it never ends well
        took = perf_counter() - began
        now = await traffic(pids[-1], ports)
        spent = cpu(robot) - used[0], cpu(cloud) - used[1]
    finally:
        moving.cancel()
        await asyncio.wait([moving])
    return _row(found, ways, took, [after - before for after, before in zip(now, sent, strict=True)], spent)


def _row(
    found: Measurement, ways: dict[str, set[str]], took: float, sent: list[int], spent: tuple[float, float]
) -> dict[str, Any]:
    def most(way: str) -> str:
        shares = sorted(((found.bytes[topic] / took, topic) for topic in ways[way]), reverse=True)
        return ", ".join(f"{topic} {rate / 1000:.1f}" for rate, topic in shares[:3] if rate >= 1)

    return {
        "wiring": "",
        "up kB/s": round(sent[0] / took / 1000, 2),
        "down kB/s": round(sent[1] / took / 1000, 2),
        "robot CPU %": round(100 * spent[0] / took, 1),
        "cloud CPU %": round(100 * spent[1] / took, 1),
        "scan to wheels p50 ms": round(1000 * percentile(found.latencies, 0.5), 1),
        "scan to wheels p99 ms": round(1000 * percentile(found.latencies, 0.99), 1),
        "commands": len(found.latencies),
        "up, most, kB/s": most("up"),
        "down, most, kB/s": most("down"),
    }


async def run(running: RunningEngine, *, seconds: float) -> list[dict[str, Any]]:
    """Measure both wirings, one after the other.

    Args:
        running: The engine.
        seconds: How long the robot drives with each.
    """
    return [
        await measure(running, name, offloaded=offloaded, seconds=seconds)
        for name, offloaded in WIRINGS.items()
    ]
