"""The process that makes plans: the same plans as in this process, and what happens when it ends."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys

import psutil
import pytest

from rce_fleet.coordination.replanning import NO_CELL, PlanRequest, compute_plan
from rce_fleet.exceptions import PlanWorkerError
from rce_fleet.nodes.plan_worker import PlanWorker

LOG = logging.getLogger("planner")


def request_of(number: int, robots: int = 3, *, size: int = 8, effort: int = 20_000) -> PlanRequest:
    """Robots in the lowest row, sent to the highest."""
    return PlanRequest(
        number=number,
        rows=size,
        columns=size,
        blocked=(size + 1,),
        robots=tuple(f"R{index}" for index in range(robots)),
        starts=tuple(range(robots)),
        goals=tuple(size * size - 1 - index for index in range(robots)),
        rests=(NO_CELL,) * robots,
        seed=number,
        effort=effort,
    )


def workers() -> list[psutil.Process]:
    return [
        child for child in psutil.Process().children() if "rce_fleet.nodes.plan_worker" in child.cmdline()
    ]


async def test_makes_the_plans_that_this_process_makes() -> None:
    async with PlanWorker(LOG) as worker:
        for number in range(3):
            request = request_of(number, robots=number + 1)
            assert await worker.compute(request) == compute_plan(request)
        (process,) = workers()
    assert not psutil.pid_exists(process.pid)


async def test_a_process_that_ended_is_started_again(caplog: pytest.LogCaptureFixture) -> None:
    async with PlanWorker(LOG) as worker:
        (first,) = workers()
        os.kill(first.pid, signal.SIGKILL)
        request = request_of(1)
        assert await worker.compute(request) == compute_plan(request)
        (second,) = workers()
        assert second.pid != first.pid
    assert "restarting it" in caplog.text


async def test_a_request_that_ends_the_process_twice_is_an_error() -> None:
    command = (sys.executable, "-c", "import sys; sys.stdin.buffer.read(9); sys.exit(3)")
    async with PlanWorker(LOG, command=command) as worker:
        with pytest.raises(PlanWorkerError, match=r"plan 7 for 3 robots .*status 3"):
            await worker.compute(request_of(7))


async def test_a_worker_ends_with_its_input() -> None:
    """Also when the planner is killed and cannot end it."""
    command = (sys.executable, "-P", "-m", "rce_fleet.nodes.plan_worker")
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe)
    assert process.stdin is not None
    process.stdin.close()
    assert await asyncio.wait_for(process.wait(), 60) == 0


async def test_other_work_goes_on_while_a_plan_is_made() -> None:
    """The event loop takes thousands of steps during one plan; on the loop itself it would take none."""
    steps = 0

    async def count() -> None:
        nonlocal steps
        while True:
            steps += 1
            await asyncio.sleep(0)

    async with PlanWorker(LOG) as worker:
        await worker.compute(request_of(1))
        counting = asyncio.create_task(count())
        await worker.compute(request_of(2, robots=40, size=40))
        counting.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await counting
    assert steps > 100
