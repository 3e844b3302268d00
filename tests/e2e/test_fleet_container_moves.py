"""The container of the fleet moves between machines: no accepted task is lost, and none runs twice.

If its machine is lost, it continues elsewhere with the tasks of its newest snapshot.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import psutil
import pytest
from support.demo import Demo, environment, running_demo
from support.engine import Program, engine_processes, until
from support.ports import free_port

from rce_fleet.wiring import FLEET_CONTAINER, VOLUME

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.real_time("machines"),
    pytest.mark.needs("pymunk"),
    pytest.mark.timeout(600),
]

LONGEST_S = 240.0
AGAIN_S = 0.3
REPEATABLE = (429, 503, 507)
SECOND = "second"


class Api:
    """Requests to the station or to the master, sent again while nothing can be reached."""

    def __init__(self, session: aiohttp.ClientSession) -> None:
        self._session = session

    async def ask(self, method: str, path: str, body: Any = None, **headers: str) -> Any:
        given = {name.replace("_", "-"): text for name, text in headers.items()}
        async with asyncio.timeout(LONGEST_S):
            while True:
                async with self._session.request(method, f"/api/v1{path}", json=body, headers=given) as reply:
                    if reply.status not in REPEATABLE:
                        assert reply.status < 300, await reply.text()
                        return await reply.json() if reply.status not in (202, 204) else None
                await asyncio.sleep(AGAIN_S)


@asynccontextmanager
async def second_machine(demo: Demo, folder: Path) -> AsyncIterator[Program]:
    """Run a second machine for containers of the demo's engine; the test may lose it."""
    argv = [
        *(str(Path(sys.executable).parent / "rce-container"), "127.0.0.1", "--dev", "--machine", SECOND),
        *("--control-port", str(demo.ports.control), "--link-port", str(free_port())),
        *("--state-dir", str(folder / SECOND)),
    ]
    program = Program(SECOND, argv, environment(demo.folder), folder)
    await program.start()
    try:
        yield program
    finally:
        if program.running:
            assert await program.stop() == 0, program.output()


async def lose(machine: Program, folder: Path) -> None:
    """Kill -9 a container task set and all that it started, as when its machine is switched off."""
    found = engine_processes(folder)
    await machine.kill()
    for process in found:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()


@asynccontextmanager
async def master_api(demo: Demo) -> AsyncIterator[Api]:
    """Requests of the demo's user to the engine's master."""
    url = f"http://127.0.0.1:{demo.ports.http}"
    async with aiohttp.ClientSession(url) as session:
        login = {"userID": "testUser", "password": "testUser"}
        token = (await Api(session).ask("POST", "/login", login))["token"]
        session.headers["Authorization"] = f"Bearer {token}"
        yield Api(session)


async def free_cells(station: Api) -> list[int]:
    """Wait until all robots are there; return free cells."""

    async def are_idle() -> list[dict[str, Any]] | None:
        robots = (await station.ask("GET", "/robots"))["robots"]
        return robots if len(robots) == 3 and all(robot["state"] == "idle" for robot in robots) else None

    robots = await until(are_idle, timeout=LONGEST_S, what="all robots are idle")
    floor = await station.ask("GET", "/map")
    taken = {*floor["walls"], *floor["blocked"], *(robot["cell"] for robot in robots)}
    return [cell for cell in range(floor["rows"] * floor["columns"]) if cell not in taken]


async def is_at(master: Api, machine: str) -> None:
    """Wait until the fleet's container runs at a machine."""

    async def runs() -> bool:
        found = (await master.ask("GET", "/containers"))["containers"]
        fleet = next(one for one in found if one["tag"] == FLEET_CONTAINER)
        return (fleet["state"], fleet["machine"], fleet["moving_to"]) == ("running", machine, "")

    await until(runs, timeout=LONGEST_S, what=f"the fleet's container runs at {machine}")


