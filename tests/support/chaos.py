"""Chaos: kill -9 of random processes of an engine at random moments of its containers' lives, by a seed.

``python -m support.chaos RUNTIME SEED ROUNDS`` does it for as long as is asked.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rce_container.environment import proc
from support.engine import Engine, running_engine, until
from support.stranger import ROBOT_TAGS, Stranger, ask_for_echo, check_echo, stranger
from tools.leaks import Traces, footprint

CONTAINERS = 3
LONGEST_PAUSE_S = 0.4
SETTLE_S = 60.0
RETURN_S = 120.0
"""More than the longest pause before a container that failed often is created again."""
MASTER_AND_MANAGER = 0.25
"""How often the victim is one of the two programs, and not a process below them."""
DESTROYED = 0.5
"""How often a container that is there is destroyed, and not resized."""
MAKERS = ("bwrap", "unshare", "podman", "conmon")
"""The programs that make namespaces."""
TWICE = 0.25
"""How often another one is killed right after."""
FD_SLACK = 3
MEMORY_SLACK = 24 << 20


@dataclass
class Customer:
    """A robot with a container of its own, which it wants or does not want."""

    container: str
    robot: str
    client: Stranger
    requested: dict[str, Any]
    wants: bool = False
    count: int = 0

    async def create(self) -> None:
        self.wants = True
        await ask_for_echo(
            self.client, self.container, self.robot, self.requested, restart="always", maxRestarts=0
        )

    async def destroy(self) -> None:
        self.wants = False
        await self.client.send("DC", {"containerTag": self.container})

    async def resize(self, megabytes: int) -> None:
        data = {"containerTag": self.container, "containerData": {"memory": megabytes}}
        await self.client.send("RC", data)

    async def echoes(self) -> bool:
        """Whether it is served now."""
        self.count += 1
        try:
            await self.client.wait_status(dict.fromkeys(ROBOT_TAGS, True), timeout=5)
            async with asyncio.timeout(5):
                while not self.client.queue("serviceIn").empty():
                    self.client.queue("serviceIn").get_nowait()
                await check_echo(self.client, f"{self.container} {self.count}")
        except (AssertionError, TimeoutError):
            return False
        return True


@dataclass
class Chaos:
    """Does to an engine, at moments that a seed decides, what users and misfortune do."""

    engine: Engine
    customers: list[Customer]
    dice: random.Random
    traces: Traces
    story: list[str] = field(default_factory=list)

    async def run(self, rounds: int) -> None:
        for _ in range(rounds):
            await self._act()
            await asyncio.sleep(self.dice.uniform(0, LONGEST_PAUSE_S))
            await self._strike()
            if self.dice.random() < TWICE:
                await self._strike()
            await asyncio.sleep(self.dice.uniform(0, LONGEST_PAUSE_S))

    async def _act(self) -> None:
        one = self.dice.choice(self.customers)
        if not one.wants:
            self.story.append(f"create {one.container}")
            await one.create()
        elif self.dice.random() < DESTROYED:
            self.story.append(f"destroy {one.container}")
            await one.destroy()
        else:
            self.story.append(f"resize {one.container}")
            await one.resize(self.dice.randrange(128, 512))

    async def _strike(self) -> None:
        if self.dice.random() < MASTER_AND_MANAGER:
            program = self.dice.choice((self.engine.master, self.engine.container))
            self.story.append(f"kill {program.name}")
            self.traces.look()
            await program.kill()
            await asyncio.sleep(self.dice.uniform(0, LONGEST_PAUSE_S))
            await program.start()
            return
        victims = {name: pids for name, pids in parts(self.traces).items() if pids}
        if victims:
            name = self.dice.choice(sorted(victims))
            victim = self.dice.choice(victims[name])
            self.story.append(f"kill {name} {victim}")
            with contextlib.suppress(ProcessLookupError):
                os.kill(victim, signal.SIGKILL)

    async def kill_all(self) -> None:
        """Kill the master, and the manager with all that it has made, at once."""
        self.story.append("kill all")
        victims = [pid for pids in parts(self.traces).values() for pid in pids]
        programs = (self.engine.master, self.engine.container)
        for pid in (*(program.pid for program in programs), *victims):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for program in programs:
            assert program.process is not None
            await program.process.wait()
        for program in programs:
            await program.start()

    async def settle(self) -> None:
        """Ask for what is wanted, at least one container, as clients do, until it is there."""
        if not any(one.wants for one in self.customers):
            self.customers[0].wants = True
        for one in self.customers:
            if one.wants:
                await until(partial(self._is_served, one), timeout=SETTLE_S, what=one.container)

    async def check_that_all_returns(self) -> None:
        """Kill all once more, and wait for what is wanted, which only the engine remembers."""
        await self.kill_all()
        for one in self.customers:
            if one.wants:
                await until(one.echoes, timeout=RETURN_S, what=f"{one.container} returns")

    async def _is_served(self, one: Customer) -> bool:
        await one.create()
        return await one.echoes()


def parts(traces: Traces) -> dict[str, list[int]]:
    """The processes of containers and the fork server, by what they are."""
    found: dict[str, list[int]] = {}
    for process in traces.look():
        name = _part(process.pid)
        if name:
            found.setdefault(name, []).append(process.pid)
    return found


def _part(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    except OSError:
        return ""
    line = " ".join(words)
    names = {
        "rce-container-shim": "shim",
        "rce_container.forkserver.nodes": "node fork server",
        "rce_container.forkserver": "fork server",
        "rce_container.environment": "environment",
        "stringEcho.py": "node",
        "read -r word": "holder",
    }
    if (program := Path(words[0]).name) in MAKERS:
        return program
    return next((name for needle, name in names.items() if needle in line), "")


@contextlib.asynccontextmanager
async def customers(engine: Engine, *, groups: bool) -> AsyncIterator[list[Customer]]:
    requested = {"network": "group", "group": "crowd"} if groups else {}
    async with contextlib.AsyncExitStack() as stack:
        found = []
        for number in range(CONTAINERS):
            robot = f"robot{number}"
            client = await stack.enter_async_context(stranger(engine.url, robot=robot))
            found.append(
                Customer(f"box{number}_{engine.http_port}", robot, client, requested if number else {})
            )
        yield found


def allowed(engine: Engine) -> set[int]:
    """The processes that may run while there is no container: the programs, and the manager's fork server."""
    fork_servers = {
        one.pid
        for one in proc.table().values()
        if one.parent == engine.container.pid and _part(one.pid) == "fork server"
    }
    return {program.pid for program in engine.programs} | fork_servers


