"""Programs whose robotID or node name another program has already say so."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support.engine import Program, running_engine, until

from rce.ros.core import Core
from rce.ros.xmlrpc import RpcClient

BIN = Path(sys.executable).parent
STATION = {
    "userID": "testUser",
    "password": "testUser",
    "robotID": "operator",
    "containers": [{"cTag": "fleet"}],
}

pytestmark = [pytest.mark.e2e, pytest.mark.needs("pymunk")]


@contextlib.asynccontextmanager
async def station(folder: Path, name: str, *words: str) -> AsyncIterator[Program]:
    """``rce ui``, which may or may not get ready."""
    argv = [str(BIN / "rce"), "ui", *words, "--port", "0", "--state-dir", str(folder / name)]
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    program = Program(name, argv, kept, folder)
    await program.start(ready="")
    try:
        yield program
    finally:
        if program.running:
            await program.stop()


async def says(program: Program, text: str) -> None:
    await until(lambda: text in program.output(), what=f"{program.name} says {text!r}: {program.output()}")


async def ends_with(program: Program, text: str) -> None:
    """Wait until a program ends, and look whether its words are one line."""
    assert program.process is not None
    await until(lambda: not program.running, what=f"{program.name} ends: {program.output()}")
    assert program.process.returncode == 1
    line = program.output().splitlines()[-1]
    assert line.startswith("rce ui: ")
    assert text in line
    assert "Traceback" not in program.output()


async def test_station_whose_robot_id_is_in_use_says_so(tmp_path: Path) -> None:
    async with running_engine() as engine:
        file = tmp_path / "fleet.config"
        file.write_text(json.dumps(STATION | {"url": engine.url}))
        async with station(tmp_path, "first", str(file)):
            await until(lambda: engine.get("/api/v1/robots")["robots"], what="the first is connected")
            async with station(tmp_path, "second", str(file)) as second:
                await says(second, "the robotID is in use; waiting until it is free")
                await says(second, "connected already, from 127.0.0.1")


async def test_station_that_is_refused_ends_with_one_line(tmp_path: Path) -> None:
    async with running_engine() as engine:
        file = tmp_path / "fleet.config"
        file.write_text(json.dumps(STATION | {"url": engine.url, "password": "wrong"}))
        async with station(tmp_path, "wrong", str(file)) as program:
            await ends_with(program, "refused (401)")


async def test_station_whose_node_name_is_taken_ends(tmp_path: Path) -> None:
    """A graph tells the older of two nodes of one name to stop; it would show nothing new any more."""
    async with (
        Core(host="127.0.0.1", port=0) as core,
        station(tmp_path, "older", "--ros-master", core.uri) as older,
    ):
        await until(lambda: core_knows(core, "/operator_station"), what="the older one is in the graph")
        async with station(tmp_path, "newer", "--ros-master", core.uri) as newer:
            await ends_with(older, "told /operator_station to stop")
            assert newer.running


async def core_knows(core: Core, name: str) -> bool:
    async with RpcClient() as rpc:
        status, _, _ = await rpc.call(core.uri, "lookupNode", ("/test", name))
    return bool(status == 1)
