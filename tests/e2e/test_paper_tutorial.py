"""The blocks of the tutorial "the paper in six terminals", run as printed on a machine of its own."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from support.engine import until
from support.networks import NetworkMachine, network
from support.processes import finish

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.needs("netns"),
    pytest.mark.needs("pymunk"),
    pytest.mark.needs("curl"),
]

HOME = Path(__file__).parents[2]
TUTORIAL = HOME / "docs" / "tutorials" / "paper.md"
FIRST = re.compile(r"^Run this first, in each of six terminals:\n\n```\n(.*?)```", re.DOTALL | re.MULTILINE)
BLOCK = re.compile(r"<!-- (?:(\w+): )?(\w+)((?:, \w+: [^,]+?)*) -->\n```\n(.*?)```", re.DOTALL)
GOALS = {"Robot1": 1, "Robot2": 15, "Robot3": 57}
START_S = 150.0
DRIVE_S = 200.0
LOOK_S = 60.0
FLEET = "curl -s --max-time 10 http://127.0.0.1:9080/api/v1/fleet"


@dataclass(frozen=True)
class Block:
    """A block of commands.

    Attributes:
        system: The system that it is for; empty: for all.
        name: Of the terminal; ``look`` for commands that end by themselves.
        facts: What it is expected to print: ``ready``, ``shows``, ``hides``.
        text: The commands; the tutorial's first ones come before them, as in each terminal.
    """

    system: str
    name: str
    facts: dict[str, str]
    text: str


def read_blocks() -> list[Block]:
    """Read the tutorial's blocks, each with the first one before it."""
    tutorial = TUTORIAL.read_text()
    (first,) = FIRST.findall(tutorial)
    found = []
    for system, name, facts, text in BLOCK.findall(tutorial):
        pairs = (fact.split(": ", 1) for fact in facts.split(", ") if fact)
        found.append(Block(system, name, dict(pairs), first + text))
    return found


class Terminals:
    """The terminals of one machine.

    Args:
        machine: The machine.
        home: Home of the person who types.
    """

    def __init__(self, machine: NetworkMachine, home: Path) -> None:
        self._machine = machine
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("ROS", "XDG"))}
        folders = os.environ["PATH"].split(os.pathsep)
        self._env = kept | {
            "HOME": str(home),
            "XDG_RUNTIME_DIR": str(home),
            # The tutorial's first block has to find the programs; what it installs is here already.
            "PATH": os.pathsep.join(one for one in folders if Path(one) != Path(sys.executable).parent),
            "MAKEFLAGS": "n",
            "PYTHONUNBUFFERED": "1",
        }

    @asynccontextmanager
    async def running(self, block: Block) -> AsyncIterator[None]:
        """Type a block; go on when it is ready; end it with Ctrl-C."""
        process = await self._start(block.text)
        lines: list[bytes] = []
        ready = asyncio.Event()
        wanted = block.facts.get("ready", "").encode()

        async def read() -> None:
            assert process.stdout is not None
            async for line in process.stdout:
                lines.append(line)
                if wanted in line:
                    ready.set()

        async with asyncio.TaskGroup() as tasks:
            reading = tasks.create_task(read())
            try:
                if wanted:
                    waiting = tasks.create_task(ready.wait())
                    ends = (waiting, reading)
                    await asyncio.wait(ends, timeout=START_S, return_when=asyncio.FIRST_COMPLETED)
                    waiting.cancel()
                    assert ready.is_set(), f"{block.name} is not ready"
                yield
            finally:
                os.killpg(process.pid, signal.SIGINT)
                try:
                    async with asyncio.timeout(LOOK_S):
                        await process.wait()
                finally:
                    await finish(process) if process.returncode is None else None
                    print(f"--- {block.name}", *(line.decode() for line in lines), sep="")  # noqa: T201

    async def run(self, text: str) -> str:
        """Type commands that end by themselves; return what they print."""
        process = await self._start(text)
        try:
            async with asyncio.timeout(LOOK_S):
                output, _ = await process.communicate()
        finally:
            if process.returncode is None:
                await finish(process)
        assert process.returncode == 0, output.decode()
        return output.decode()

    async def states(self) -> dict[str, tuple[str, Any]]:
        """Return each robot's state and cell, as the page shows them."""
        try:
            robots = json.loads(await self.run(FLEET))["robots"]
        except (AssertionError, ValueError, KeyError):
            return {}
        return {robot["id"]: (robot["state"], robot["cell"]) for robot in robots}

    async def _start(self, text: str) -> asyncio.subprocess.Process:
        return await asyncio.create_subprocess_exec(
            *(*self._machine.prefix, "bash", "-ec", text),
            cwd=HOME,
            env=self._env,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
        )


@pytest.fixture
def terminals() -> Iterator[Terminals]:
    home = Path(tempfile.mkdtemp(dir="/tmp"))  # sockets' paths are limited to 107 bytes
    try:
        with network(1) as (machine,):
            yield Terminals(machine, home)
    finally:
        shutil.rmtree(home)


def test_six_terminals_are_enough() -> None:
    for system in ("single", "multi", "cloud"):
        names = [block.name for block in read_blocks() if block.system == system and block.name != "look"]
        assert len(names) == len(set(names))
        assert {"planner", "world", "robot1", "robot2", "robot3"} <= set(names)
        assert len(names) <= 6


@pytest.mark.parametrize("system", ["single", "multi", "cloud"])
async def test_the_terminals_of_a_system(terminals: Terminals, system: str) -> None:
    """All robots drive to goals, and each system shows what the tutorial says."""
    blocks = [block for block in read_blocks() if block.system in ("", system)]

    async def have_come(state: str, cells: dict[str, int] | None = None) -> bool:
        found = await terminals.states()
        said = all(found.get(robot, ("", 0))[0] == state for robot in GOALS)
        return said and (cells is None or {robot: cell for robot, (_, cell) in found.items()} == cells)

    async with AsyncExitStack() as stack:
        for block in blocks:
            if block.name != "look":
                await stack.enter_async_context(terminals.running(block))
        await until(lambda: have_come("idle"), timeout=START_S, what="all robots are idle")
        for block in blocks:
            if block.name == "look":
                shown = await terminals.run(block.text)
                assert all(word in shown for word in block.facts.get("shows", "").split()), shown
                assert not any(word in shown for word in block.facts.get("hides", "").split()), shown
        await until(
            lambda: have_come("arrived", GOALS), timeout=DRIVE_S, what="all robots are at their goals"
        )
