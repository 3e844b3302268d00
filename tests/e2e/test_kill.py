"""Kill -9 of every part under traffic: what must continue continues, what must come back comes back."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator, Awaitable, Callable

import psutil
import pytest
import pytest_asyncio
from support.engine import Engine, running_engine, until
from support.stranger import ROBOT_TAGS, Stranger, check_echo, stranger, wire_echo

pytestmark = [pytest.mark.e2e, pytest.mark.asyncio(loop_scope="module")]

RUNTIMES = ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))]
PAUSE_S = 0.02


@pytest_asyncio.fixture(scope="module", loop_scope="module", params=RUNTIMES)
async def shared_engine(request: pytest.FixtureRequest) -> AsyncIterator[Engine]:
    async with running_engine(runtime=request.param, robots=2) as engine:
        yield engine


@pytest_asyncio.fixture(loop_scope="module")
async def engine(shared_engine: Engine) -> AsyncIterator[Engine]:
    """An engine with all its programs and without a container, which runs as well after the test."""
    yield shared_engine
    for program in shared_engine.programs:
        if not program.running:
            await program.start()
    await until(shared_engine.accepts_robots, what="a robot process is there")
    async with stranger(shared_engine.url, robot="cleaner") as client:
        for container in shared_engine.get("/api/v1/containers")["containers"]:
            await client.send("DC", {"containerTag": container["tag"]})
    await until(
        lambda: not shared_engine.get("/api/v1/containers")["containers"], what="all containers ended"
    )
    await until(shared_engine.has_no_robots, what="all robots left")


def only(runtime: object) -> pytest.MarkDecorator:
    """Run a test with one runtime only."""
    return pytest.mark.parametrize("shared_engine", [runtime], indirect=True, scope="module")


class Traffic:
    """Publishes numbered strings all the time and counts what comes back."""

    def __init__(self, client: Stranger) -> None:
        self.client = client
        self.sent = 0
        self.returned: set[int] = set()

    async def run(self) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(self._send())
            group.create_task(self._count())

    async def _send(self) -> None:
        while True:
            await self.client.publish("requestIn", "std_msgs/String", {"data": f"number {self.sent}"})
            self.sent += 1
            await asyncio.sleep(PAUSE_S)

    async def _count(self) -> None:
        while True:
            text = (await self.client.receive("responseOut", timeout=60))["data"]
            self.returned.add(int(text.split()[1]))


@contextlib.asynccontextmanager
async def traffic(client: Stranger) -> AsyncIterator[Traffic]:
    running = Traffic(client)
    task = asyncio.create_task(running.run())
    try:
        yield running
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def is_python(process: psutil.Process) -> bool:
    return "python" in process.cmdline()[0]


def node_pids(engine: Engine) -> set[int]:
    """Processes of the echo node, which runs whenever this is asked."""
    found = {process.pid for process in engine.processes_of("stringEcho.py") if is_python(process)}
    assert found, "the node does not run"
    return found


def environments(engine: Engine) -> list[psutil.Process]:
    """Processes of the environment, which runs whenever this is asked; not those that only hold it."""
    found = [p for p in engine.processes_of("rce_container.environment") if is_python(p)]
    assert found, "the environment does not run"
    return found


@only("process")
async def test_master_dies_and_comes_back(engine: Engine) -> None:
    async with stranger(engine.url) as client:
        await wire_echo(client)
        nodes = node_pids(engine)
        async with traffic(client) as running:
            await until(lambda: len(running.returned) > 50, what="traffic")
            await engine.master.kill()
            before = running.sent
            await until(
                lambda: running.sent > before + 100 and before + 50 in running.returned,
                what="traffic without a master",
            )
            await engine.master.start()
            await until(engine.accepts_robots, what="the robot process is back")
            before = running.sent
            await until(lambda: before + 20 in running.returned, what="traffic with the new master")
            first, last = min(running.returned), max(running.returned)
            assert set(range(first, last + 1)) == running.returned, "a surviving link lost messages"
        assert node_pids(engine) == nodes
        assert (False in [state for _, state in client.statuses]) is False
        await client.send("CC", {"containerTag": "second"})
        await until(
            lambda: [
                c
                for c in engine.get("/api/v1/containers")["containers"]
                if c["tag"] == "second" and c["state"] == "running"
            ],
            what="a container made by the new master",
        )


@only("process")
async def test_robot_process_dies_and_its_robots_come_back(engine: Engine) -> None:
    async with stranger(engine.url) as client:
        await wire_echo(client)
        victim = next(
            r
            for r, (ws, _) in zip(engine.robots, engine.robot_ports, strict=True)
            if client.socket.get_extra_info("peername")[1] == ws
        )
        await victim.kill()
    await until(engine.accepts_robots, what="another robot process")
    nodes = node_pids(engine)
    async with stranger(engine.url) as client:
        await client.wait_status(dict.fromkeys(ROBOT_TAGS, True))
        await check_echo(client, "back again")
    assert node_pids(engine) == nodes


async def seen_inactive_and_active(client: Stranger) -> dict[str, list[bool]]:
    """Wait until all interfaces became inactive, however shortly, and active again; return their states."""

    def states() -> dict[str, list[bool]]:
        return {tag: [state for name, state in client.statuses if name == tag] for tag in ROBOT_TAGS}

    await until(lambda: all(found[-2:] == [False, True] for found in states().values()), what="active again")
    return states()


async def test_environment_dies_and_is_made_again(engine: Engine) -> None:
    async with stranger(engine.url) as client:
        await wire_echo(client)
        old = node_pids(engine)
        client.statuses.clear()
        for process in environments(engine):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        assert await seen_inactive_and_active(client) == {key: [False, True] for key in ROBOT_TAGS}
        await check_echo(client, "made again")
        await until(lambda: not old & node_pids(engine), what="the old node is gone")


@only(RUNTIMES[1])
async def test_whole_container_dies_and_is_made_again(engine: Engine) -> None:
    async with stranger(engine.url) as client:
        await wire_echo(client)
        client.statuses.clear()
        engine.kill_processes("rce_container.environment")
        await seen_inactive_and_active(client)
        await check_echo(client, "made again")


def zombies(parent: int) -> list[int]:
    children = psutil.Process(parent).children()
    return [process.pid for process in children if process.status() == psutil.STATUS_ZOMBIE]


async def killed(engine: Engine, traffic: Traffic) -> None:
    await engine.container.kill()
    before = traffic.sent
    await until(lambda: before + 50 in traffic.returned, what="traffic without a manager")
    await engine.container.start()


async def renewed(engine: Engine, traffic: Traffic) -> None:
    """Executed anew, in the same process."""
    shims = {process.pid for process in engine.processes_of("rce-container-shim")}
    started = engine.container.output().count(" ready: ")
    os.kill(engine.container.pid, signal.SIGUSR1)
    await until(lambda: engine.container.output().count(" ready: ") > started, what="it is ready again")
    assert engine.container.running
    assert {process.pid for process in engine.processes_of("rce-container-shim")} == shims


@pytest.mark.parametrize("change", [killed, renewed])
async def test_next_manager_adopts_its_containers(
    engine: Engine, change: Callable[[Engine, Traffic], Awaitable[None]]
) -> None:
    async with stranger(engine.url) as client:
        await wire_echo(client)
        nodes = node_pids(engine)
        async with traffic(client) as running:
            await until(lambda: len(running.returned) > 20, what="traffic")
            await change(engine, running)
            await until(
                lambda: [
                    c for c in engine.get("/api/v1/containers")["containers"] if c["state"] == "running"
                ],
                what="the container is adopted",
            )
            before = running.sent
            await until(lambda: before + 50 in running.returned, what="traffic with the new manager")
            first, last = min(running.returned), max(running.returned)
            assert set(range(first, last + 1)) == running.returned, "a surviving link lost messages"
        assert node_pids(engine) == nodes
        assert all(state for _, state in client.statuses)
        engine.kill_processes("rce_container.environment")
        await client.wait_status(dict.fromkeys(ROBOT_TAGS, False))
        await client.wait_status(dict.fromkeys(ROBOT_TAGS, True))
        await until(lambda: not zombies(engine.container.pid), what="ended children are waited for")


@pytest_asyncio.fixture(loop_scope="module")
async def impatient(engine: Engine) -> AsyncIterator[Engine]:
    """The engine, whose containers end themselves after two seconds without a manager."""
    argv = engine.container.argv
    engine.container.argv = [*argv, "--grace", "2"]
    await engine.container.stop()
    await engine.container.start()
    yield engine
    engine.container.argv = argv
    await engine.container.stop()


async def test_containers_end_whole_without_a_manager(impatient: Engine) -> None:
    engine = impatient
    async with stranger(engine.url) as client:
        await wire_echo(client)
        node_pids(engine)
        await engine.container.kill()
        await until(
            lambda: (
                not engine.processes_of("rce-container-shim")
                + engine.processes_of("rce_container.environment")
                + engine.processes_of("stringEcho.py")
            ),
            timeout=30,
            what="shim, environment and nodes are gone",
        )
        left = [path for path in engine.folder.rglob("*") if path.is_socket() and "link" in path.name]
        assert left == []
        await engine.container.start()
        await client.wait_status(dict.fromkeys(ROBOT_TAGS, True))
        await check_echo(client, "made anew")
