"""A container is moved while its robot calls it and publishes: nothing is lost, and nothing comes twice."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import urllib.error
import urllib.request
from collections import Counter
from pathlib import Path

import pytest
from support.engine import Engine, Program, running_engine, until
from support.ports import free_port

from rce_client import Connection
from rce_client.exceptions import CallError, NotConnectedError

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600)]

UPGRADE = Path(__file__).parents[2] / "docs/how-to/upgrade.md"
WAIT_S = 120.0
PERIOD_S = 0.02
INTERFACES = {
    "call": ("ServiceClientInterface", "Test/StringEcho", "/stringEchoService"),
    "say": ("PublisherInterface", "std_msgs/String", "/stringEchoReq"),
    "hear": ("SubscriberInterface", "std_msgs/String", "/stringEchoResp"),
}


def request(engine: Engine, method: str, path: str, body: object = None) -> None:
    made = urllib.request.Request(
        f"{engine.url}api/v1{path}",
        data=json.dumps(body).encode(),
        headers={"Authorization": f"Bearer {engine.token()}", "Content-Type": "application/json"},
        method=method,
    )
    with urllib.request.urlopen(made, timeout=60):
        pass


def machines(engine: Engine) -> set[str]:
    found = engine.get("/api/v1/machines")["machines"]
    return {machine["machine"] for machine in found if machine["kind"] == "container"}


def place(engine: Engine) -> tuple[str, str]:
    (box,) = engine.get("/api/v1/containers")["containers"]
    return box["machine"], box["moving_to"]


def moves(engine: Engine, machine: str) -> bool:
    """Have the container moved; false while it still ends at that machine."""
    try:
        request(engine, "PUT", "/containers/box/machine", {"machine": machine})
    except urllib.error.HTTPError as error:
        if "still ending" not in (text := error.read().decode()):
            raise AssertionError(text) from error
        return False
    return True


class Traffic:
    """A robot that calls its container and publishes to it, 50 times a second each."""

    def __init__(self, robot: Connection) -> None:
        self.robot = robot
        self.calls = 0
        self.answered = 0
        self.failed: list[str] = []
        self.sent = 0
        self.refused = 0
        self.heard: list[int] = []
        self._talking = True

    async def make(self) -> None:
        await self.robot.create_container("box")
        await self.robot.add_node("box", "echo", "Test", "stringEcho.py")
        for tag, (kind, message_type, address) in INTERFACES.items():
            await self.robot.add_interface("box", tag, kind, message_type, addr=address)
        self._call = await self.robot.service_client("call", "Test/StringEcho")
        self._say = await self.robot.publisher("say", "std_msgs/String")
        self._hear = await self.robot.subscriber("hear", "std_msgs/String")
        for tag in INTERFACES:
            await self.robot.connect(f"robot/{tag}", f"box/{tag}")
        for interface in (self._call, self._say, self._hear):
            await interface.wait_active(WAIT_S)

    async def run(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._publish())
            listener = tasks.create_task(self._listen())
            while self._talking:
                self.calls += 1
                tasks.create_task(self._ask(self.calls))
                await asyncio.sleep(PERIOD_S)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(30.0):
                    while len(set(self.heard)) < self.sent or self.answered + len(self.failed) < self.calls:
                        await asyncio.sleep(PERIOD_S)
            listener.cancel()

    def end(self) -> None:
        self._talking = False

    async def flows(self) -> None:
        answered, heard = self.answered + 50, len(self.heard) + 50
        await until(lambda: self.answered >= answered and len(self.heard) >= heard, timeout=WAIT_S)

    async def _ask(self, number: int) -> None:
        try:
            answer = await self._call({"data": str(number)}, timeout=30.0)
            assert answer["data"] == str(number)
            self.answered += 1
        except (CallError, NotConnectedError) as error:
            self.failed.append(f"{number}: {error}")

    async def _publish(self) -> None:
        while self._talking:
            if self._say.publish({"data": str(self.sent)}):
                self.sent += 1
            else:
                self.refused += 1
            await asyncio.sleep(PERIOD_S)

    async def _listen(self) -> None:
        async for message in self._hear:
            self.heard.append(int(message["data"]))

    def check(self) -> None:
        times = Counter(self.heard)
        lost = sorted(set(range(self.sent)) - set(times))
        twice = sorted(number for number, count in times.items() if count > 1)
        assert (self.failed, lost, twice, self.refused) == ([], [], [], 0), (
            f"of {self.calls} calls and {self.sent} messages"
        )


async def change_place(engine: Engine, traffic: Traffic, how: str) -> None:
    """Have the container at the other machine, while the robot talks to it."""
    here, _ = place(engine)
    (there,) = machines(engine) - {here}
    if how == "drain":
        request(engine, "PUT", f"/machines/{here}/drain")
    else:
        await until(lambda: moves(engine, there), timeout=WAIT_S, what="the move begins")
    await until(lambda: place(engine) == (there, ""), timeout=WAIT_S, what=how)
    await traffic.flows()
    if how == "drain":
        request(engine, "DELETE", f"/machines/{here}/drain")


def names(engine: Engine, machine: str) -> dict[str, int]:
    """The container task sets of a machine, with the number of their containers."""
    found = engine.get("/api/v1/machines")["machines"]
    return {
        one["process"]: one["endpoints"]
        for one in found
        if (one["kind"], one["machine"]) == ("container", machine)
    }


def beside(engine: Engine, old: Program) -> Program:
    """Return the task set that the how-to starts beside an old one on the same machine."""
    (options,) = re.findall(r"^rce-container MASTER (.*?) +#", UPGRADE.read_text(), re.MULTILINE)
    words = options.replace("/var/lib/rce", str(engine.folder)).replace("10032", str(free_port())).split()
    assert {"--state-dir", "--link-port", "--first-uid"} <= set(words)
    return Program(f"{old.name}-new", [*old.argv, *words], engine.env, engine.folder)


async def replace_task_set(engine: Engine, traffic: Traffic) -> None:
    """Move the container to a new task set of its machine, and end the old one, as the how-to says."""
    here, _ = place(engine)
    (there,) = machines(engine) - {here}
    request(engine, "PUT", f"/machines/{there}/drain")  # so that the new one is the only place
    ((old_name, _),) = names(engine, here).items()
    (old,) = (one for one in engine.machines if one.name == here)
    new = beside(engine, old)
    engine.machines.append(new)
    await new.start()
    await until(lambda: len(names(engine, here)) == 2, timeout=WAIT_S, what="both are there")
    (new_name,) = names(engine, here).keys() - {old_name}
    request(engine, "PUT", f"/machines/{old_name}/drain")
    moved = {old_name: 0, new_name: 1}
    await until(lambda: names(engine, here) == moved, timeout=WAIT_S, what="the container is at the new one")
    await traffic.flows()
    assert await old.stop() == 0
    await traffic.flows()


async def test_moves_and_drains_lose_no_call_and_no_message() -> None:
    """The container is moved twice, its machines are drained, and its task set makes way for a new one."""
    async with (
        running_engine(machines=2) as engine,
        Connection(engine.url, "testUser", "testUser", "robot") as robot,
    ):
        traffic = Traffic(robot)
        await traffic.make()
        await until(lambda: len(machines(engine)) == 2, timeout=WAIT_S)
        running = asyncio.create_task(traffic.run())
        try:
            for how in ("move", "move", "drain", "drain"):
                await traffic.flows()
                await change_place(engine, traffic, how)
            await replace_task_set(engine, traffic)
            traffic.end()
            await running
        finally:
            running.cancel()
        traffic.check()


@pytest.mark.parametrize("victim", ["master", "target"])
async def test_fault_in_the_middle_of_a_move_loses_nothing(victim: str) -> None:
    """The master, or the task set of the machine that it moves to, is killed while the container moves."""
    async with (
        running_engine(machines=2) as engine,
        Connection(engine.url, "testUser", "testUser", "robot") as robot,
    ):
        traffic = Traffic(robot)
        await traffic.make()
        await until(lambda: len(machines(engine)) == 2, timeout=WAIT_S)
        running = asyncio.create_task(traffic.run())
        try:
            await traffic.flows()
            here, _ = place(engine)
            (there,) = machines(engine) - {here}
            (target,) = (one for one in engine.machines if one.name == there)
            await until(lambda: moves(engine, there), timeout=WAIT_S, what="the move begins")
            program = engine.master if victim == "master" else target
            await program.kill()
            await traffic.flows()
            await program.start()
            await until(lambda: len(machines(engine)) == 2, timeout=WAIT_S)
            await traffic.flows()
            traffic.end()
            await running
        finally:
            running.cancel()
        traffic.check()
