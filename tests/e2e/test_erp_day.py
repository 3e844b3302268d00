"""A day of an ERP, over HTTP alone: tasks, events and webhooks, while the planner's container is killed."""

from __future__ import annotations

import asyncio
import csv
import json
import os
import sys
import time
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.demo import running_demo

from rce_fleet.api.webhooks import SIGNATURE, TIMESTAMP, verify
from rce_fleet.demo.task_run import kill_container

pytestmark = [pytest.mark.e2e, pytest.mark.real_time("robots"), pytest.mark.needs("pymunk")]

LONGEST_S = 240.0
"""For one step of the day on a loaded machine; without load each takes a few seconds."""
AGAIN_S = 0.3
RCE = str(Path(sys.executable).parent / "rce")
REPEATABLE = (429, 503, 507)
ENDED = ("done", "failed", "cancelled")


@dataclass
class Erp:
    """A program of an ERP: it sends requests, follows the events, and takes deliveries of a webhook."""

    session: aiohttp.ClientSession
    secret: str = ""
    followed: list[dict[str, Any]] = field(default_factory=list)
    """Events of the stream, over all its connections."""
    last_id: str = ""
    delivered: list[int] = field(default_factory=list)
    forged: int = 0

    async def ask(
        self, method: str, path: str, body: Any = None, **headers: str
    ) -> tuple[int, dict[str, Any], str]:
        """Send a request, and again while nothing can be reached; return status, body and ETag."""
        given = {name.replace("_", "-"): text for name, text in headers.items()}
        async with asyncio.timeout(LONGEST_S):
            while True:
                async with self.session.request(method, f"/api/v1{path}", json=body, headers=given) as reply:
                    text = await reply.text()
                    if reply.status not in REPEATABLE:
                        return reply.status, json.loads(text), reply.headers.get("ETag", "")
                await asyncio.sleep(AGAIN_S)

    async def create(self, key: str, *stops: tuple[str, int], **fields: Any) -> str:
        """Create a task; return its id."""
        body = {"stops": [{"action": action, "cell": cell} for action, cell in stops], **fields}
        status, task, _ = await self.ask("POST", "/tasks", body, Idempotency_Key=key)
        assert status in (200, 201), task
        return str(task["id"])

    async def until(self, task: str, *states: str) -> dict[str, Any]:
        """Wait until a task is in one of some states; return it."""
        shown: dict[str, Any] = {}
        try:
            async with asyncio.timeout(LONGEST_S):
                while True:
                    shown = (await self.ask("GET", f"/tasks/{task}"))[1]
                    if shown["state"] in states:
                        return shown
                    await asyncio.sleep(AGAIN_S)
        except TimeoutError:
            raise AssertionError(f"{task} is not {states}: {shown}") from None

    async def follow(self, until: int) -> None:
        """Follow the events, from the last one that is known, to the one with a number."""
        headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": self.last_id} if self.last_id else {})
        path = "/api/v1/events" if self.last_id else "/api/v1/events?after=0"
        async with asyncio.timeout(LONGEST_S), self.session.get(path, headers=headers) as reply:
            assert reply.status == 200, await reply.text()
            async for line in reply.content:
                if line.startswith(b"id:"):
                    self.last_id = line[3:].decode().strip()
                elif line.startswith(b"data:"):
                    self.followed.append(json.loads(line[5:]))
                    if self.followed[-1]["number"] >= until:
                        return

    async def newest(self) -> int:
        """Return the number of the newest event."""
        number = 0
        while page := (await self.ask("GET", f"/events?after={number}"))[1]["events"]:
            number = int(page[-1]["number"])
        return number

    async def take_delivery(self, request: web.Request) -> web.Response:
        """Take events of the webhook."""
        body, headers = await request.read(), request.headers
        self.forged += not verify(self.secret, headers[TIMESTAMP], body, headers[SIGNATURE], now=time.time())
        self.delivered += [event["number"] for event in json.loads(body)["events"]]
        return web.Response()


@asynccontextmanager
async def running_erp(url: str) -> AsyncIterator[Erp]:
    """An ERP whose webhook gets the events of tasks."""
    timeout = aiohttp.ClientTimeout(total=LONGEST_S)
    async with aiohttp.ClientSession(url, timeout=timeout) as session:
        erp = Erp(session)
        app = web.Application()
        app.router.add_post("/fleet", erp.take_delivery)
        async with TestServer(app) as server:
            hook = {"url": str(server.make_url("/fleet")), "kinds": ["task"], "allow_private": True}
            status, made, _ = await erp.ask("POST", "/webhooks", hook)
            assert status == 201, made
            erp.secret = made["secret"]
            yield erp
            assert (erp.forged, erp.delivered) == (0, sorted(set(erp.delivered)))


