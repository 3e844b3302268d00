"""The process that makes plans: the same plans as in this process, and what happens when it ends."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from array import array
from dataclasses import replace

import psutil
import pytest

from rce_fleet.coordination.ledger_view import CELLS, STEPS
from rce_fleet.coordination.replanning import PlanRequest, compute_plan
from rce_fleet.coordination.rerouting import NO_CELL, LedgerCopy
from rce_fleet.exceptions import PlanWorkerError
from rce_fleet.nodes.plan_worker import PlanWorker, is_large

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


COMPILES_NOTHING = """
import sys
from rce_fleet.nodes import plan_worker
from rce_fleet.planning import lacam
lacam.KERNELS = plan_worker.DRIVING_KERNELS = ()
if "--cached" in sys.argv and not IS_CACHED:
    sys.exit()
plan_worker.main()
"""
EMPTY_CACHE = COMPILES_NOTHING.replace("IS_CACHED", "False")
FULL_CACHE = COMPILES_NOTHING.replace("IS_CACHED", "True")


def children_with(word: str) -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if word in child.cmdline()]


def workers() -> list[psutil.Process]:
    return children_with("rce_fleet.nodes.plan_worker")


async def test_makes_the_plans_that_this_process_makes() -> None:
    async with PlanWorker(LOG, compiled=False) as worker:
        for number in range(3):
            request = request_of(number, robots=number + 1)
            assert await worker.compute(request) == compute_plan(request)
        (process,) = workers()
    assert not psutil.pid_exists(process.pid)


async def test_the_compiling_process_ends_with_its_input() -> None:
    """A node that is killed leaves none."""
    command = (sys.executable, "-P", "-m", "rce_fleet.nodes.plan_worker", "--compile")
    process = await asyncio.create_subprocess_exec(*command, stdin=asyncio.subprocess.PIPE)
    assert process.stdin is not None
    process.stdin.close()
    async with asyncio.timeout(60):
        assert await process.wait() == 0
    # It ended before it had compiled anything; a whole run takes half a minute and more.


async def test_a_process_that_ended_is_started_again(caplog: pytest.LogCaptureFixture) -> None:
    async with PlanWorker(LOG, compiled=False) as worker:
        (first,) = workers()
        os.kill(first.pid, signal.SIGKILL)
        request = request_of(1)
        assert await worker.compute(request) == compute_plan(request)
        (second,) = workers()
        assert second.pid != first.pid
    assert "restarting it" in caplog.text


async def test_a_request_that_ends_the_process_twice_is_an_error() -> None:
    command = (sys.executable, "-c", "import sys; sys.stdin.buffer.read(9); sys.exit(3)")
    async with PlanWorker(LOG, command=command, compiled=False) as worker:
        with pytest.raises(PlanWorkerError, match=r"plan 7 for 3 robots .*status 3"):
            await worker.compute(request_of(7))


RAISES = """
import sys
from rce_fleet.nodes import plan_worker
from rce_fleet.planning import planner

class RaisesAtOddSeeds:
    def plan(self, problem):
        if problem.seed % 2:
            raise RuntimeError("seed is odd")
        return planner.load_planner("lacam").plan(problem)

def load(name):
    if name == "missing":
        raise ImportError("not here")
    return RaisesAtOddSeeds()

plan_worker.load_planner = load
plan_worker.serve(sys.stdin.buffer, sys.stdout.buffer)
"""


async def test_a_planner_that_raises_gives_an_empty_plan(caplog: pytest.LogCaptureFixture) -> None:
    """The process makes the next plan; nothing is restarted."""
    command = (sys.executable, "-P", "-c", RAISES)
    async with PlanWorker(LOG, command=command, compiled=False) as worker:
        (process,) = children_with(RAISES)
        for number in range(1, 5):
            request = replace(request_of(number), planner="mine" if number < 4 else "missing")
            result = await worker.compute(request)
            if number == 2:
                assert result == compute_plan(request_of(number))
                continue
            assert (result.cells, result.complete, result.unreachable) == ((), False, ())
            reason = "RuntimeError: seed is odd" if number < 4 else "ImportError: not here"
            assert result.failure == reason
        assert children_with(RAISES) == [process]
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert len(errors) == 3
    assert "the planner 'mine' failed in plan 1 for 3 robots: RuntimeError: seed is odd" in errors[0]
    assert "the planner 'missing' failed in plan 4 for 3 robots: ImportError: not here" in errors[2]
    assert "restarting" not in caplog.text


JUMPS = """
import sys
from rce_fleet.nodes import plan_worker
from rce_fleet.planning.planner import JointPlan

