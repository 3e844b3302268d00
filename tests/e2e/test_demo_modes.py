"""``rce demo --mode``: the same fleet goes to the same goals, whatever carries its messages."""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import aiohttp
import psutil
import pytest
from support.demo import Demo, kill_program, run_headless, running_demo
from support.engine import engine_processes, until
from support.ports import free_port

from rce.ros.xmlrpc import RpcClient
from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.exceptions import StationError
from rce_fleet.station.client import StationClient

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.real_time("robots"),
    pytest.mark.needs("pymunk"),
    pytest.mark.timeout(1000),
]

ROBOTS, SEED = 1, 21
"""Its way is short."""
TIMEOUT_S = 400.0
WAIT_S = 120.0


def check(code: int, report: dict[str, Any], text: str, mode: str) -> None:
    """The fleet of the seed is at the goals of the seed."""
    assert code == 0, text
    scenario = choose_scenario(ROBOTS, SEED)
    assert report["mode"] == mode
    assert [
        (robot["id"], robot["start_cell"], robot["goal_cell"], robot["reached"]) for robot in report["robots"]
    ] == [
        (robot, start, goal, True)
        for robot, start, goal in zip(scenario.robots, scenario.starts, scenario.goals, strict=True)
    ]
    assert report["collisions"] == 0
    assert all(0 < robot["localization_rmse_m"] < 0.25 for robot in report["robots"])
    assert report["engine"]["messages"] > 0
    assert report["engine"]["dropped"] is None


async def test_masters_of_their_own_drive_the_same_fleet_to_the_same_goals() -> None:
    """Without a choice, machines are namespaces for root, else ports. The cloud is in test_demo_headless."""
    options = ("--mode", "multi", "--robots", ROBOTS, "--seed", SEED)
    check(*await run_headless(*options, timeout=TIMEOUT_S), mode="multi")


@pytest.mark.needs("roslaunch")
async def test_single_with_a_real_roscore() -> None:
    options = ("--mode", "single", "--core", "roscore", "--robots", ROBOTS, "--seed", SEED)
    check(*await run_headless(*options, timeout=TIMEOUT_S), mode="single")


async def test_one_core_carries_all_and_a_killed_planner_comes_back() -> None:
    """It does until the demo itself is killed, which leaves no program."""
    options = ("--mode", "single", "--robots", 2, "--core-port", free_port(), "--no-auto")
    async with running_demo(*options) as demo, aiohttp.ClientSession() as session:
        station = StationClient(session, demo.page)
        await until(lambda: _is(_state(station), "idle"), timeout=WAIT_S, what="the robot is in its place")
        news: dict[str, dict[str, Any]] = {}
        async with session.ws_connect(f"{demo.page}api/v1/live") as live, asyncio.timeout(WAIT_S):
            while not {"engine", "state", "map", "poses"} <= news.keys():
                message = await live.receive_json()
                news[message["type"]] = message
        names = {node["name"] for node in news["engine"]["graph"]["nodes"]}
        assert {"/fleet_planner", "/Robot1/robot", "/Robot1/move_client", "/world"} <= names
        assert news["state"]["robots"][0]["state"] == "idle"
        await _check_restart(demo, station, "fleet_planner.py")
        await check_killed_demo(demo, set())


