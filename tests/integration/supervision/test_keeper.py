"""One program is kept running."""

from __future__ import annotations

import asyncio
import errno
import signal
import sys

import psutil
import pytest

from rce.aio.backoff import Backoff
from rce.supervision.keeper import Keeper, RestartPolicy
from rce.supervision.process import Child

AT_ONCE = Backoff(0.0, 0.0)
MINUTE = Backoff(60.0, 60.0)
SLEEPER = "import time; print('up', flush=True); time.sleep(1000)"


ENDLESS = RestartPolicy(AT_ONCE, stable_s=1000.0)


def keeper(code: str, lines: list[str], policy: RestartPolicy = ENDLESS) -> Keeper:
    return Keeper(lambda: Child.start("program", [sys.executable, "-c", code]), lines.append, policy)


async def test_an_ended_program_is_started_again_as_often_as_its_policy_says() -> None:
    lines: list[str] = []
    ends: list[tuple[int, float | None]] = []

    def on_end(code: int, pause: float | None) -> bool:
        ends.append((code, pause))
        return True

    policy = RestartPolicy(AT_ONCE, stable_s=1000.0, max_ends=3)
    code = await keeper("print('up'); raise SystemExit(3)", lines, policy).run(on_end)
    assert code == 3
    assert ends == [(3, 0.0), (3, 0.0), (3, None)]
    assert lines == ["up", "up", "up"]


async def test_a_program_that_ran_long_counts_as_new() -> None:
    count = 0

    def on_end(code: int, pause: float | None) -> bool:
        nonlocal count
        count += 1
        assert pause == 0.0
        return count < 5

    policy = RestartPolicy(AT_ONCE, stable_s=0.0, max_ends=2)
    assert await keeper("", [], policy).run(on_end) == 0
    assert count == 5


async def test_a_line_that_cannot_be_taken_is_lost() -> None:
    """The next ones are read: a program whose output is not read blocks in its next write."""

    def refuse(line: str) -> None:
        raise OSError(errno.ENOSPC, "no space")

    code = "for _ in range(50_000): print('x' * 99)"
    kept = Keeper(lambda: Child.start("p", [sys.executable, "-c", code]), refuse, ENDLESS)
    async with asyncio.timeout(60):
        assert await kept.run(lambda code, pause: False) == 0


@pytest.mark.parametrize("failures", [2, 9])
async def test_a_failed_restart_counts_as_an_end(failures: int) -> None:
    """It is tried again while the policy allows it."""
    starts = 0
    lines: list[str] = []

    async def begin() -> Child:
        nonlocal starts
        starts += 1
        if 1 < starts <= 1 + failures:
            raise OSError(errno.EAGAIN, "too many processes")
        return await Child.start("p", [sys.executable, "-c", f"raise SystemExit({starts})"])

    policy = RestartPolicy(AT_ONCE, stable_s=1000.0, max_ends=4)
    code = await Keeper(begin, lines.append, policy).run(lambda code, pause: True)
    assert (code, starts) == ((4, 4) if failures == 2 else (1, 4))
    assert all("cannot be started" in line and "too many processes" in line for line in lines)
    assert len(lines) == starts - (2 if failures == 2 else 1)


async def test_the_owner_decides_whether_it_is_started_again() -> None:
    lines: list[str] = []
    kept = keeper("print('once')", lines)
    assert await kept.run(lambda code, pause: False) == 0
    assert lines == ["once"]


async def test_stop_ends_the_program_for_good() -> None:
    up = asyncio.Event()
    kept = Keeper(lambda: Child.start("p", [sys.executable, "-c", SLEEPER]), lambda line: up.set(), ENDLESS)
    child = await kept.start()
    running = asyncio.create_task(kept.run(lambda code, pause: True))
    await up.wait()
    await kept.stop(timeout=30.0)
    await running
    assert kept.child is child
    assert child.returncode == -signal.SIGTERM


async def test_stop_cuts_a_pause_short() -> None:
    ended = asyncio.Event()

    def on_end(code: int, pause: float | None) -> bool:
        ended.set()
        return True

    kept = keeper("raise SystemExit(5)", [], RestartPolicy(MINUTE, stable_s=1000.0))
    running = asyncio.create_task(kept.run(on_end))
    await ended.wait()
    former = kept.child
    await kept.stop(timeout=1.0)
    async with asyncio.timeout(30):
        assert await running == 5
    assert kept.child is former


async def test_cancellation_ends_the_program_and_shows_its_last_lines() -> None:
    lines: list[str] = []
    up = asyncio.Event()

    def take_line(line: str) -> None:
        lines.append(line)
        up.set()

    code = (
        "import signal, sys, time\n"
        "def end(*_):\n    print('bye', flush=True); sys.exit(0)\n"
        "signal.signal(signal.SIGTERM, end)\nprint('up', flush=True)\ntime.sleep(1000)"
    )
    kept = Keeper(
        lambda: Child.start("p", [sys.executable, "-c", code]),
        take_line,
        ENDLESS,
    )
    running = asyncio.create_task(kept.run(lambda code, pause: True))
    await up.wait()
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running
    assert lines == ["up", "bye"]
    assert kept.child is not None
    assert kept.child.returncode == 0


async def test_an_error_of_its_owner_ends_nothing_twice() -> None:
    def on_end(code: int, pause: float | None) -> bool:
        raise RuntimeError(f"ended with {code}")

    kept = keeper(f"import os, signal; os.kill(os.getpid(), {int(signal.SIGKILL)})", [])
    with pytest.raises(RuntimeError, match="ended with -9"):
        await kept.run(on_end)
    assert kept.child is not None
    assert not psutil.pid_exists(kept.child.pid)


async def test_a_program_that_cannot_be_started_says_so() -> None:
    kept = Keeper(lambda: Child.start("p", ["/nowhere/at/all"]), print, ENDLESS)
    with pytest.raises(FileNotFoundError):
        await kept.run(lambda code, pause: True)
