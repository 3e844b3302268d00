"""``rce up --replicas 3``: the leading master is killed under a robot that talks to its container."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import aiohttp
import pytest
from support.engine import Program, command_line, engine_processes, until
from support.ports import free_port, free_ports, free_row
from support.stranger import check_echo, stranger, wire_echo

pytestmark = [pytest.mark.e2e, pytest.mark.needs("etcd")]

COUNT = 3
TASK_SETS = 2


@contextlib.asynccontextmanager
async def replicas(folder: Path, http: int) -> AsyncIterator[Program]:
    (folder / "state" / "etcd").mkdir(parents=True)
    (folder / "state" / "etcd" / "ports.json").write_text(json.dumps(free_ports(2 * COUNT)))
    ports = {"http": http, "control": free_row(COUNT), "ws": free_port()}
    ports |= {"robot-link": free_port(), "container-link": free_port()}
    env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    argv = [
        *(str(Path(sys.executable).parent / "rce"), "up", "--dev", "--runtime", "process"),
        *("--replicas", str(COUNT), "--state-dir", str(folder / "state")),
        *(word for name, port in ports.items() for word in (f"--{name}-port", str(port))),
    ]
    up = Program("up", argv, env | {"XDG_RUNTIME_DIR": str(folder)}, folder)
    try:
        yield up
    finally:
        if up.running:
            await up.stop()


def master_at(folder: Path, port: int) -> int | None:
    """Return the process of the master that listens on a port."""
    for process in engine_processes(folder):
        words = command_line(process)
        if words[1:4] == ["-P", "-m", "rce_master"] and f'"http_port": {port}' in " ".join(words):
            return process.pid
    return None


async def leader(http: int, *, after: int = 0) -> tuple[int, int] | None:
    """Return port and term of the master that leads after a term, once both task sets are there."""
    async with aiohttp.ClientSession() as session:
        for port in range(http, http + COUNT):
            with contextlib.suppress(aiohttp.ClientError, TimeoutError):
                async with session.get(f"http://127.0.0.1:{port}/healthz") as reply:
                    told = await reply.json()
                if told["role"] == "leader" and told["task_sets"] == TASK_SETS and told["term"] > after:
                    return port, told["term"]
    return None


async def test_a_robot_talks_on_and_another_one_logs_in(folder: Path) -> None:
    http = free_row(COUNT)
    async with replicas(folder, http) as up:
        urls = ",".join(f"http://127.0.0.1:{port}/" for port in range(http, http + COUNT))
        await up.start(ready=f"RCE ready: {urls}")
        first, term = await until(lambda: leader(http), what="a master leads")
        async with stranger(f"http://127.0.0.1:{first}/") as robot:
            await wire_echo(robot)
            await check_echo(robot, "before")
            pid = master_at(folder, first)
            assert pid is not None
            os.kill(pid, signal.SIGKILL)
            await check_echo(robot, "without a master")
            # It may be the same master: it was started again before its lease ended.
            second, _ = await until(lambda: leader(http, after=term), what="a master leads in a new term")
            async with stranger(f"http://127.0.0.1:{second}/", robot="second") as other:
                await other.send("CC", {"containerTag": "other"})
                await check_echo(robot, "after")
            assert all(state for _, state in robot.statuses), "an interface became inactive"
        assert await up.stop() == 0
    assert "ended with exit code -9; starting it again" in up.output()
