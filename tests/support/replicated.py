"""An engine with several masters as processes, task sets that know all of them, and a robot that calls."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from rce_client import Connection, ServiceClient
from rce_client.exceptions import CallError, NotConnectedError
from support.engine import Program, until
from support.master_program import environment
from support.masters import Masters
from support.ports import free_ports

ECHO = "Test/StringEcho"
TIMEOUT_S = 120.0


class Caller:
    """A robot that calls the echo of its container, one call after the other.

    Attributes:
        answered: Number of calls that were answered.
        failed: Number of calls that failed.
    """

    def __init__(self, client: ServiceClient[Any]) -> None:
        self.client = client
        self.answered = 0
        self.failed = 0
        self._numbers = itertools.count()
        self._task: asyncio.Task[None] | None = None

    @classmethod
    @contextlib.asynccontextmanager
    async def calling(cls, robot: Connection, container: str = "box") -> AsyncIterator[Caller]:
        """Make a container with an echo for a robot, and call it until the block ends."""
        await robot.create_container(container)
        await robot.add_node(container, "echo", "Test", "stringEcho.py")
        await robot.add_interface(
            container, "echo", "ServiceClientInterface", ECHO, addr="/stringEchoService"
        )
        client = await robot.service_client("echo", ECHO)
        await robot.connect(f"{robot.robot_id}/echo", f"{container}/echo")
        await client.wait_active(TIMEOUT_S)
        caller = cls(client)
        task = caller._task = asyncio.create_task(caller._run())
        try:
            yield caller
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    async def _run(self) -> None:
        while True:
            text = f"call {next(self._numbers)}"
            try:
                answer = await self.client({"data": text}, timeout=10.0)
            except (CallError, NotConnectedError):
                self.failed += 1
                await asyncio.sleep(0.05)
            else:
                assert answer["data"] == text
                self.answered += 1

    async def wait_for_answers(self, count: int = 3) -> None:
        """Wait until so many more calls were answered."""
        wanted = self.answered + count

        def enough() -> bool:
            assert self._task is not None
            if self._task.done():
                self._task.result()
            return self.answered >= wanted

        await until(enough, timeout=TIMEOUT_S, what="the robot's calls are answered")


def task_set(folder: Path, of: Masters, program: str, name: str, *options: object) -> Program:
    """Return a task set that knows all masters."""
    where = ",".join(f"127.0.0.1:{master.control_port}" for master in of.all)
    argv = [str(Path(sys.executable).parent / program), where, "--dev", *map(str, options)]
    env = environment(folder) | {"XDG_RUNTIME_DIR": str(folder), "PYTHONUNBUFFERED": "1"}
    return Program(name, argv, env, folder)


@contextlib.asynccontextmanager
async def task_sets(folder: Path, of: Masters, *, robots: int = 2) -> AsyncIterator[list[Program]]:
    """Run robot task sets and a container task set, the last of the list."""
    ports = free_ports(2 * robots + 1)
    made = [
        task_set(
            *(folder, of, "rce-robot", f"robots{number}"),
            *("--ws-port", ports[2 * number], "--link-port", ports[2 * number + 1]),
        )
        for number in range(robots)
    ]
    options = ("--state-dir", folder / "containers", "--runtime", "process", "--link-port", ports[-1])
    made.append(task_set(folder, of, "rce-container", "containers", *options))
    try:
        for program in made:
            await program.start()
        yield made
    finally:
        for program in made:
            if program.running:
                await program.stop()
