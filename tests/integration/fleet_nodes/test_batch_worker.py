"""The process that looks for better queues, and a fleet manager whose queues it changes."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.fleet_manager import ManagerClient

from rce_fleet.exceptions import BatchWorkerError
from rce_fleet.journal.journal import EventQuery
from rce_fleet.nodes import batch_worker
from rce_fleet.nodes.batch_worker import BatchWorker, improve_queues
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.routing_problem import RoutingProblem
from rce_fleet.tasks.task import TaskCause

LOG = logging.getLogger("manager")
pytestmark = pytest.mark.skipif(
    not batch_worker.is_available(), reason="OR-Tools is missing (pip install rce[routing])"
)
CROSSED = RoutingProblem(
    ready=[0.0, 0.0],
    profiles=[0, 0],
    seconds=[[[90.0, 10.0], [10.0, 90.0], [0.0, 80.0], [80.0, 0.0]]],
    queues=[[0], [1]],
    able=[[0, 1], [0, 1]],
    weights=[1, 1],
    deadlines=[inf, inf],
    late=2.0,
    length=3,
    keep=10.0,
)


@pytest.fixture
async def worker() -> AsyncIterator[BatchWorker]:
    made = BatchWorker()
    yield made
    await made.end()


def processes() -> list[psutil.Process]:
    return [each for each in psutil.Process().children() if "rce_fleet.nodes.batch_worker" in each.cmdline()]


async def test_finds_better_queues_with_a_low_priority(worker: BatchWorker) -> None:
    assert processes() == []
    for _ in range(2):
        assert await worker.improve(CROSSED) == [[1], [0]]
    (process,) = processes()
    assert process.nice() == 10
    await worker.end()
    assert not psutil.pid_exists(process.pid)


async def test_a_process_that_was_killed_is_an_error_and_started_again(worker: BatchWorker) -> None:
    await worker.improve(CROSSED)
    os.kill(processes()[0].pid, signal.SIGKILL)
    with pytest.raises(BatchWorkerError, match="signal 9"):
        await worker.improve(CROSSED)
    assert await worker.improve(CROSSED) == [[1], [0]]


async def test_a_process_that_hangs_is_ended(worker: BatchWorker, monkeypatch: pytest.MonkeyPatch) -> None:
    await worker.improve(CROSSED)
    (process,) = processes()
    monkeypatch.setattr(batch_worker, "ANSWER_S", 0.2)
    process.suspend()
    with pytest.raises(BatchWorkerError, match="longer than 0 s"):
        await worker.improve(CROSSED)
    assert not psutil.pid_exists(process.pid)


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ((sys.executable, "-c", "import sys; sys.exit(3)"), r"\(status 3\)"),
        ((sys.executable, "-c", "print('xxxx' * 20000)"), "status 0|wrong answer"),
        (("/nowhere/python",), "failed: .*No such file"),
    ],
    ids=["ends", "other answer", "missing"],
)
async def test_a_process_that_cannot_work_is_an_error(command: tuple[str, ...], reason: str) -> None:
    with pytest.raises(BatchWorkerError, match=reason):
        await BatchWorker(command).improve(CROSSED)


def test_the_process_ends_with_its_input() -> None:
    """A node that is killed leaves none."""
    command = (sys.executable, "-P", "-m", "rce_fleet.nodes.batch_worker")
    ended = subprocess.run(command, input=b"", capture_output=True, timeout=150, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"", b"")


# With a fleet manager


@pytest.fixture
async def client(tmp_path: Path) -> AsyncIterator[ManagerClient]:
    """Robots that drive to cells 50 and 150, each with a task that is nearer to the other one."""
    made = ManagerClient(tmp_path / "journal.sqlite")
    manager = made.manager
    facts = manager.facts
    facts.grid = manager.book.grid = GridMap(1, 200)
    facts.shut = frozenset()
    for name, cell in (("Robot1", 0), ("Robot2", 199)):
        facts.robots[name] = RobotFacts(name, "idle", cell=cell, moved_at=manager.clock())
    for cell in (50, 150):
        await made.ask("POST", "/tasks", {"stops": [{"cell": cell}]})
    await manager.step()
    for cell, robot in ((60, "Robot2"), (140, "Robot1")):
        _, task, _ = await made.ask("POST", "/tasks", {"stops": [{"cell": cell}]})
        manager.book.advance(
            manager.book.find(task["id"]), TaskCause.ASSIGN, manager.clock(), "", robot=robot
        )
    yield made
    await manager.close()


async def robots_of_tasks(client: ManagerClient) -> dict[str, str]:
    _, answer, _ = await client.ask("GET", "/tasks")
    return {task["id"]: task["robot_assigned"] for task in answer["tasks"]}


async def until_moved(client: ManagerClient) -> dict[str, str]:
    """Let the manager take steps until another robot has one of the tasks."""
    before = await robots_of_tasks(client)
    async with asyncio.timeout(150):
        while (now := await robots_of_tasks(client)) == before:
            await client.manager.step()
            await asyncio.sleep(0.05)
    return now


async def test_a_managers_queues_get_better(client: ManagerClient) -> None:
    looking = asyncio.create_task(improve_queues(client.manager, LOG, 0.1))
    try:
        robots = await until_moved(client)
    finally:
        looking.cancel()
        await asyncio.wait([looking])
    assert robots == {"T1": "Robot1", "T2": "Robot2", "T3": "Robot1", "T4": "Robot2"}
    assert processes() == []
    await client.manager.commit()
    told = [event["text"] for event in client.journal.events(EventQuery()) if event["id"] == "T3"]
    assert "from Robot2 to Robot1" in told[-1]


async def test_a_process_that_always_ends_is_logged_once(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Then a process that works changes the queues after all."""
    commands = [(sys.executable, "-c", "")] * 3
    real = BatchWorker.improve

    async def improve(self: BatchWorker, problem: RoutingProblem) -> Any:
        self._command = commands.pop() if commands else (sys.executable, "-m", batch_worker.__name__)
        return await real(self, problem)

    monkeypatch.setattr(BatchWorker, "improve", improve)
    monkeypatch.setattr(batch_worker, "RESTART_S", 0.1)
    looking = asyncio.create_task(improve_queues(client.manager, LOG, 0.1))
    try:
        await until_moved(client)
    finally:
        looking.cancel()
        await asyncio.wait([looking])
    told = [record.getMessage() for record in caplog.records if "keep their robots" in record.getMessage()]
    assert len(told) == 1


@pytest.mark.parametrize("name", ["ortools", "no_such_package"])
def test_nothing_is_looked_for_without_the_library(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_fleet.nodes.batch_worker.find_spec", lambda _name: find_spec(name))
    assert batch_worker.is_available() is (name == "ortools")
