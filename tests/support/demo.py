"""``rce demo`` as a process, as a user runs it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import psutil

from rce_fleet.demo.resources import Ports, option_of
from support.engine import command_line, engine_processes, until
from support.ports import free_ports
from support.processes import finish
from support.short_folders import make_folder
from tools.leaks import sweep_cgroups

STOP_TIMEOUT_S = 120.0
LIGHT = ("--full-stack", 0)
"""Options of a demo with robots that need little CPU, for a test of something else."""


def environment(folder: Path) -> dict[str, str]:
    """An environment in which nothing of a demo lands outside of ``folder``."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    return {**kept, "PYTHONUNBUFFERED": "1", "XDG_RUNTIME_DIR": str(folder), "TMPDIR": str(folder)}


@contextlib.contextmanager
def clean_folder() -> Iterator[Path]:
    """A short-named folder; at the end no process of a demo in it may be left, and no file."""
    folder = make_folder()
    try:
        yield folder
        left = engine_processes(folder)
        for process in left:
            with contextlib.suppress(Exception):
                process.kill()
        assert not left, f"processes left behind: {left}"
        files = [path for path in folder.iterdir() if path.name != "rce"]
        assert not files, f"files left behind: {files}"
    finally:
        sweep_cgroups(folder)
        shutil.rmtree(folder, ignore_errors=True)


def port_options() -> tuple[Ports, list[str]]:
    """Choose ports that no other test uses, and the options that say so."""
    ports = Ports(*free_ports(len(fields(Ports))))
    names = ("page", "http", "control", "ws", "robot_link", "container_link")
    return ports, [word for name in names for word in (option_of(name), str(getattr(ports, name)))]


async def run_headless(*options: object, timeout: float) -> tuple[int, dict[str, Any], str]:
    """Run ``rce demo --headless``; returns exit code, report and what it printed."""
    with clean_folder() as folder:
        report = folder / "report.json"
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rce_fleet.demo", "--headless", *port_options()[1]),
            *(*map(str, options), "--report", str(report), "--timeout", str(timeout)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=environment(folder),
        )
        try:
            output, _ = await asyncio.wait_for(process.communicate(), timeout + STOP_TIMEOUT_S)
        finally:
            await finish(process)
        text = output.decode()
        found = json.loads(report.read_text()) if report.exists() else {}
        report.unlink(missing_ok=True)
        assert process.returncode is not None
        return process.returncode, found, text


@dataclass(slots=True)
class Demo:
    """A demo with a page."""

    process: asyncio.subprocess.Process
    ports: Ports
    folder: Path
    log: Path

    @property
    def page(self) -> str:
        return f"http://127.0.0.1:{self.ports.page}/"

    def output(self) -> str:
        return self.log.read_text(errors="replace")

    async def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        """Ctrl-C, and wait."""
        self.process.send_signal(number)
        return await asyncio.wait_for(self.process.wait(), STOP_TIMEOUT_S)


@contextlib.asynccontextmanager
async def running_demo(
    *options: object, stdin: int = asyncio.subprocess.DEVNULL, start_timeout: float = 120.0
) -> AsyncIterator[Demo]:
    """Run a demo with a page; at the end it is stopped and must leave nothing.

    Args:
        options: Of ``rce demo``.
        stdin: Its standard input.
        start_timeout: Seconds until it must say where its page is.
    """
    with clean_folder() as folder:
        ports, given = port_options()
        log = Path(tempfile.mktemp(prefix="rce-demo-log-", dir="/tmp"))
        with log.open("wb") as output:
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "rce_fleet.demo"),
                *given,
                *map(str, options),
                stdin=stdin,
                stdout=output,
                stderr=output,
                env=environment(folder),
            )
        demo = Demo(process, ports, folder, log)
        try:
            await until(
                lambda: process.returncode is not None or f"RCE demo: {demo.page}" in demo.output(),
                timeout=start_timeout,
                what="the demo says where its page is",
            )
            assert process.returncode is None, demo.output()
            yield demo
            if process.returncode is None:
                assert await demo.stop() == 0, demo.output()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
            log.unlink()


def kill_program(demo: int, *words: str) -> None:
    """Kill the one program of a demo whose command line holds all words.

    Args:
        demo: The demo's pid.
        words: Parts of the command line.
    """
    found = [
        child
        for child in psutil.Process(demo).children()
        if all(word in " ".join(command_line(child)) for word in words)
    ]
    assert len(found) == 1, words
    found[0].kill()
