"""Task sets: real ones with a robot and its container, and one that writes down what masters tell it."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import aiohttp
from support.engine import Program, command_line, engine_processes, until
from support.stranger import Stranger, stranger, wire_echo
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from faults.history import Heard, History
from faults.machines import CONTROL_PORT, PATIENCE_S, SECRET, Cluster, Machine
from rce.control import decode_to_task_set, encode
from rce.control.messages import (
    CONTROL_VERSION,
    ClientReply,
    ClientRequest,
    Hello,
    MachineInfo,
    TaskSetKind,
    Welcome,
)
from tools.leaks import sweep_cgroups

PING_S = 0.1
DIAL_S = 0.3
"""Pause between two attempts to reach a master as a task set, and the time that it has for its answer."""
ASK_S = 0.3
"""Pause between two requests of a prober on a connection."""
ANSWER = ClientReply.__name__
"""What a prober hears from a master that leads, after each request."""
LOOK_S = 1.0
"""Pause between two looks at the containers."""


class Prober:
    """Says Hello to each master again and again, and believes all: so it hears all that act as leaders.

    A connection is kept until the master ends it: a master that was stopped has it when it wakes. It asks for
    something all the time, so that a master that leads no more, and does not know it, has reasons to act.
    """

    def __init__(self, cluster: Cluster, history: History) -> None:
        self._cluster = cluster
        self._history = history

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Do so until it is left.

        Raises:
            Exception: A probe ended by it: what its master did then was not seen.
        """
        tasks = [asyncio.create_task(self._probe(machine)) for machine in self._cluster.machines]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result

    async def _probe(self, machine: Machine) -> None:
        while True:
            with contextlib.suppress(OSError, TimeoutError, WebSocketException):
                await self._listen(machine)
            await asyncio.sleep(DIAL_S)

    async def _listen(self, machine: Machine) -> None:
        url = f"ws://{machine.address}:{CONTROL_PORT}/"
        headers = {"Authorization": f"Bearer {SECRET}"}
        term, asked = 0, dict[int, float]()
        async with connect(url, additional_headers=headers, open_timeout=60, ping_interval=None) as socket:
            after = time.monotonic()
            await socket.send(encode(_hello(machine.name)))
            asking = asyncio.create_task(_ask(socket, asked))
            try:
                async for frame in socket:
                    message = decode_to_task_set(frame)
                    if isinstance(message, Welcome):
                        term = message.term
                    if isinstance(message, ClientReply):
                        after = max(after, asked.pop(message.request))
                    if term:
                        kind = type(message).__name__
                        heard = Heard(time.monotonic(), machine.name, term, kind, after)
                        self._history.heard.append(heard)
            finally:
                asking.cancel()
                await asyncio.gather(asking, return_exceptions=True)


def _hello(name: str) -> Hello:
    """Return the Hello of a task set that can run nothing."""
    machine = MachineInfo(name=f"prober-{name}", slots=1, draining=True)
    kind = TaskSetKind.CONTAINER
    return Hello(version=CONTROL_VERSION, kind=kind, process=f"prober-{name}", machine=machine)


async def _ask(socket: ClientConnection, asked: dict[int, float]) -> None:
    """Ask for a container of a robot that is not connected, which is refused at once, until cancelled.

    Args:
        socket: The connection.
        asked: Gets the time of each request, by its number.
    """
    for number in itertools.count(1):
        await asyncio.sleep(ASK_S)
        asked[number] = time.monotonic()
        await socket.send(encode(ClientRequest(request=number, id="prober/none", type="CC", data=None)))