async def run(runtime: str, seed: int, rounds: int, *, groups: bool) -> list[str]:
    """Run an engine through it, and check that it serves what is wanted, and that nothing is left.

    Args:
        runtime: Of its containers.
        seed: Decides what happens when.
        rounds: How many times something is asked for, and something is killed.
        groups: Whether some of the containers are in a group's network.

    Returns:
        What happened.
    """
    async with running_engine(runtime=runtime) as engine, customers(engine, groups=groups) as crowd:
        traces = Traces(engine.folder, str(engine.http_port))
        before = footprint(engine.container.pid)
        chaos = Chaos(engine, crowd, random.Random(seed), traces)
        try:
            await chaos.run(rounds)
            await chaos.kill_all()
            await chaos.settle()
            await chaos.check_that_all_returns()
            for one in crowd:
                await one.destroy()
            await until(lambda: not traces.left(allowed(engine)), timeout=SETTLE_S, what="nothing is left")
            after = footprint(engine.container.pid)
            assert after.fds <= before.fds + FD_SLACK
            assert after.networks == 0
            assert after.memory <= before.memory + MEMORY_SLACK
        except BaseException as error:
            error.add_note(
                "\n".join(["what happened:", *chaos.story, "left:", *traces.left(allowed(engine))])
            )
            for one in crowd:
                error.add_note(f"{one.container}: {one.wants} {one.client.status} {one.client.errors}")
            raise
    return chaos.story


def main() -> None:
    runtime, seed, rounds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    for line in asyncio.run(run(runtime, seed, rounds, groups=runtime != "process")):
        print(line)  # noqa: T201 - for whom it was started by


if __name__ == "__main__":
    main()