class Jumps:
    def plan(self, problem):
        return JointPlan.of([problem.starts.tolist(), problem.goals.tolist()], complete=True)

plan_worker.load_planner = lambda name: Jumps()
plan_worker.serve(sys.stdin.buffer, sys.stdout.buffer)
"""


async def test_a_wrong_plan_of_another_package_is_told(caplog: pytest.LogCaptureFixture) -> None:
    """The log names planner, step and robot; no cell of the plan is handed on."""
    async with PlanWorker(LOG, command=(sys.executable, "-P", "-c", JUMPS), compiled=False) as worker:
        result = await worker.compute(replace(request_of(1), planner="mine"))
    assert (result.cells, result.complete) == ((), False)
    (error,) = (record.getMessage() for record in caplog.records if record.levelno == logging.ERROR)
    assert "the planner 'mine' failed in plan 1 for 3 robots: step 1: robot 0 goes from cell" in error
    assert f"which is not beside it (robot 0 is {request_of(1).robots[0]}); lacam makes the plans" in error


async def test_a_worker_ends_with_its_input(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also when the planner is killed and cannot end it; without loops, which it would load first."""
    monkeypatch.setenv("RCE_COMPILED", "no")
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

    async with PlanWorker(LOG, compiled=False) as worker:
        await worker.compute(request_of(1))
        counting = asyncio.create_task(count())
        await worker.compute(request_of(2, robots=40, size=40))
        counting.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await counting
    assert steps > 100


LARGE = request_of(0, robots=20, size=21)


async def test_a_process_with_compiled_loops_takes_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loops of the process are left out here: to compile them takes half a minute."""
    pytest.importorskip("numba")
    monkeypatch.delenv("RCE_COMPILED", raising=False)
    command = (sys.executable, "-P", "-c", EMPTY_CACHE)
    async with PlanWorker(LOG, command=command) as worker:
        assert await worker.compute(request_of(1)) == compute_plan(request_of(1))
        assert len(children_with(EMPTY_CACHE)) == 1, "a few robots need no compiled loops"
        assert await worker.compute(LARGE) == compute_plan(LARGE)
        async with asyncio.timeout(60):
            while not worker.is_compiled:
                await asyncio.sleep(0.05)
        for number in (2, 3):
            request = request_of(number)
            assert await worker.compute(request) == compute_plan(request)
        children = children_with(EMPTY_CACHE)
        assert len(children) == 1
        os.kill(children[0].pid, signal.SIGKILL)
        assert await worker.compute(request_of(4)) == compute_plan(request_of(4))


def late_request(number: int) -> PlanRequest:
    """One robot waits 20 steps in an empty floor; better paths are asked for."""
    path = array(CELLS, range(1, 8)), array(STEPS, (20.0 + cell for cell in range(1, 8)))
    copy = LedgerCopy(
        members=(),
        begins=array(STEPS, (0.0,)).tobytes(),
        lengths=array(CELLS, (7,)).tobytes(),
        cells=path[0].tobytes(),
        steps=path[1].tobytes(),
        granted=b"",
        leaves=b"",
        clock=0.0,
    )
    request = replace(request_of(number, robots=1), goals=(7,), blocked=(), copy=copy)
    return replace(request, improve_seconds=60.0)


async def test_better_paths_are_found_where_loops_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without them the answer is at once that robots keep their paths."""
    pytest.importorskip("numba")
    monkeypatch.delenv("RCE_COMPILED", raising=False)
    monkeypatch.setattr("rce_fleet.nodes.plan_worker._LOAD_S", 600.0)
    async with PlanWorker(LOG, command=(sys.executable, "-P", "-c", FULL_CACHE)) as worker:
        plain = (await worker.compute(late_request(1))).rerouting
        assert plain is not None
        assert plain.found
        assert plain.robots == ()
        await worker.compute(LARGE)
        assert worker.is_compiled
        better = (await worker.compute(late_request(2))).rerouting
    assert better is not None
    assert better.paths == (tuple((cell, float(cell)) for cell in range(1, 8)),)


async def test_plans_are_made_if_nothing_can_be_compiled(caplog: pytest.LogCaptureFixture) -> None:
    script = "import os, sys\nif os.environ.get('RCE_COMPILED') != 'no': sys.exit(1)\n" + EMPTY_CACHE
    async with PlanWorker(LOG, command=(sys.executable, "-P", "-c", script), compiled=True) as worker:
        assert await worker.compute(LARGE) == compute_plan(LARGE)
        async with asyncio.timeout(60):
            while "without compiled loops" not in caplog.text:
                await asyncio.sleep(0.05)
        assert await worker.compute(request_of(1)) == compute_plan(request_of(1))
        assert not worker.is_compiled