class Robot:
    """A robot that sends a text to its container all the time, and hears it back.

    Attributes:
        longest_gap: Longest time between two texts that came back, seconds.
    """

    def __init__(self, client: Stranger, history: History) -> None:
        self._client = client
        self._history = history
        self._sent: dict[str, float] = {}
        self.longest_gap = 0.0

    @asynccontextmanager
    async def talking(self) -> AsyncIterator[Robot]:
        """Talk until it is left; all that was sent must come back then, and no interface become inactive."""
        sending = asyncio.create_task(self._send())
        hearing = asyncio.create_task(self._hear())
        try:
            yield self
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            try:
                await until(lambda: not self._sent, timeout=PATIENCE_S, what="all texts came back")
            except AssertionError:
                self._history.lost_links.append(f"{len(self._sent)} texts of the robot did not come back")
            hearing.cancel()
            await asyncio.gather(hearing, return_exceptions=True)
            lost = [tag for tag, active in self._client.statuses if not active]
            self._history.lost_links += [f"the robot's interface {tag} became inactive" for tag in lost]

    async def _send(self) -> None:
        for number in itertools.count():
            text = f"text {number}"
            self._sent[text] = time.monotonic()
            await self._client.publish("requestIn", "std_msgs/String", {"data": text})
            await asyncio.sleep(PING_S)

    async def _hear(self) -> None:
        last = time.monotonic()
        while True:
            text = (await self._client.receive("responseOut", timeout=PATIENCE_S))["data"]
            now = time.monotonic()
            self.longest_gap, last = max(self.longest_gap, now - last), now
            self._sent.pop(text, None)


class TaskSets:
    """A robot and a container task set, with a robot."""

    def __init__(self, cluster: Cluster) -> None:
        self.folder = cluster.folder
        masters = ",".join(machine.address for machine in cluster.machines)
        env = cluster.machines[0].env
        at = cluster.server.prefix

        def program(name: str, *options: str) -> Program:
            argv = [*at, str(Path(sys.executable).parent / name), masters, "--dev", *options]
            return Program(name, argv, env, cluster.folder)

        self.robots = program("rce-robot", "--bind", "0.0.0.0", "--public-host", cluster.server.address)
        self.containers = program(
            "rce-container", "--runtime", "process", "--state-dir", str(cluster.folder / "containers")
        )

    def nodes(self) -> set[int]:
        """Return the processes of the robot's nodes."""
        return {
            process.pid
            for process in engine_processes(self.folder)
            if "stringEcho.py" in " ".join(command_line(process))
        }


def running_containers(folder: Path) -> list[str]:
    """Return the tags of the containers whose environments run, but the robot's own."""
    found = []
    for process in engine_processes(folder):
        words = command_line(process)
        if "rce_container.environment" in words and "/bin/sh" not in words[0]:
            tag = json.loads(words[-1])["id"].partition("/")[2]
            found += [tag] if tag.startswith("box") else []
    return found


@asynccontextmanager
async def watched_containers(folder: Path, history: History) -> AsyncIterator[None]:
    """Look at the containers that run all the time until it is left."""
    ended = asyncio.Event()
    watching = asyncio.create_task(_watch_containers(folder, history, ended))
    try:
        yield
    finally:
        ended.set()
        await watching


async def _watch_containers(folder: Path, history: History, ended: asyncio.Event) -> None:
    while not ended.is_set():
        # In a thread: a look takes as long as an answer of a master, and answers are timed.
        history.saw_running(await asyncio.to_thread(running_containers, folder))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(ended.wait(), LOOK_S)


@asynccontextmanager
async def task_sets(cluster: Cluster, history: History) -> AsyncIterator[Robot]:
    """Run task sets with a robot that talks to its container until it is left."""
    made = TaskSets(cluster)
    async with AsyncExitStack() as stack:
        stack.callback(sweep_cgroups, cluster.folder)
        for program in (made.robots, made.containers):
            stack.push_async_callback(_end, program)
            await program.start(timeout=PATIENCE_S)
        url = (await cluster.leader()).url
        await until(lambda: _hands_out(url), timeout=PATIENCE_S, what="a robot task set is there")
        client = await stack.enter_async_context(stranger(url))
        await wire_echo(client)
        await until(lambda: _answers(client), timeout=PATIENCE_S, what="the robot's node answers")
        nodes = made.nodes()
        assert nodes, "no node of the robot runs"
        robot = await stack.enter_async_context(Robot(client, history).talking())
        yield robot
        if made.nodes() != nodes:
            history.lost_links.append("the robot's nodes were started anew")


async def _answers(client: Stranger) -> bool:
    await client.publish("requestIn", "std_msgs/String", {"data": "before"})
    with contextlib.suppress(TimeoutError):
        return bool(await client.receive("responseOut", timeout=2.0))
    return False


async def _hands_out(url: str) -> bool:
    query = {"userID": "testUser", "version": "20130902"}
    async with aiohttp.ClientSession() as session, session.get(url, params=query) as reply:
        return reply.status == 200


async def _end(program: Program) -> None:
    if program.running:
        await program.stop()
