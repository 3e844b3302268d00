"""An engine to measure, and a bare echo server to measure beside it."""

from __future__ import annotations

import asyncio
import compileall
import contextlib
import shutil
import socket
import sys
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import psutil

import rce
from rce.supervision.process import Child

BIN = Path(sys.executable).parent


@dataclass(frozen=True)
class RunningEngine:
    """An engine in separate processes."""

    url: str
    folder: Path
    pid: int
    control_port: int

    def processes(self) -> list[psutil.Process]:
        """Every process of the engine: task sets, environments, nodes."""
        found: dict[int, psutil.Process] = {}
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                mine = str(self.folder) in " ".join(process.cmdline())
                if mine or process.environ().get("XDG_RUNTIME_DIR") == str(self.folder):
                    found |= {child.pid: child for child in (process, *process.children(recursive=True))}
        return list(found.values())

    def named(self, needle: str) -> list[psutil.Process]:
        """Its Python processes whose command line holds ``needle``."""
        return [
            p for p in self.processes() if needle in " ".join(words(p)) and "python" in "".join(words(p)[:1])
        ]


def words(process: psutil.Process) -> list[str]:
    """The command line; empty for a process that ended."""
    with contextlib.suppress(psutil.Error):
        return process.cmdline()
    return []


def pss(process: psutil.Process) -> int:
    """Proportional set size in bytes: a page that several processes share counts for each by its part.

    0 for a process that ended or may not be inspected (environments, unless the user is root).
    """
    with contextlib.suppress(psutil.Error):
        return int(process.memory_full_info().pss)
    return 0


class Meter:
    """Measures the processor time of the data path's processes, by kind of process.

    On a machine with other load, this is more accurate than the clock.
    """

    KINDS: ClassVar[dict[str, str]] = {
        "rce-robot": "rce_robot",
        "environment": "rce_container.environment",
        "node": "stringEcho.py",
    }

    def __init__(self, running: RunningEngine) -> None:
        self._processes = {kind: running.named(needle) for kind, needle in self.KINDS.items()}

    def read(self) -> dict[str, float]:
        """Seconds since each kind's processes began."""
        return {kind: sum(map(cpu_seconds, found)) for kind, found in self._processes.items()}

    def per_message(self, before: dict[str, float], messages: int) -> dict[str, float]:
        """Milliseconds per message since ``before`` was read."""
        now = self.read()
        return {f"{kind} cpu_ms": 1e3 * (now[kind] - before[kind]) / messages for kind in now}


def cpu_seconds(process: psutil.Process) -> float:
    """CPU time of a process's main thread, from the scheduler's nanoseconds."""
    with contextlib.suppress(OSError):
        return int(Path(f"/proc/{process.pid}/schedstat").read_text().split()[0]) / 1e9
    return 0.0


def free_ports(count: int) -> list[int]:
    """Return unused TCP ports."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [sock.getsockname()[1] for sock in sockets]


def compile_packages() -> None:
    """Compile the engine's modules that have changed."""
    root = Path(rce.__file__).parents[1]
    for package in ("rce", "rce_client", "rce_container", "rce_master", "rce_robot"):
        compileall.compile_dir(root / package, quiet=2)


@contextlib.asynccontextmanager
async def engine(runtime: str = "auto") -> AsyncIterator[RunningEngine]:
    """Run ``rce up --dev`` on separate ports."""
    # As after an installation: programs that compile their modules take 10 MB more.
    await asyncio.to_thread(compile_packages)
    folder = Path(tempfile.mkdtemp(prefix="rce-bench-", dir="/tmp"))
    names = ("--http-port", "--control-port", "--ws-port", "--robot-link-port", "--container-link-port")
    ports = free_ports(len(names))
    argv = [str(BIN / "rce"), "up", "--dev", "--state-dir", str(folder / "state"), "--runtime", runtime]
    for name, port in zip(names, ports, strict=True):
        argv += [name, str(port)]
    child = await Child.start("rce up", argv, env={"XDG_RUNTIME_DIR": str(folder)})
    log: list[str] = []
    drain: asyncio.Task[None] | None = None
    try:
        async for line in child.lines():
            log.append(line)
            if line.startswith("RCE ready:"):
                break
        else:
            raise RuntimeError("the engine did not start:\n" + "\n".join(log))
        drain = asyncio.create_task(_drain(child))
        yield RunningEngine(f"http://127.0.0.1:{ports[0]}/", folder, child.pid, ports[1])
    finally:
        await child.stop(timeout=60)
        if drain is not None:
            await drain
        shutil.rmtree(folder, ignore_errors=True)


async def _drain(child: Child) -> None:
    async for _ in child.lines():
        pass


BARE_ECHO = """
import asyncio, sys, uvloop
from websockets.asyncio.server import serve
async def echo(ws):
    async for message in ws:
        await ws.send(message)
async def main():
    async with serve(echo, "127.0.0.1", int(sys.argv[1]), compression=None, max_size=None):
        print("ready", flush=True)
        await asyncio.Event().wait()
uvloop.run(main())
"""


@contextlib.asynccontextmanager
async def bare_echo() -> AsyncIterator[str]:
    """Run a bare websockets echo server under uvloop in its own process; yields its URL."""
    (port,) = free_ports(1)
    child = await Child.start("bare echo", [sys.executable, "-c", BARE_ECHO, str(port)])
    try:
        async for _ in child.lines():
            break
        yield f"ws://127.0.0.1:{port}/"
    finally:
        await child.stop()