async def test_machines_share_only_the_synced_topics() -> None:
    """A killed move client comes back, until the demo itself is killed, which leaves nothing of it."""
    before = set(psutil.net_if_addrs())
    async with (
        running_demo("--mode", "multi", "--robots", 2, "--no-auto") as demo,
        RpcClient() as rpc,
        aiohttp.ClientSession() as session,
    ):
        cables = {name for name in set(psutil.net_if_addrs()) - before if name.startswith("rce")}
        (log,) = demo.folder.glob("rce-demo-*/world.log")
        cores = dict(re.findall(r"robot (Robot\d) ROS_MASTER_URI=(\S+)", log.read_text()))
        (planner_log,) = log.parent.glob("core-planner.log")
        (cores["planner"],) = re.findall(r"ROS_MASTER_URI=(\S+)", planner_log.read_text())

        async def published(machine: str) -> set[str]:
            state = await rpc.call(cores[machine], "getSystemState", ("/test",), timeout=5)
            return {topic for topic, _ in state[2][0]}

        async def foreign(machine: str) -> set[str]:
            """What is published at a machine by nodes of others."""
            own = {"planner": "/fleet_planner", "Robot1": "/Robot1/", "Robot2": "/Robot2/"}
            state = await rpc.call(cores[machine], "getSystemState", ("/test",), timeout=5)
            others = [name for node, name in own.items() if node != machine]
            return {
                topic for topic, nodes in state[2][0] if any(n.startswith(o) for n in nodes for o in others)
            }

        heard = {f"/Robot{n}/{name}" for n in (1, 2) for name in ("amcl_pose", "goalNodesList")}
        await until(lambda: _holds(published("planner"), heard), timeout=WAIT_S, what="the planner hears all")
        lists = {f"/Robot{n}/goalNodesList" for n in (1, 2)}
        robots, grid = ("Robot1", "Robot2"), {"/fleet/map", "/fleet/state"}
        shared = {
            "planner": lists,
            **{name: {f"/{name}/goalNodesList", f"/{name}/cancelGoal", *grid} for name in robots},
        }
        for robot in robots:
            at_robot = {*shared[robot], "/odom"}
            await until(
                partial(_meets, published, robot, at_robot), timeout=WAIT_S, what=f"{robot} hears the planner"
            )
        station = StationClient(session, demo.page)
        await until(lambda: _is(_state(station), "idle"), timeout=WAIT_S, what="lists are answered")
        for machine, topics in shared.items():
            assert await foreign(machine) == topics
        await _check_restart(demo, station, "move_client.py", "__ns:=Robot1")
        await check_killed_demo(demo, cables)


async def _check_restart(demo: Demo, station: StationClient, *words: str) -> None:
    """Kill a program, which its command line names, while a robot drives to a cell near it."""
    fleet = await station.fleet()
    assert fleet.map is not None
    taken = {robot.cell for robot in fleet.robots} | set(fleet.blocked)
    columns, here = fleet.map.columns, fleet.robots[0].cell
    assert here is not None

    def distance(cell: int) -> int:
        return abs(cell // columns - here // columns) + abs(cell % columns - here % columns)

    free = [cell for cell in range(fleet.map.rows * columns) if cell not in taken]
    cell = sorted(free, key=distance)[1]
    await _send(station, "Robot1", cell)
    kill_program(demo.process.pid, *words)
    await until(partial(_arrives, station, "Robot1", cell), timeout=180, what=f"Robot1 is at cell {cell}")
    assert demo.output().count("restarting it") == 1


async def _send(station: StationClient, robot: str, cell: int) -> None:
    """Send a robot to a cell, as soon as the planner can be asked."""
    async with asyncio.timeout(WAIT_S):
        while True:
            try:
                await station.set_goal(robot, cell)
            except StationError:
                await asyncio.sleep(0.2)
            else:
                return


async def _arrives(station: StationClient, robot: str, cell: int) -> bool:
    with contextlib.suppress(StationError):
        return any(
            (one.id, one.cell, one.goal, one.state) == (robot, cell, cell, "arrived")
            for one in (await station.fleet()).robots
        )
    return False


async def _state(station: StationClient) -> str:
    with contextlib.suppress(StationError):
        fleet = await station.fleet()
        return fleet.robots[0].state if fleet.robots else ""
    return ""


async def check_killed_demo(demo: Demo, cables: set[str]) -> None:
    """Kill a demo: it leaves no process, and none of the network interfaces that came with it."""
    assert len(psutil.Process(demo.process.pid).children(recursive=True)) >= 6
    demo.process.kill()
    await demo.process.wait()
    await until(lambda: not engine_processes(demo.folder), timeout=WAIT_S, what="all programs ended")
    # Tests beside this one may have made some of them; those go with their own.
    await until(lambda: not cables & set(psutil.net_if_addrs()), timeout=WAIT_S, what="cables are gone")
    for folder in demo.folder.glob("rce-demo-*"):
        shutil.rmtree(folder)  # who is killed cannot


async def _meets(read: Callable[[str], Awaitable[set[str]]], machine: str, wanted: set[str]) -> bool:
    return wanted <= await read(machine)


async def _holds(topics: Awaitable[set[str]], wanted: set[str]) -> bool:
    return wanted <= await topics


async def _is(state: Awaitable[str], wanted: str) -> bool:
    return bool(await state == wanted)
