"""Programs are started in order, restarted when they die, and end whole."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import psutil
import pytest
from support.engine import until

from rce.supervision.final import FinalCommand
from rce.supervision.plan import Program
from rce.supervision.process import Child
from rce.supervision.supervisor import StartError, Supervisor, _end

READY = "import time; print('x ready: now', flush=True); time.sleep(1000)"


def python(name: str, code: str) -> Program:
    return Program(name, [sys.executable, "-c", code])


async def run_until(supervisor: Supervisor, done: asyncio.Event) -> None:
    ready = asyncio.Event()
    task = asyncio.create_task(supervisor.run(ready.set))
    await ready.wait()
    await done.wait()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_restarts_a_program_that_died() -> None:
    lines: list[str] = []
    restarted = asyncio.Event()
    starts = 0

    def show(line: str) -> None:
        nonlocal starts
        lines.append(line)
        if line.startswith("[a] pid"):
            starts += 1
            if starts == 1:
                os.kill(int(line.split()[2]), signal.SIGKILL)
            else:
                restarted.set()

    code = (
        "import os, time; print('a ready: yes', flush=True);"
        "print('pid', os.getpid(), flush=True); time.sleep(1000)"
    )
    async with asyncio.timeout(60):
        await run_until(Supervisor([python("a", code)], show), restarted)
    assert any("ended with exit code -9" in line for line in lines)


async def test_a_program_that_never_gets_ready_fails_the_start() -> None:
    supervisor = Supervisor([python("good", READY), python("bad", "raise SystemExit(3)")], print)
    with pytest.raises(ExceptionGroup) as caught:
        await supervisor.run(lambda: pytest.fail("it is not ready"))
    assert caught.group_contains(StartError, match="bad ended with exit code 3")


async def test_stop_kills_what_ignores_sigterm() -> None:
    code = (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
        "print('ready: x', flush=True); time.sleep(1000)"
    )
    child = await Child.start("stubborn", [sys.executable, "-c", code])
    assert [line async for line in _first(child)] == ["ready: x"]
    await child.stop(timeout=0.2)
    assert child.returncode == -signal.SIGKILL
    assert [line async for line in child.lines()] == []


async def _first(child: Child) -> AsyncIterator[str]:
    async for line in child.lines():
        yield line
        return


async def test_children_end_with_a_supervisor_that_is_killed(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    code = f"""
import asyncio, sys
from rce.supervision.final import FinalCommand
from rce.supervision.process import Child
async def main():
    child = await Child.start("c", [sys.executable, "-c", "import time; time.sleep(1000)"])
    open({str(pid_file)!r}, "w").write(str(child.pid))
    print("ready: x", flush=True)
    await asyncio.sleep(1000)
asyncio.run(main())
"""
    supervisor = await Child.start("supervisor", [sys.executable, "-c", code])
    async for _ in supervisor.lines():
        break
    child = psutil.Process(int(pid_file.read_text()))
    os.kill(supervisor.pid, signal.SIGKILL)
    await supervisor.wait()
    async with asyncio.timeout(60):
        while child.is_running() and child.status() != psutil.STATUS_ZOMBIE:
            await asyncio.sleep(0.02)
    await supervisor.stop()


async def test_output_that_cannot_be_shown_is_lost(tmp_path: Path) -> None:
    """On a full disk the programs print on, and it is seen that they are ready."""
    printed, second = tmp_path / "printed", tmp_path / "second"
    flood = (
        "import pathlib, time; print('x ready: y', flush=True)\n"
        "for _ in range(50_000): print('x' * 99)\n"
        f"pathlib.Path({str(printed)!r}).touch(); time.sleep(1000)"
    )
    after = f"import pathlib; pathlib.Path({str(second)!r}).touch(); {READY}"
    programs = [("a", [sys.executable, "-c", flood]), ("b", [sys.executable, "-c", after])]
    code = f"""
