"""Programs that tests start themselves, ended whatever they still print."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path

import psutil

from rce.ros.core import Core

EXAMPLES = Path(__file__).parents[2] / "examples" / "ros"
TIMEOUT_S = 60.0


def suspend(pid: int) -> None:
    """Suspend a process by SIGSTOP, and wait until its threads stand: on a busy machine they run on."""
    os.kill(pid, signal.SIGSTOP)
    deadline = time.monotonic() + TIMEOUT_S
    while not all(_is_suspended(thread) for thread in Path(f"/proc/{pid}/task").iterdir()):
        assert time.monotonic() < deadline, f"process {pid} is not suspended"
        time.sleep(0.005)


def _is_suspended(thread: Path) -> bool:
    try:
        state = (thread / "stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:  # it has ended
        return True
    return state in "TtZ"


async def finish(
    process: asyncio.subprocess.Process,
    number: signal.Signals = signal.SIGKILL,
    *,
    timeout: float = TIMEOUT_S,
) -> bytes:
    """End a program and its children, unless they have ended, and return what it still printed.

    asyncio's ``wait()`` returns once the program's pipes are closed, which one that is not read may never be.

    Args:
        process: The program. No other task may read its output.
        number: The signal that ends it.
        timeout: After so many seconds it is killed.

    Raises:
        TimeoutError: It had to be killed.
    """
    children = _children(process.pid) if process.returncode is None else []
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)
    try:
        async with asyncio.timeout(timeout):
            output, _ = await process.communicate()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        _kill(children)  # they may hold its output
        await process.communicate()
        raise
    _kill(children)
    return output or b""


async def run_to_end(*argv: object, env: dict[str, str], text: str = "") -> tuple[int, str]:
    """Run a program to its end, with ``text`` as its input.

    Returns:
        Its exit code and all that it wrote.
    """
    process = await asyncio.create_subprocess_exec(
        *map(str, argv),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env=env,
    )
    output, _ = await process.communicate(text.encode())
    assert process.returncode is not None
    return process.returncode, output.decode()


def _children(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _kill(processes: list[psutil.Process]) -> None:
    for one in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            one.kill()


@contextlib.asynccontextmanager
async def example(core: Core, name: str, *argv: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run an example node; at the end it is interrupted, if it still runs, and must leave cleanly."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        str(EXAMPLES / name),
        *argv,
        env=os.environ | {"ROS_MASTER_URI": core.uri},
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    try:
        yield process
    except BaseException:
        await finish(process)
        raise
    await finish(process, signal.SIGINT)
    assert process.returncode == 0
