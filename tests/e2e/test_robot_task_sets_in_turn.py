"""Robots of a robot task set that is killed, stopped or drained go on at another one, with all they had."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import urllib.request
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from support.engine import Engine, Program, running_engine, until

from rce_client import Connection, ServiceClient

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600)]

ROBOTS = 12
ECHO = "Test/StringEcho"
TIMEOUT_S = 120.0


class Fleet:
    """Robots that each call a service in one container."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.clients: dict[str, ServiceClient[Any]] = {}

    @contextlib.asynccontextmanager
    async def connected(self) -> AsyncIterator[Fleet]:
        async with contextlib.AsyncExitStack() as stack:
            for number in range(ROBOTS):
                name = f"robot{number}"
                robot = Connection(self.engine.url, "testUser", "testUser", name)
                await stack.enter_async_context(robot)
                if not number:
                    await robot.create_container("box")
                    await robot.add_node("box", "echo", "Test", "stringEcho.py")
                await robot.add_interface(
                    "box", name, "ServiceClientInterface", ECHO, addr="/stringEchoService"
                )
                self.clients[name] = await robot.service_client("echo", ECHO)
                await robot.connect(f"{name}/echo", f"box/{name}")
            yield self

    def machines(self) -> dict[str, dict[str, Any]]:
        """Return the connected robot task sets by their URL."""
        found = self.engine.get("/api/v1/machines")["machines"]
        return {one["url"]: one for one in found if one["kind"] == "robot" and one["connected"]}

    async def all_are_at(self, program: Program) -> None:
        """Wait until all robots are at a task set, and each of them gets an answer of its container."""
        url = f"ws://127.0.0.1:{self.engine.robot_ports[self.engine.robots.index(program)][0]}/"

        def arrived() -> bool:
            return self.machines().get(url, {}).get("endpoints") == ROBOTS

        await until(arrived, timeout=TIMEOUT_S, what=f"{ROBOTS} robots are at {program.name}")
        await asyncio.gather(*(self._answer(name, url) for name in self.clients))

    async def _answer(self, name: str, text: str) -> None:
        client = self.clients[name]
        await client.wait_active(TIMEOUT_S)
        async with asyncio.timeout(TIMEOUT_S):
            answer = await client({"data": f"{name} {text}"})
        assert answer["data"] == f"{name} {text}"

    async def calls_until(self, done: Callable[[], bool]) -> list[int]:
        """Let all robots call without a pause until this holds, and a second more.

        No call may fail, and no link end meanwhile.

        Returns:
            How many calls of each robot were answered.
        """
        ended = asyncio.Event()
        counts = [asyncio.create_task(self._call_on(name, ended)) for name in self.clients]
        try:
            await until(done, timeout=TIMEOUT_S, what="the time to end the calls")
            await asyncio.sleep(1.0)
        finally:
            ended.set()
            answered = await asyncio.gather(*counts)
        return answered

    async def _call_on(self, name: str, ended: asyncio.Event) -> int:
        client, count = self.clients[name], 0
        while not ended.is_set():
            answer = await client({"data": f"{name} {count}"}, timeout=TIMEOUT_S)
            assert answer["data"] == f"{name} {count}"
            count += 1
        return count

    def set_draining(self, name: str, *, draining: bool) -> list[dict[str, Any]]:
        request = urllib.request.Request(
            f"{self.engine.url}api/v1/machines/{name}/drain",
            headers={"Authorization": f"Bearer {self.engine.token()}"},
            method="PUT" if draining else "DELETE",
        )
        with urllib.request.urlopen(request, timeout=30) as reply:
            found: list[dict[str, Any]] = json.loads(reply.read())["machines"]
        return found


async def test_robots_find_another_task_set() -> None:
    async with running_engine(robots=2) as engine:
        first, second = engine.robots
        await second.stop()
        async with Fleet(engine).connected() as fleet:
            await fleet.all_are_at(first)
            await second.start()
            await first.kill()
            await fleet.all_are_at(second)
            await first.start()
            await second.stop()
            await fleet.all_are_at(first)
            await second.start()
            (one, other) = engine.robot_ports
            former = fleet.machines()[f"ws://127.0.0.1:{one[0]}/"]["process"]
            (shown,) = fleet.set_draining(former, draining=True)
            assert shown["draining"]
            await fleet.all_are_at(second)
            assert fleet.machines()[f"ws://127.0.0.1:{one[0]}/"]["endpoints"] == 0
            # The one that is drained takes no robots, even when the other one drains too.
            latter = fleet.machines()[f"ws://127.0.0.1:{other[0]}/"]["process"]
            fleet.set_draining(latter, draining=True)
            await fleet.all_are_at(second)
            assert not engine.accepts_robots()
            fleet.set_draining(former, draining=False)
            await fleet.all_are_at(first)


async def test_robots_leave_a_task_set_that_hangs() -> None:
    """It closes no connection, and its machine takes what they send; when it wakes, it gets no robot back."""
    async with running_engine(robots=2) as engine:
        first, second = engine.robots
        await second.stop()
        async with Fleet(engine).connected() as fleet:
            await fleet.all_are_at(first)
            await second.start()
            assert first.process is not None
            first.process.send_signal(signal.SIGSTOP)
            try:
                await fleet.all_are_at(second)
            finally:
                first.process.send_signal(signal.SIGCONT)
            url = f"ws://127.0.0.1:{engine.robot_ports[0][0]}/"
            # It finds its links to the container closed before it hears from the master that it was left.
            answered = await fleet.calls_until(lambda: url in fleet.machines())
            assert min(answered) > 0
            await fleet.all_are_at(second)
            assert fleet.machines()[url]["endpoints"] == 0
