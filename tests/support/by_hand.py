"""A fleet by hand: programs beside an engine, each as a person starts it in a terminal."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from rce_fleet.exceptions import StationError
from rce_fleet.station.client import StationClient
from support.engine import Engine, Program, until

BIN = Path(sys.executable).parent
CONFIGS = Path(__file__).parents[2] / "configs"
WAIT_S = 150.0


@asynccontextmanager
async def started(engine: Engine, uri: str, ready: str, name: str, *words: str) -> AsyncIterator[Program]:
    """Run a program until the end of the block.

    Args:
        engine: Where it puts its files.
        uri: Its ROS master.
        ready: What it prints when it is ready.
        name: Of its log.
        words: The command line; the first word is a program of this project.
    """
    homes = {"ROS_HOME": "ros", "ROS_LOG_DIR": "log", "XDG_STATE_HOME": "home"}
    env = {**engine.env, "ROS_MASTER_URI": uri}
    env |= {name: str(engine.folder / folder) for name, folder in homes.items()}
    program = Program(name, [str(BIN / words[0]), *words[1:]], env, engine.folder)
    await program.start(ready=ready)
    try:
        yield program
    finally:
        if program.running:
            await program.stop()
        print(program.output())  # noqa: T201 - shown if the test fails


@asynccontextmanager
async def simulated(engine: Engine, *options: str) -> AsyncIterator[dict[str, str]]:
    """Run the fleet's floor; gives each robot's master."""
    words = ("rce", "sim", str(CONFIGS / "scene.yaml"), "--core-port", "0", "--world-port", "0", *options)
    async with started(engine, "", "simulation ready", "sim", *words) as sim:
        lines = [line.split() for line in sim.output().splitlines() if line.startswith("robot ")]
        yield {robot: uri.partition("=")[2] for _, robot, uri in lines}


async def wait_state(station: StationClient, state: str, *robots: str) -> None:
    """Wait until robots are in a state of the planner's."""

    async def has_it() -> bool:
        try:
            found = {robot.id: robot.state for robot in (await station.fleet()).robots}
        except StationError:
            return False
        return all(found.get(robot) == state for robot in robots)

    await until(has_it, timeout=WAIT_S, what=f"{', '.join(robots)}: {state}")


def page_of(station: Program) -> str:
    """Return the address that a station printed."""
    return station.output().partition("rce ui ready: ")[2].split()[0]