import asyncio
from rce.supervision.__main__ import run
from rce.supervision.plan import Plan, Program
programs = tuple(Program(*words) for words in {programs!r})
asyncio.run(run(Plan(programs=programs, ready=("all",)), {{}}))
"""
    with Path("/dev/full").open("w") as full:
        supervisor = await asyncio.create_subprocess_exec(sys.executable, "-c", code, stdout=full)
    try:
        async with asyncio.timeout(60):
            while not (printed.exists() and second.exists()):
                assert supervisor.returncode is None
                await asyncio.sleep(0.02)
    finally:
        with contextlib.suppress(ProcessLookupError):
            supervisor.terminate()
        await supervisor.wait()


async def test_what_a_killed_program_leaves_is_removed_at_the_end(tmp_path: Path) -> None:
    note, killed = tmp_path / "note", asyncio.Event()

    def show(line: str) -> None:
        if line.startswith("[a] pid"):
            os.kill(int(line.split()[2]), signal.SIGKILL)
        killed.set() if "exit code -9" in line else None

    code = (
        "import os, time; print('x ready: y', flush=True);"
        "print('pid', os.getpid(), flush=True); time.sleep(1000)"
    )
    program = Program("a", [sys.executable, "-c", code], final=["sh", "-c", f"echo once >> {note}"])
    async with asyncio.timeout(60):
        await run_until(Supervisor([program], show), killed)
    assert note.read_text() == "once\n"


async def test_leftovers_of_killed_program_are_removed(tmp_path: Path) -> None:
    """One program's command also removes what is left of another one that ends before it has begun."""
    note, gone = tmp_path / "note", asyncio.Event()
    proper = (
        "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: sys.exit());"
        "print('x ready: y', flush=True); time.sleep(1000)"
    )
    first = Program("killed", [sys.executable, "-c", READY])
    second = Program("proper", [sys.executable, "-c", proper], final=["sh", "-c", f"echo once >> {note}"])
    async with asyncio.timeout(60):
        gone.set()
        await run_until(Supervisor([first, second], print), gone)
    assert note.read_text() == "once\n"


async def test_a_program_that_ended_properly_needs_no_more(tmp_path: Path) -> None:
    note, done = tmp_path / "note", asyncio.Event()
    code = (
        "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: sys.exit());"
        "print('x ready: y', flush=True); time.sleep(1000)"
    )
    program = Program("a", [sys.executable, "-c", code], final=["touch", str(note)])
    async with asyncio.timeout(60):
        done.set()
        await run_until(Supervisor([program], print), done)
    assert not note.exists()


async def test_a_second_cancellation_does_not_cut_the_end_short(tmp_path: Path) -> None:
    note, ending = tmp_path / "note", asyncio.Event()
    code = (
        "import pathlib, signal, sys, time\n"
        "def end(*_):\n"
        f"    print('ending', flush=True); time.sleep(1); pathlib.Path({str(note)!r}).touch(); sys.exit()\n"
        "signal.signal(signal.SIGTERM, end); print('x ready: y', flush=True); time.sleep(1000)"
    )
    ready = asyncio.Event()
    supervisor = Supervisor([python("a", code)], lambda line: ending.set() if "ending" in line else None)
    task = asyncio.create_task(supervisor.run(ready.set))
    async with asyncio.timeout(60):
        await ready.wait()
        task.cancel()
        await ending.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
    assert note.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGKILL])
async def test_a_final_command_runs_however_its_process_ends(tmp_path: Path, number: signal.Signals) -> None:
    note = tmp_path / "note"
    code = f"""
import asyncio
from rce.supervision.final import FinalCommand
async def main():
    await FinalCommand.arm(["touch", {str(note)!r}])
    print("ready: x", flush=True)
    await asyncio.sleep(1000)
asyncio.run(main())
"""
    child = await Child.start("c", [sys.executable, "-c", code])
    assert [line async for line in _first(child)] == ["ready: x"]
    os.kill(child.pid, number)
    await child.wait()
    async with asyncio.timeout(60):
        while not note.exists():
            await asyncio.sleep(0.02)
    await child.stop()


def _is_dead(process: psutil.Process) -> bool:
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


async def test_final_command_runs_after_its_waiter_was_killed(tmp_path: Path) -> None:
    """A final command runs though what waits for it was killed."""
    others = set(psutil.Process().children())
    final = await FinalCommand.arm(["touch", str(tmp_path / "note")])
    (shell,) = set(psutil.Process().children()) - others
    shell.kill()
    # Not waited for: that would take its exit code from the event loop.
    await until(lambda: _is_dead(shell), what="the shell is dead")
    async with asyncio.timeout(60):
        assert await final.run() == 0
    assert (tmp_path / "note").exists()


async def test_a_program_in_whose_pause_the_end_begins_is_ended() -> None:
    """The pause has just ended, and the program is about to be started again."""
    ending: list[asyncio.Task[None]] = []

    async def keep() -> None:
        task = asyncio.current_task()
        assert task is not None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0):
                ending.append(asyncio.create_task(_end([task])))
                await asyncio.Event().wait()
        await asyncio.Event().wait()

    kept = asyncio.create_task(keep())
    await asyncio.wait([kept], timeout=60)
    assert kept.cancelled()
    await ending[0]