async def test_the_fleet_moves_and_loses_no_task(tmp_path: Path) -> None:
    async with (
        running_demo("--robots", 3, "--full-stack", 0, "--no-auto", "--seed", 2) as demo,
        second_machine(demo, tmp_path),
        aiohttp.ClientSession(demo.page, timeout=aiohttp.ClientTimeout(total=LONGEST_S)) as session,
        master_api(demo) as master,
    ):
        station = Api(session)
        cells = await free_cells(station)
        machines = (await master.ask("GET", "/machines"))["machines"]
        (first,) = {one["machine"] for one in machines if one["kind"] == "container"} - {SECOND}
        tasks: list[str] = []

        async def create(count: int) -> None:
            for _ in range(count):
                number = len(tasks)
                stops = [{"action": "go", "cell": cells[(7 * number) % len(cells)]}]
                task = await station.ask(
                    "POST", "/tasks", {"stops": stops}, Idempotency_Key=f"order-{number}"
                )
                tasks.append(task["id"])

        await create(4)
        await master.ask("PUT", f"/containers/{FLEET_CONTAINER}/machine", {"machine": SECOND})
        await create(3)
        await is_at(master, SECOND)
        await create(2)
        await master.ask("PUT", f"/machines/{SECOND}/drain")
        await create(3)
        await is_at(master, first)

        async def are_done() -> bool:
            shown = [await station.ask("GET", f"/tasks/{task}") for task in tasks]
            assert not [one for one in shown if one["state"] in ("failed", "cancelled")]
            return all(one["state"] == "done" for one in shown)

        await until(are_done, timeout=LONGEST_S, what="all tasks are done")
        events: list[dict[str, Any]] = []
        while page := (await station.ask("GET", f"/events?after={len(events)}"))["events"]:
            events += page
        assert [event["number"] for event in events] == list(range(1, len(events) + 1)), "no event is missing"
        names = [(event["id"], event["name"]) for event in events]
        for task in tasks:
            assert [names.count((task, name)) for name in ("created", "arrived", "finished")] == [1, 1, 1]


async def test_tasks_of_a_snapshot_outlive_the_machine(tmp_path: Path) -> None:
    async with (
        running_demo("--robots", 3, "--full-stack", 0, "--no-auto", "--seed", 2) as demo,
        second_machine(demo, tmp_path) as second,
        aiohttp.ClientSession(demo.page, timeout=aiohttp.ClientTimeout(total=LONGEST_S)) as session,
        master_api(demo) as master,
    ):
        station = Api(session)
        cells = await free_cells(station)
        await master.ask("PUT", f"/containers/{FLEET_CONTAINER}/machine", {"machine": SECOND})
        await is_at(master, SECOND)
        tasks = []
        for number in range(6):
            stops = [{"action": "go", "cell": cells[(7 * number) % len(cells)]}]
            order = await station.ask("POST", "/tasks", {"stops": stops}, Idempotency_Key=f"order-{number}")
            tasks.append(order["id"])
        # The time of a snapshot is that of its end: the one that ends next may have begun before the tasks.
        await is_saved(master, after=await is_saved(master, after=time.time()))
        await lose(second, tmp_path / SECOND)
        machines = (await master.ask("GET", "/machines"))["machines"]
        (first,) = {one["machine"] for one in machines if one["kind"] == "container"} - {SECOND}
        await is_at(master, first)

        async def are_done() -> bool:
            shown = [await station.ask("GET", f"/tasks/{task}") for task in tasks]
            return all(one["state"] == "done" for one in shown)

        await until(are_done, timeout=LONGEST_S, what="all tasks are known there, and are done")


async def is_saved(master: Api, *, after: float) -> float:
    """Wait for a snapshot of the journal's volume after a time; return when it was taken."""

    async def newest() -> float:
        found = (await master.ask("GET", "/volumes"))["volumes"]
        (volume,) = (one for one in found if one["name"] == VOLUME["name"])
        assert not volume["fault"]
        taken = float(volume["snapshot"] or 0.0)
        return taken if taken > after else 0.0

    return await until(newest, timeout=LONGEST_S, what="the journal's volume is saved")