async def places(erp: Erp) -> tuple[dict[str, int], list[int]]:
    """Wait until all robots are there; return their cells, and free cells near the first, nearest first."""
    async with asyncio.timeout(LONGEST_S):
        while True:
            robots = (await erp.ask("GET", "/robots"))[1]["robots"]
            if len(robots) == 3 and all(robot["state"] == "idle" for robot in robots):
                break
            await asyncio.sleep(AGAIN_S)
    floor = (await erp.ask("GET", "/map"))[1]
    cells = {str(robot["id"]): int(robot["cell"]) for robot in robots}
    columns, shut = floor["columns"], {*floor["walls"], *floor["blocked"]}
    near, seen = [cells["Robot1"]], {cells["Robot1"]}
    for cell in near:
        column = cell % columns
        steps = [(column > 0, -1), (column < columns - 1, 1), (True, -columns), (True, columns)]
        beside = {cell + step for allowed, step in steps if allowed} - seen - shut
        near += sorted(other for other in beside if 0 <= other < floor["rows"] * columns)
        seen |= beside
    return cells, [cell for cell in near if cell not in cells.values()]


async def check_creation(erp: Erp, pick: int, drop: int) -> str:
    """A task is created once for a key, whatever is sent again; return it. Its pick has to be confirmed."""
    stops = [{"action": "pick", "cell": pick, "confirm": True}, {"action": "deliver", "cell": drop}]
    body = {"stops": stops}
    status, task, _ = await erp.ask("POST", "/tasks", body, Idempotency_Key="order-1")
    assert status == 201, task
    status, again, _ = await erp.ask("POST", "/tasks", body, Idempotency_Key="order-1")
    assert (status, again["id"]) == (200, task["id"])
    status, said, _ = await erp.ask("POST", "/tasks", {**body, "priority": 9}, Idempotency_Key="order-1")
    assert (status, "another content" in said["error"]) == (409, True)
    return str(task["id"])


async def check_changes(erp: Erp, cell: int) -> str:
    """A task of the evening is changed, held, resumed and cancelled; return it."""
    evening = await erp.create("order-2", ("go", cell), earliest_start=time.time() + 7200)
    path = f"/tasks/{evening}"
    status = 412
    while status == 412:  # the manager may tell meanwhile why the task waits
        _, task, tag = await erp.ask("GET", path)
        status, changed, _ = await erp.ask("PATCH", path, {"priority": 5}, If_Match=tag)
    assert (status, changed["priority"]) == (200, 5)
    assert (await erp.ask("PATCH", path, {"priority": 6}, If_Match=tag))[0] == 412
    status, held, _ = await erp.ask("POST", f"{path}/hold", {"reason": "the truck is late"})
    assert (status, held["state"], held["reason"]) == (200, "held", "the truck is late")
    assert (await erp.ask("POST", f"{path}/resume"))[1]["state"] == "queued"
    assert (await erp.ask("DELETE", path))[1]["state"] == "cancelled"
    assert (await erp.ask("POST", f"{path}/hold", {}))[0] == 409
    assert task["state"] == "queued"
    return evening


async def confirm_pick(erp: Erp, task: str) -> None:
    """Wait until a robot picks, and let it go on."""
    async with asyncio.timeout(LONGEST_S):
        while (await erp.ask("POST", f"/tasks/{task}/confirm"))[0] != 200:
            await asyncio.sleep(AGAIN_S)


async def check_robot_taken_out(erp: Erp, robot: str, cell: int) -> str:
    """A task for a robot that is out waits until the robot is put in; return the task."""
    status, said, _ = await erp.ask("POST", f"/robots/{robot}/take-out", {"reason": "a wheel"})
    assert (status, said["activity"], said["reason"]) == (200, "out", "a wheel")
    task = await erp.create("order-5", ("go", cell), robot=robot)
    async with asyncio.timeout(LONGEST_S):
        while not (shown := (await erp.ask("GET", f"/tasks/{task}"))[1])["reason"]:
            await asyncio.sleep(AGAIN_S)
    assert (shown["state"], shown["robot_assigned"]) == ("queued", "")
    status, said, _ = await erp.ask("POST", f"/robots/{robot}/put-in")
    assert (status, said["mode"]) == (200, "automatic")
    return task


def check_story(events: list[dict[str, Any]], first: str, then: str) -> None:
    """Each stop was made once, also though the planner died; a task began after the one before it."""
    names = [(event["id"], event["name"]) for event in events]
    assert names.count((first, "arrived")) == 2
    assert names.count((first, "acted")) == 2
    assert names.count((first, "finished")) == 1
    assert names.index((first, "finished")) < names.index((then, "started"))
    for task in {event["id"] for event in events if event["kind"] == "task"}:
        story = [event for event in events if event["id"] == task]
        assert story[0]["name"] == "created"
        assert sum(event["state"] in ENDED for event in story) == 1


