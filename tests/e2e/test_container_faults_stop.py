"""Programs that are told to end at an awkward moment leave nothing."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.engine import Program, running_engine, until
from support.ports import free_ports
from support.short_folders import make_folder
from support.stranger import ask_for_echo, stranger

from rce_container.environment.logs.streams import letters_of, text_of
from tools.leaks import Traces, sweep_cgroups

pytestmark = [pytest.mark.e2e]

PORT_OPTIONS = ("--http-port", "--control-port", "--ws-port", "--robot-link-port", "--container-link-port")
MASTER_RUNS = ""
"""Before anything of it has said that it is ready."""
STUBBORN = """#!/usr/bin/env python3
import signal, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: print("no", number, flush=True))
print("ready", flush=True)
while True:
    time.sleep(1)
"""


@pytest.fixture
def folder() -> Iterator[Path]:
    path = make_folder()
    path.chmod(0o755)
    yield path
    sweep_cgroups(path)
    shutil.rmtree(path)


@pytest.mark.needs("bwrap")
async def test_sigterm_while_containers_start() -> None:
    async with running_engine(runtime="namespace") as engine, stranger(engine.url) as client:
        boxes = [f"box{number}_{engine.http_port}" for number in range(6)]
        traces = Traces(engine.folder, str(engine.http_port))
        for box in boxes:
            await ask_for_echo(client, box, "testRobot")
        await until(lambda: engine.processes_of("rce-container-shim"), what="the first one starts")
        traces.look()
        assert await engine.container.stop() == 0
        assert traces.left({engine.master.pid, engine.robots[0].pid}) == []
        await engine.container.start()
        await until(
            lambda: (
                sum(one["state"] == "running" for one in engine.get("/api/v1/containers")["containers"]) == 6
            ),
            timeout=40,
            what="all are made by the next one",
        )


async def test_a_second_sigterm_waits_for_no_node(folder: Path) -> None:
    nodes = folder / "own" / "nodes"
    nodes.mkdir(parents=True)
    (folder / "own" / "package.yaml").write_text("name: own\n")
    (nodes / "stubborn.py").write_text(STUBBORN)
    (nodes / "stubborn.py").chmod(0o755)
    async with running_engine(runtime="process", packages=folder) as engine, stranger(engine.url) as client:
        box = f"box_{engine.http_port}"
        traces = Traces(engine.folder, box)
        logs = engine.folder / "container" / "logs" / "testUser" / box
        node = {"containerTag": box, "nodeTag": "node", "pkg": "own", "exe": "stubborn.py"}
        await client.send("CC", {"containerTag": box})
        await client.send("CN", {"addNodes": [node]})
        await until(lambda: b"ready" in _text(logs), what="the node runs")
        traces.look()
        os.kill(engine.container.pid, signal.SIGTERM)
        await until(lambda: b"no " in _text(logs), what="the node was told to end")
        assert await engine.container.stop() == 0
        assert _text(logs).count(b"no ") == 1, "its pause was waited for"
        assert traces.left({engine.master.pid, engine.robots[0].pid}) == []
        await client.send("DC", {"containerTag": box})


@pytest.mark.parametrize("runtime", ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))])
async def test_end_of_containers_whose_manager_hangs(runtime: str) -> None:
    """``rce-container --end`` kills the process that keeps the state directory, here a stopped one."""
    async with running_engine(runtime=runtime) as engine, stranger(engine.url) as client:
        box = f"box_{engine.http_port}"
        traces = Traces(engine.folder, box)
        await ask_for_echo(client, box, "testRobot")
        await until(lambda: engine.processes_of("stringEcho.py"), timeout=60, what="the node runs")
        traces.look()
        os.kill(engine.container.pid, signal.SIGSTOP)
        code = (
            "import asyncio, pathlib, sys; from rce_container.ending import end_containers;"
            "from rce_container.settings import ContainerSettings;"
            "settings = ContainerSettings(machine='vm');"
            "asyncio.run(end_containers(settings, pathlib.Path(sys.argv[1]), timeout=0.1))"
        )
        folder = str(engine.folder / "container")
        ender = Program("end", [sys.executable, "-P", "-c", code, folder], engine.env, engine.folder)
        await ender.start(ready="")
        try:
            async with asyncio.timeout(60):
                assert await _code(ender) == 0, ender.output()
                assert await _code(engine.container) == -signal.SIGKILL
        finally:
            if engine.container.running:
                await engine.container.kill()
        assert "is killed" in ender.output()
        assert traces.left({engine.master.pid, engine.robots[0].pid}) == []


async def _code(program: Program) -> int:
    assert program.process is not None
    return await program.process.wait()


def _text(logs: Path) -> bytes:
    raw = b"".join(path.read_bytes() for path in logs.glob("*/node.*.log"))
    return text_of(raw, letters_of(()))  # an unbuffered print comes in pieces


@pytest.mark.parametrize("moment", [MASTER_RUNS, "rce-master ready", "rce-container ready", "RCE ready"])
async def test_ctrl_c_at_any_moment(folder: Path, moment: str) -> None:
    env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    ports = [str(port) for port in free_ports(len(PORT_OPTIONS))]
    options = [word for pair in zip(PORT_OPTIONS, ports, strict=True) for word in pair]
    argv = [str(Path(sys.executable).parent / "rce"), "up", "--dev", "--state-dir", str(folder / "state")]
    up = Program("up", [*argv, *options], {**env, "XDG_RUNTIME_DIR": str(folder)}, folder)
    traces = Traces(folder)
    await up.start(ready=moment)
    if moment == MASTER_RUNS:
        await until(lambda: len(traces.look()) > 1, what="a child of it runs")
    traces.look()
    assert up.process is not None
    up.process.send_signal(signal.SIGINT)
    assert await up.process.wait() in (0, 130, -signal.SIGINT), up.output()
    assert traces.left() == [], up.output()
