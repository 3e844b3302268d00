"""The shipped files of a fleet drive it: a container per robot, and the paper's wiring."""

from __future__ import annotations

from contextlib import AsyncExitStack
from pathlib import Path

import aiohttp
import pytest
from support.by_hand import CONFIGS, page_of, simulated, started, wait_state
from support.engine import Engine, Program, running_engine
from support.ports import free_port

from rce_fleet.station.client import StationClient

pytestmark = [pytest.mark.e2e, pytest.mark.needs("pymunk")]

GOALS = {"Robot1": 1, "Robot2": 15, "Robot3": 57}
"""Neighbours of the cells that the robots start in."""


def placed(engine: Engine, folder: Path, name: str) -> str:
    """A shipped file for this engine."""
    file = folder / Path(name).name
    file.write_text((CONFIGS / name).read_text().replace("http://localhost:9000/", engine.url))
    return str(file)


async def join(stack: AsyncExitStack, engine: Engine, folder: Path, robots: dict[str, str]) -> None:
    """Start the bridges of all robots; they wait for each other's parts."""
    for number, uri in enumerate(robots.values(), start=1):
        config = str(folder / f"robot{number}.config")
        bridge = started(engine, uri, " ready: ", f"bridge{number}", "rce-ros", config)
        await stack.enter_async_context(bridge)


def containers(engine: Engine) -> list[str]:
    return sorted(each["tag"] for each in engine.get("/api/v1/containers")["containers"])


async def drive(station: Program) -> None:
    """Send each robot to a goal, and wait until it is there."""
    async with aiohttp.ClientSession() as session:
        client = StationClient(session, page_of(station))
        await wait_state(client, "idle", *GOALS)
        for robot, cell in GOALS.items():
            await client.set_goal(robot, cell)
        await wait_state(client, "arrived", *GOALS)
        assert {robot.id: robot.cell for robot in (await client.fleet()).robots} == GOALS


async def test_a_container_for_each_robot(tmp_path: Path) -> None:
    async with running_engine() as engine, simulated(engine) as robots, AsyncExitStack() as stack:
        for number in range(1, 4):
            placed(engine, tmp_path, f"robot{number}.config")
        fleet = placed(engine, tmp_path, "fleet.config")
        ui = started(engine, "", "rce ui ready: ", "station", "rce", "ui", fleet, "--port", "0")
        station = await stack.enter_async_context(ui)
        await join(stack, engine, tmp_path, robots)
        assert containers(engine) == ["cTag_01", "cTag_02", "cTag_03", "cTag_fleet"]
        await drive(station)


async def test_one_container_and_a_planner_with_its_own_connection(tmp_path: Path) -> None:
    """The paper's wiring; the container of all move clients is the planner's."""
    planner_uri = f"http://127.0.0.1:{free_port()}/"
    async with running_engine() as engine, simulated(engine) as robots, AsyncExitStack() as stack:
        for number in range(1, 4):
            placed(engine, tmp_path, f"paper/robot{number}.config")
        launch = ("rce", "launch", str(CONFIGS / "paper" / "planner.launch"))
        config = placed(engine, tmp_path, "paper/planner.config")
        for name, ready, *words in (
            ("planner", "/fleet_planner: started", *launch),
            ("bridge-planner", " ready: ", "rce-ros", config),
            ("station", "rce ui ready: ", "rce", "ui", "--ros-master", planner_uri, "--port", "0"),
        ):
            station = await stack.enter_async_context(started(engine, planner_uri, ready, name, *words))
        await join(stack, engine, tmp_path, robots)
        assert containers(engine) == ["cTag_01"]
        assert len(engine.processes_of("move_client_pthread")) >= len(GOALS)
        await drive(station)