async def check_report(erp: Erp, expected: dict[str, str]) -> None:
    """The day's report in CSV is what the stream told, and the tasks are as expected."""
    async with erp.session.get("/api/v1/history?format=csv") as reply:
        assert reply.headers["Content-Type"].startswith("text/csv")
        rows = list(csv.DictReader((await reply.text()).splitlines()))
    numbers = [event["number"] for event in erp.followed]
    assert numbers == list(range(1, len(numbers) + 1)), "events are numbered without a gap"
    assert [int(row["number"]) for row in rows][: len(numbers)] == numbers
    ends = {row["id"]: row["state"] for row in rows if row["state"] in ENDED}
    assert ends == expected
    tasks = [event["number"] for event in erp.followed if event["kind"] == "task"]
    async with asyncio.timeout(LONGEST_S):
        while set(tasks) - set(erp.delivered):
            await asyncio.sleep(AGAIN_S)


async def run_fleet(url: str, *words: str) -> str:
    """Run ``rce fleet``; return what it prints."""
    made = await asyncio.create_subprocess_exec(
        *(RCE, "fleet", *words), stdout=PIPE, stderr=PIPE, env={**os.environ, "RCE_STATION": url}
    )
    out, problem = await made.communicate()
    assert made.returncode == 0, problem.decode()
    return out.decode()


async def check_commands(erp: Erp, url: str, robot: str, cell: int, task: str) -> None:
    """The command line sends a robot, blocks a cell, lists tasks, and follows the events."""
    after = await erp.newest()
    watch = await asyncio.create_subprocess_exec(
        *(RCE, "fleet", "watch", "--after", str(after)),
        stdout=PIPE,
        env={**os.environ, "RCE_STATION": url},
    )
    assert watch.stdout is not None
    try:
        assert "is blocked" in await run_fleet(url, "block", str(cell))
        assert cell in (await erp.ask("GET", "/map"))[1]["blocked"]
        assert "is free" in await run_fleet(url, "free", str(cell))
        assert await run_fleet(url, "send", robot, "--cell", str(cell)) == f"{robot} goes to cell {cell}\n"
        assert task in await run_fleet(url, "tasks", "--state", "all")
        told = ""
        async with asyncio.timeout(LONGEST_S):
            while f"{robot} was sent to cell {cell}" not in told:
                line = await watch.stdout.readline()
                assert line, told
                told += line.decode()
        assert f"cell {cell} is blocked" in told
        async with asyncio.timeout(LONGEST_S):
            while (await erp.ask("GET", f"/robots/{robot}"))[1]["cell"] != cell:
                await asyncio.sleep(AGAIN_S)
    finally:
        watch.kill()
        await watch.wait()


async def test_a_day_of_an_erp() -> None:
    """Everything that was accepted ends as it should, once, though the planner's container is killed."""
    options = ("--robots", 3, "--full-stack", 0, "--no-auto", "--seed", 2)
    async with running_demo(*options) as demo, running_erp(demo.page) as erp:
        cells, free = await places(erp)
        first = await check_creation(erp, free[1], free[5])
        then = await erp.create("order-3", ("go", free[2]), after=[first])
        evening = await check_changes(erp, free[3])
        late = {"deadline": time.time() + 3, "when_late": "fail", "after": [then]}
        missed = await erp.create("order-4", ("go", free[3]), **late)
        busy = (await erp.until(first, "running"))["robot_assigned"]
        await erp.follow(await erp.newest())

        kill_container("testUser", demo=demo.process.pid)
        body = {"stops": [{"action": "go", "cell": free[2]}], "after": [first]}
        status, again, _ = await erp.ask("POST", "/tasks", body, Idempotency_Key="order-3")
        assert (status, again["id"]) == (200, then), "the journal on the volume outlives the container"

        other = next(robot for robot in cells if robot != busy)
        waited = await check_robot_taken_out(erp, other, free[4])
        await confirm_pick(erp, first)
        await erp.until(missed, "failed")
        for task in (first, then, waited):
            shown = await erp.until(task, *ENDED)
            assert shown["state"] == "done", shown
        assert shown["visits"][0]["robot"] == other
        await erp.follow(await erp.newest())
        check_story(erp.followed, first, then)
        await check_report(
            erp, {first: "done", then: "done", evening: "cancelled", missed: "failed", waited: "done"}
        )
        statistics = (await erp.ask("GET", "/statistics?seconds=86400"))[1]
        assert (statistics["tasks_done"], statistics["tasks_failed"]) == (3, 1)
        assert (statistics["tasks_cancelled"], statistics["tasks_open"]) == (1, 0)
        await check_commands(erp, demo.page, other, free[6], first)
