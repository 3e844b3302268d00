"""The engine's secret is changed while everything runs, and nothing ends for it."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest
from support.engine import Engine, until
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from rce.config.secret import new_secret, read_secret
from rce_client.connection import Connection, State

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(300)]


async def rce(engine: Engine, *args: str) -> None:
    process = await asyncio.create_subprocess_exec(
        str(Path(sys.executable).parent / "rce"), *args, env=engine.env, stdout=asyncio.subprocess.DEVNULL
    )
    assert await process.wait() == 0


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


async def test_secret_changes_while_everything_runs(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    old = new_secret(file).reveal()
    engine = Engine(tmp_path)
    del engine.env["RCE_SECRET"]
    engine.env["RCE_SECRET_FILE"] = str(file)
    control = f"ws://127.0.0.1:{engine.control_port}"
    states: list[State] = []

    async def containers() -> list[str]:
        found = await asyncio.to_thread(engine.get, "/api/v1/containers")
        return [each["state"] for each in found["containers"]]

    async def machines_are_back() -> bool:
        found = await asyncio.to_thread(engine.get, "/api/v1/machines")
        return all(each["connected"] for each in found["machines"]) and len(found["machines"]) == 2

    try:
        await engine.start()
        async with Connection(
            engine.url, "testUser", "testUser", "R1", on_state=lambda state, _: states.append(state)
        ) as robot:
            await robot.create_container("c1")

            async def runs() -> bool:
                return await containers() == ["running"]

            await until(runs, timeout=60, what="the container runs")
            before = {each.pid for each in engine.processes_of("rce_container")}
            await rce(engine, "secret", "rotate", str(file))
            new = read_secret(file).reveal()
            for secret in (old, new):
                async with connect(control, additional_headers=bearer(secret), proxy=None):
                    pass
            async with connect(control, additional_headers=bearer(old), proxy=None) as former:
                await rce(engine, "secret", "retire", str(file))
                async with asyncio.timeout(60):
                    with pytest.raises(ConnectionClosed, match=r"show the new one|no Hello"):
                        await former.recv()
            with pytest.raises(InvalidStatus, match="401"):
                await connect(control, additional_headers=bearer(old), proxy=None)

            def dialed_again() -> bool:
                logs = [program.output() for program in (*engine.robots, engine.container)]
                return all(text.count("connected to master") >= 2 for text in logs)

            await until(dialed_again, timeout=60, what="both task sets showed the new secret")
            await until(machines_are_back, timeout=60, what="both task sets are back")
            await robot.create_container("c2")

            async def both_run() -> bool:
                return await containers() == ["running", "running"]

            await until(both_run, timeout=60, what="the second container runs")
            assert before <= {each.pid for each in engine.processes_of("rce_container")}
            assert State.LOST not in states, "the robot noticed"
            await robot.destroy_container("c1")
            await robot.destroy_container("c2")
    finally:
        await engine.stop()
