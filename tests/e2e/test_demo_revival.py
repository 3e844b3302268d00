"""Programs of the demo that are killed are started again where that helps; else they end it with a text."""

from __future__ import annotations

import asyncio
import contextlib

import aiohttp
import pytest
from support.demo import kill_program, running_demo
from support.engine import until

from rce_fleet.exceptions import StationError
from rce_fleet.station.client import StationClient

pytestmark = [pytest.mark.e2e, pytest.mark.real_time("machines")]


async def reaches(station: StationClient, robot: str, cell: int) -> None:
    """Send a robot to a cell, again until the planner knows of it, and wait until it stands there."""
    seen: dict[str, object] = {}
    try:
        async with asyncio.timeout(240):
            while True:
                try:
                    for one in (await station.fleet()).robots:
                        seen[one.id] = one
                        if one.id == robot and one.goal != cell:
                            await station.set_goal(robot, cell)
                        if one.id == robot and one.cell == cell and one.state == "arrived":
                            return
                except StationError as error:
                    seen["refusal"] = error
                await asyncio.sleep(0.5)
    except TimeoutError:
        raise AssertionError(f"{robot} does not reach cell {cell}: {seen}") from None


async def knows_robots(station: StationClient, count: int) -> bool:
    with contextlib.suppress(StationError):
        robots = (await station.fleet()).robots
        return len([robot for robot in robots if robot.cell is not None]) == count
    return False


async def test_killed_parts_return_killed_world_is_named() -> None:
    async with (
        running_demo("--robots", 2, "--full-stack", 1, "--no-auto") as demo,
        aiohttp.ClientSession() as session,
    ):
        station = StationClient(session, demo.page)
        await until(lambda: knows_robots(station, 2), timeout=90, what="the planner knows the robots")
        fleet = await station.fleet()
        robot = fleet.robots[0]
        assert fleet.map is not None
        taken = {one.cell for one in fleet.robots} | set(fleet.blocked)
        columns, here = fleet.map.columns, robot.cell
        assert here is not None

        def distance(cell: int) -> int:
            return abs(cell // columns - here // columns) + abs(cell % columns - here % columns)

        near = min(set(range(fleet.map.rows * columns)) - taken, key=lambda cell: (distance(cell), cell))
        kill_program(demo.process.pid, "rce_client.ros_bridge", f"{robot.id.lower()}.config")
        kill_program(demo.process.pid, "rce_fleet.station")
        kill_program(demo.process.pid, "rce.ros.launching.cli", f"robot:={robot.id}")
        await until(
            lambda: demo.output().count("was ended by SIGKILL; restarting it") == 3,
            timeout=60,
            what="the demo tells what it starts again",
        )
        await reaches(station, robot.id, near)
        kill_program(demo.process.pid, "rce_fleet.drivers")
        assert await asyncio.wait_for(demo.process.wait(), 60) == 1
        assert "rce demo: world was ended by SIGKILL" in demo.output()
