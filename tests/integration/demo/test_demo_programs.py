"""The programs of a demo: started, watched, ended together."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

import psutil
import pytest

from rce.aio.backoff import Backoff
from rce.supervision.keeper import RestartPolicy
from rce_fleet.demo import programs as programs_module
from rce_fleet.demo.exceptions import DemoError, NotReadyError, ProgramEndedError
from rce_fleet.demo.programs import ProgramGroup

Stop = Callable[..., Awaitable[None]]

TALKER = "import time\nprint('talker ready: 42')\ntime.sleep(600)"
DEAF = "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('up')\ntime.sleep(600)"
DYING = "print('something is wrong')\nraise SystemExit(3)"


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def ignore(_: str) -> None:
    pass


async def for_ever() -> None:
    await asyncio.Event().wait()


async def test_lines_are_logged_shown_and_waited_for(tmp_path: Path) -> None:
    shown: list[str] = []
    async with ProgramGroup(tmp_path, shown.append) as group:
        talker = await group.start("talker", python(TALKER))
        assert await group.wait_line(talker, "talker ready:", 20) == "42"
    assert shown == ["[talker] talker ready: 42"]
    assert (tmp_path / "talker.log").read_text() == "talker ready: 42\n"
    assert talker.child.returncode == -signal.SIGTERM


async def test_lines_that_cannot_be_shown_are_waited_for(tmp_path: Path) -> None:
    def refuse(_: str) -> None:
        raise OSError(errno.EPIPE, "the terminal is closed")

    async with ProgramGroup(tmp_path, refuse) as group:
        talker = await group.start("talker", python(TALKER))
        assert await group.wait_line(talker, "talker ready:", 60) == "42"


async def test_programs_are_stopped_if_a_signal_comes_while_they_stop(tmp_path: Path) -> None:
    """The time of a run is up, and a signal cancels it once more before all programs have ended."""
    slow = (
        "import signal, time\nsignal.signal(signal.SIGTERM, lambda *_: time.sleep(1) or exit(0))\nprint('up')"
    )
    programs = []

    async def run() -> None:
        async with ProgramGroup(tmp_path, ignore) as group:
            for name in ("first", "second"):
                programs.append(
                    await group.start(name, python(f"{slow}\ntime.sleep(600)"), stop_last=name == "second")
                )
                await group.wait_line(programs[-1], "up", 60)
            stopping.set()
            await group.run_while_alive(for_ever())

    stopping = asyncio.Event()
    task = asyncio.create_task(run())
    await stopping.wait()
    for _ in range(2):
        task.cancel()
        await asyncio.sleep(0.1)
    with pytest.raises(asyncio.CancelledError):
        await asyncio.wait_for(task, 60)
    assert [program.child.returncode for program in programs] == [0, 0]


async def test_error_names_the_ended_program_and_its_last_lines(tmp_path: Path) -> None:
    async with ProgramGroup(tmp_path, ignore) as group:
        talker = await group.start("talker", python(TALKER))
        await group.start("dying", python(DYING))
        with pytest.raises(ProgramEndedError, match="dying ended with exit code 3\n    something is wrong"):
            await asyncio.wait_for(group.run_while_alive(for_ever()), 20)
    assert not psutil.pid_exists(talker.child.pid)


async def test_restartable_program_is_restarted(tmp_path: Path) -> None:
    told: asyncio.Queue[str] = asyncio.Queue()
    async with ProgramGroup(tmp_path, ignore) as group:
        talker = await group.start("talker", python(TALKER), restartable=True)
        await group.wait_line(talker, "talker ready:", 20)
        group.enable_restarts(told.put_nowait)
        former = talker.child
        os.kill(former.pid, signal.SIGKILL)
        work = asyncio.create_task(group.run_while_alive(for_ever()))
        assert await told.get() == "talker was ended by SIGKILL; restarting it"
        async with asyncio.timeout(60):
            while (tmp_path / "talker.log").read_text().count("talker ready: 42") < 2:
                await asyncio.sleep(0.05)
        assert talker.child is not former
        assert not work.done()
        work.cancel()
    assert talker.child.returncode == -signal.SIGTERM


async def test_program_that_keeps_ending_is_not_restarted_forever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = RestartPolicy(Backoff(0.01, 0.01), stable_s=10, max_ends=5)
    monkeypatch.setattr(programs_module, "RESTARTS", quick)
    told: list[str] = []
    async with ProgramGroup(tmp_path, ignore) as group:
        group.enable_restarts(told.append)
        await group.start("dying", python(DYING), restartable=True)
        with pytest.raises(ProgramEndedError, match="dying ended with exit code 3"):
            await asyncio.wait_for(group.run_while_alive(for_ever()), 30)
    assert len(told) == quick.max_ends - 1


async def test_no_program_is_restarted_while_the_group_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs_module, "RESTARTS", RestartPolicy(Backoff(100.0, 100.0), stable_s=10))
    told = asyncio.Event()
    async with ProgramGroup(tmp_path, ignore) as group:
        group.enable_restarts(lambda _: told.set())
        dying = await group.start("dying", python(DYING), restartable=True)
        former = dying.child
        await told.wait()
    assert dying.child is former


async def test_error_names_the_program_that_is_not_ready(tmp_path: Path) -> None:
    async with ProgramGroup(tmp_path, ignore) as group:
        talker = await group.start("talker", python(TALKER))
        with pytest.raises(NotReadyError, match="talker was not ready"):
            await group.wait_line(talker, "never:", 0.05)


async def test_work_returns_its_result_and_its_errors(tmp_path: Path) -> None:
    async def answer() -> int:
        return 42

    async def fail() -> None:
        raise DemoError("no")

    async with ProgramGroup(tmp_path, ignore) as group:
        await group.start("talker", python(TALKER))
        assert await group.run_while_alive(answer()) == 42
        with pytest.raises(DemoError, match="no"):
            await group.run_while_alive(fail())


async def test_program_that_ignores_sigterm_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs_module, "STOP_TIMEOUT", 0.1)
    async with ProgramGroup(tmp_path, ignore) as group:
        await group.start("talker", python(TALKER))
        deaf = await group.start("deaf", python(DEAF))
        await group.wait_line(deaf, "up", 20)
    assert deaf.child.returncode == -signal.SIGKILL


async def test_all_end_when_the_work_is_cancelled(tmp_path: Path) -> None:
    started = asyncio.Event()
    pids: list[int] = []

    async def run() -> None:
        async with ProgramGroup(tmp_path, ignore) as group:
            pids.extend([(await group.start(name, python(TALKER))).child.pid for name in ("a", "b")])
            started.set()
            await group.run_while_alive(for_ever())

    task = asyncio.create_task(run())
    await started.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not any(psutil.pid_exists(pid) for pid in pids)


async def test_stop_last_programs_are_stopped_last(tmp_path: Path) -> None:
    ended: list[str] = []
    leaving = (
        "import signal, time\nsignal.signal(signal.SIGTERM, lambda *_: exit())\nprint('up')\ntime.sleep(600)"
    )
    async with ProgramGroup(tmp_path, ignore) as group:
        for name, stop_last in (("network", True), ("core", True), ("node", False)):
            program = await group.start(name, python(leaving), stop_last=stop_last)
            await group.wait_line(program, "up", 20)
            stop = program.keeper.stop

            async def noted(
                name: str = name, stop: Callable[..., Awaitable[None]] = stop, **options: float
            ) -> None:
                await stop(**options)
                ended.append(name)

            program.keeper.stop = noted  # type: ignore[method-assign]  # to see when it is called
    assert ended == ["node", "core", "network"]
