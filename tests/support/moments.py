"""Ends ``rce up`` at random moments by random signals, its parts killed before or not: nothing may be left.

``make moments`` (``python -m support.moments SEED COUNT``) does it as often as is asked.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import shutil
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

import aiohttp

from rce_container.environment import proc
from support.engine import Program, until
from support.ports import free_ports
from support.short_folders import make_folder
from support.stranger import ask_for_echo, stranger
from tools.leaks import Traces, sweep_cgroups

PORT_OPTIONS = ("--http-port", "--control-port", "--ws-port", "--robot-link-port", "--container-link-port")
PROGRAMS = ("rce_master", "rce_robot", "rce_container")
AT_ONCE = (signal.SIGKILL, signal.SIGQUIT)
"""Signals that end ``rce up`` at once: what it leaves is removed after it."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, *AT_ONCE)
BOXES = 2
LONGEST_PAUSE_S = 3.0
"""Longer than ``rce-container`` takes from its death until it is ready again."""
LONGEST_START_S = 4.0
GONE_AFTER_S = 90.0
"""Within this time all is gone after SIGKILL, also on a busy machine."""


@dataclass(frozen=True)
class Moment:
    """When and how an engine ends.

    Attributes:
        containers: Whether it has some by then; else it may still be starting.
        killed: Its programs that are killed before.
        pause: Seconds from that, or from its start, until the signal.
        signals: What is sent to ``rce up``, one right after the other.
    """

    containers: bool
    killed: tuple[str, ...]
    pause: float
    signals: tuple[signal.Signals, ...]

    @classmethod
    def by_chance(cls, dice: random.Random) -> Moment:
        """Choose one; most often ``rce-container`` has just died."""
        containers = dice.random() < 0.75
        killed = tuple(name for name in PROGRAMS if dice.random() < (0.7 if name == PROGRAMS[-1] else 0.2))
        signals = [dice.choice(SIGNALS)]
        if signals[0] not in AT_ONCE and dice.random() < 0.3:
            signals.append(dice.choice(SIGNALS))
        longest = LONGEST_PAUSE_S if containers else LONGEST_START_S
        return cls(containers, killed if containers else (), dice.uniform(0, longest), tuple(signals))


async def run(moment: Moment, runtime: str) -> list[str]:
    """Start an engine, end it at a moment, and return what is left of it."""
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)  # jobs in the background of a shell ignore it
    folder = make_folder()
    try:
        return await _run(moment, runtime, folder)
    finally:
        traces = Traces(folder)
        for process in traces.look():
            proc.kill(process)
        sweep_cgroups(folder)
        shutil.rmtree(folder, ignore_errors=True)


async def _run(moment: Moment, runtime: str, folder: Path) -> list[str]:
    env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    ports = free_ports(len(PORT_OPTIONS))
    options = [text for pair in zip(PORT_OPTIONS, map(str, ports), strict=True) for text in pair]
    argv = [str(Path(sys.executable).parent / "rce"), "up", "--dev", "--state-dir", str(folder / "state")]
    up = Program(
        "up", [*argv, *options, "--runtime", runtime], env | {"XDG_RUNTIME_DIR": str(folder)}, folder
    )
    traces = Traces(folder)
    await up.start(ready="RCE ready" if moment.containers else "", timeout=GONE_AFTER_S)
    assert up.process is not None
    async with contextlib.AsyncExitStack() as stack:
        if moment.containers:
            client = await stack.enter_async_context(stranger(f"http://127.0.0.1:{ports[0]}/"))
            stack.push_async_callback(client.socket.close)
            for number in range(BOXES):
                await ask_for_echo(client, f"box{number}", "testRobot")
            await until(lambda: _containers(folder), timeout=GONE_AFTER_S, what="containers are made")
            traces.look()
        for name in moment.killed:
            _kill(traces, name)
        await asyncio.sleep(moment.pause)
        traces.look()
        for number in moment.signals:
            with contextlib.suppress(ProcessLookupError):
                up.process.send_signal(number)
        async with asyncio.timeout(GONE_AFTER_S):
            await up.process.wait()
    if not {*AT_ONCE}.isdisjoint(moment.signals) or all(map(_is_dying, _left(traces, folder))):
        with contextlib.suppress(AssertionError):
            await until(lambda: not _left(traces, folder), timeout=GONE_AFTER_S, what="nothing is left")
    return _left(traces, folder) and [*_left(traces, folder), up.output()]


def _left(traces: Traces, folder: Path) -> list[str]:
    sockets = [f"socket {path}" for path in (folder / "rce").rglob("*") if path.is_socket()]
    return [*traces.left(), *sockets]


def _is_dying(line: str) -> bool:
    """Whether this is a process that was killed and has no program any more, only its exit to go through."""
    return line.startswith("process ") and len(line.split()) == len(("process", "pid"))


def _containers(folder: Path) -> list[Path]:
    return list((folder / "state" / "container" / "containers").glob("*/record.json"))


def _kill(traces: Traces, name: str) -> None:
    found = False
    for process in traces.look():
        with contextlib.suppress(OSError):
            words = Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")
            if words[1:4] == [b"-P", b"-m", name.encode()] and b"--end" not in words:
                os.kill(process.pid, signal.SIGKILL)
                found = True
    assert found, f"{name} does not run"


async def main(seed: int, count: int) -> int:
    """Go through moments; returns how many left something."""
    # What a shell's background jobs and nohup ignore, their programs would ignore, too.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    dice = random.Random(seed)
    bad = 0
    for number in range(count):
        moment, runtime = Moment.by_chance(dice), dice.choice(("namespace", "namespace", "process"))
        try:
            left = await run(moment, runtime)
        except (AssertionError, TimeoutError, OSError, aiohttp.ClientError) as error:
            left = [f"{type(error).__name__}: {error}"]
        bad += bool(left)
        print(number, runtime, moment, "LEFT:" if left else "nothing left", *left, sep="\n  ", flush=True)  # noqa: T201
    print(f"{bad} of {count} left something")  # noqa: T201
    return bad


if __name__ == "__main__":
    sys.exit(bool(asyncio.run(main(int(sys.argv[1]), int(sys.argv[2])))))