async def test_first_large_plan_is_compiled_if_the_cache_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """As after each restart of a container: the request waits for the loops instead of the plain ones."""
    pytest.importorskip("numba")
    monkeypatch.delenv("RCE_COMPILED", raising=False)
    monkeypatch.setattr("rce_fleet.nodes.plan_worker._LOAD_S", 600.0)
    async with PlanWorker(LOG, command=(sys.executable, "-P", "-c", FULL_CACHE)) as worker:
        (plain,) = children_with(FULL_CACHE)
        assert await worker.compute(LARGE) == compute_plan(LARGE)
        (compiled,) = children_with(FULL_CACHE)
        assert worker.is_compiled
        assert compiled.pid != plain.pid
        assert "--cached" in compiled.cmdline()


async def test_loops_are_loaded_once_many_robots_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the first request; a small fleet on a small map needs none."""
    pytest.importorskip("numba")
    monkeypatch.delenv("RCE_COMPILED", raising=False)
    async with PlanWorker(LOG, command=(sys.executable, "-P", "-c", FULL_CACHE)) as worker:
        assert not is_large(19, 9_999)
        worker.prepare(20, 64)
        async with asyncio.timeout(60):
            while not worker.is_compiled:
                await asyncio.sleep(0.05)


NEVER_ENDS = """
from rce_fleet.nodes import plan_worker

class NeverEnds:
    def plan(self, problem):
        while problem.seed == 1:
            pass
        return lacam.plan(problem)

lacam = plan_worker.load_planner("lacam")
plan_worker.load_planner = lambda name: NeverEnds()
plan_worker.main()
"""


async def test_a_planner_that_never_returns_is_ended(caplog: pytest.LogCaptureFixture) -> None:
    """The plan is empty, the error names planner and parameter, and another process makes the next plan."""
    command = (sys.executable, "-P", "-c", NEVER_ENDS)
    async with PlanWorker(LOG, command=command, compiled=False, timeout=60) as worker:
        request = replace(request_of(2), planner="mine")  # the process has started and can be timed
        assert (await worker.compute(request)).complete
        (first,) = children_with(NEVER_ENDS)
        worker.timeout = 0.5
        result = await worker.compute(replace(request_of(1), planner="mine"))
        assert (result.number, result.cells, result.complete) == (1, (), False)
        assert "longer than" in result.failure
        assert not first.is_running()
        worker.timeout = 60
        assert (await worker.compute(request)).complete
    (error,) = (record.getMessage() for record in caplog.records if record.levelno == logging.ERROR)
    assert "the planner 'mine' made no plan 1 for 3 robots within" in error
    assert "plan_timeout" in error


async def test_a_stopped_plan_process_is_ended(caplog: pytest.LogCaptureFixture) -> None:
    async with PlanWorker(LOG, compiled=False, timeout=0.5) as worker:
        (first,) = workers()
        os.kill(first.pid, signal.SIGSTOP)
        assert (await worker.compute(request_of(1))).failure
        assert not first.is_running()
        worker.timeout = 60
        assert await worker.compute(request_of(2)) == compute_plan(request_of(2))
    assert "made no plan 1 for 3 robots" in caplog.text


@pytest.mark.parametrize("is_better", [True, False])
async def test_a_search_for_paths_has_its_own_limit(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, is_better: bool
) -> None:
    """Robots stand meanwhile. Without better paths they keep theirs; without new ones all get a plan."""
    for name in ("_BETTER_S", "_NEW_PATHS_S"):
        monkeypatch.setattr(f"rce_fleet.nodes.plan_worker.{name}", 0.5)
    seconds = 0.1 if is_better else 0.0
    request = replace(late_request(1), improve_seconds=seconds)
    async with PlanWorker(LOG, compiled=False) as worker:
        (first,) = workers()
        os.kill(first.pid, signal.SIGSTOP)
        result = await worker.compute(request)
        assert not first.is_running()
        assert result.rerouting is not None
        assert (result.rerouting.found, bool(result.failure)) == (is_better, not is_better)
        assert await worker.compute(request_of(2)) == compute_plan(request_of(2))
    assert ("keep their paths" if is_better else "one plan is made for all") in caplog.text
    assert worker.limit_for(request) < worker.time_for(1) == worker.limit_for(request_of(1, robots=1))


def test_large_fleets_have_more_time_for_a_plan() -> None:
    worker = PlanWorker(LOG, compiled=False, timeout=60)
    assert worker.time_for(0) == 60
    assert worker.time_for(2000) == 300
