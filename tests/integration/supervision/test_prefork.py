"""Programs that begin as forks of their supervisor, in a supervisor of their own process."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Protocol

import psutil
import pytest
import uvloop

from rce.supervision.prefork import ForkedProcess, Prepared
from rce.supervision.process import Child

PART = """
import json, os, resource, signal, sys, threading
import shared

def main():
    kept = ("PART", "PYTHONUNBUFFERED", "HOME")
    print("part ready: now")
    if sys.argv[1:2] == ["fail"]:
        sys.exit(3)
    print(json.dumps({
        "pid": os.getpid(),
        "argv": sys.argv[1:],
        "executed": sys.orig_argv,
        "shown": open("/proc/self/cmdline").read().rstrip("\\0").split("\\0"),
        "called": open("/proc/self/comm").read(),
        "environ": {name: os.environ.get(name) for name in kept},
        "session": os.getsid(0) == os.getpid(),
        "parent": os.getppid(),
        "input": sys.stdin.read(),
        "open": sorted(n for n in map(int, os.listdir("/proc/self/fd")) if n < 20)[:-1],
        "handlers": [str(signal.getsignal(n)) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)],
        "blocked": sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ())),
        "files": resource.getrlimit(resource.RLIMIT_NOFILE),
        "threads": threading.active_count(),
    }))
    signal.pause()

if __name__ == "__main__":
    main()
"""
SHARED = "import os; open(os.environ['LOADED'], 'a').write(f'{os.getpid()}\\n')"
SUPERVISOR = """
import asyncio, json, os, signal, sys
from rce.supervision.__main__ import run
from rce.supervision.plan import Plan
from rce.supervision.prefork import prepare
from rce.supervision.plan import Program
import uvloop

wanted = json.loads(sys.argv[1])
programs = tuple(Program.of(name, "part", *words, env={"PART": name}) for name, *words in wanted)
prepared = prepare(programs, ["shared"])
print("prepared", *[fork.pid for fork in prepared.values()], flush=True)
if sys.argv[2:] == ["wait"]:
    sys.stdin.read()
if sys.argv[2:] == ["kill the last"]:
    os.kill(list(prepared.values())[-1].pid, signal.SIGKILL)
sys.exit(uvloop.run(run(Plan(programs=programs, ready=("all",)), prepared)))
"""


class Supervised:
    """A supervisor in a process of its own."""

    def __init__(self, child: Child) -> None:
        self.child = child
        self._lines = child.lines()

    async def until(self, words: str) -> str:
        """Return the next line that holds these words, without what comes before them."""
        async for line in self._lines:
            if words in line:
                return line[line.index(words) :]
        raise AssertionError(f"no line with {words!r}")

    async def forks(self) -> list[psutil.Process]:
        """Return the forks that wait to begin."""
        return [psutil.Process(int(word)) for word in (await self.until("prepared")).split()[1:]]


class Start(Protocol):
    """Starts a supervisor; see :func:`start`."""

    async def __call__(self, programs: list[list[str]], *words: str) -> Supervised: ...


@pytest.fixture
async def start(tmp_path: Path) -> AsyncIterator[Start]:
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "__main__.py").write_text(PART)
    (tmp_path / "part" / "__init__.py").touch()
    (tmp_path / "shared.py").write_text(SHARED)
    children: list[Child] = []

    async def begin(programs: list[list[str]], *words: str) -> Supervised:
        argv = [sys.executable, "-c", SUPERVISOR, json.dumps(programs), *words]
        env = {"PYTHONPATH": str(tmp_path), "LOADED": str(tmp_path / "loaded")}
        children.append(await Child.start("supervisor", argv, env=env))
        return Supervised(children[-1])

    yield begin
    for child in children:
        await child.stop()


async def gone(processes: list[psutil.Process]) -> None:
    async with asyncio.timeout(60):
        while any(process.is_running() for process in processes):
            await asyncio.sleep(0.02)


async def test_a_fork_is_what_an_executed_program_is(start: Start, tmp_path: Path) -> None:
    supervised = await start([["one", "first", "two words"]])
    (fork,) = await supervised.forks()
    forked = json.loads(await supervised.until("{"))
    assert forked["pid"] == fork.pid
    assert (tmp_path / "loaded").read_text() == f"{supervised.child.pid}\n"
    os.kill(fork.pid, signal.SIGKILL)
    assert "exit code -9; starting it again" in await supervised.until("ended")
    executed = json.loads(await supervised.until("{"))
    assert executed.pop("pid") != forked.pop("pid")
    assert executed.pop("open")[:3] == forked.pop("open") == [0, 1, 2]
    assert forked == executed
    assert (tmp_path / "loaded").read_text().count("\n") == 2


async def test_the_exit_code_of_a_fork_is_told(start: Start) -> None:
    supervised = await start([["one", "fail"]])
    assert "exit code 3; starting it again" in await supervised.until("ended")


async def test_forks_that_wait_end_with_their_supervisor(start: Start) -> None:
    supervised = await start([["one"], ["two"]], "wait")
    forks = await supervised.forks()
    assert len(forks) == 2
    os.kill(supervised.child.pid, signal.SIGKILL)
    await gone(forks)


async def test_a_fork_that_was_killed_before_it_began_fails_the_start(start: Start) -> None:
    supervised = await start([["one"], ["two"]], "kill the last")
    pids = [int(word) for word in (await supervised.until("prepared")).split()[1:]]
    assert "rce up: two ended with exit code -9 before it was ready" in await supervised.until("rce up")
    assert await supervised.child.wait() == 1
    async with asyncio.timeout(60):
        while any(psutil.pid_exists(pid) for pid in pids):
            await asyncio.sleep(0.02)


def test_a_fork_ends_if_its_begin_is_cancelled() -> None:
    wait, go = os.pipe()
    output, print_ = os.pipe()
    process = subprocess.Popen(["cat"], stdin=wait, stdout=print_)
    os.close(wait)
    os.close(print_)

    async def begin() -> None:
        task = asyncio.create_task(ForkedProcess.begin(Prepared(process.pid, go, output)))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    uvloop.run(begin())
    assert not psutil.pid_exists(process.pid)
    process.wait()


async def test_forks_end_when_their_supervisor_is_told_to(start: Start) -> None:
    supervised = await start([["one"], ["two"]])
    forks = await supervised.forks()
    await supervised.until("all")
    os.kill(supervised.child.pid, signal.SIGTERM)
    assert await supervised.child.wait() == 0
    await gone(forks)
