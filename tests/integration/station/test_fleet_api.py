"""The station's API for an ERP, with a real manager, planner and robots: requests, events, webhooks."""

from __future__ import annotations

import asyncio
import io
import json
import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.fleet_station import RoleAuthenticator, fleet_station
from support.managed_fleet import ManagedFleet, managed_fleet

from rce_fleet.api.fleet import ProfileModel, ZoneRequest
from rce_fleet.api.tasks import StopModel, TaskChange, TaskRequest
from rce_fleet.api.webhooks import SIGNATURE, TIMESTAMP, WebhookRequest, verify
from rce_fleet.client import ApiError, EventsRestartedError, FleetClient, NotFoundError, OutdatedError
from rce_fleet.station.authentication import StationUser

KEPT = ("cells", "fleet", "goal")
GO = {"stops": [{"cell": 9}]}


class Receiver:
    """An ERP that takes deliveries, or refuses them."""

    def __init__(self) -> None:
        self.refuses = False
        self.secret = ""
        self.refused = 0
        self.numbers: list[int] = []
        self.gaps: list[str] = []
        self.forged = 0

    async def take(self, request: web.Request) -> web.Response:
        body = await request.read()
        if self.refuses:
            self.refused += 1
            return web.Response(status=500)
        headers = request.headers
        if not verify(self.secret, headers[TIMESTAMP], body, headers[SIGNATURE], now=time.time()):
            self.forged += 1
        said = json.loads(body)
        self.numbers += [event["number"] for event in said["events"]]
        if said.get("gap"):
            self.gaps.append(said["journal"])
        return web.Response()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[str]:
        app = web.Application()
        app.router.add_post("/fleet", self.take)
        async with TestServer(app) as server:
            yield str(server.make_url("/fleet"))


async def until(condition: Any, what: str) -> None:
    async with asyncio.timeout(150):
        while not condition():
            await asyncio.sleep(0.05)
    assert condition(), what


async def until_all_are_there(fleet: ManagedFleet) -> None:
    """Wait until the manager knows the map and all robots."""
    async with asyncio.timeout(150):
        while (await fleet.ask("GET", "/map")).status != 200:
            await asyncio.sleep(0.1)
        while True:
            robots = (await fleet.ask("GET", "/robots")).body["robots"]
            if [robot["state"] for robot in robots] == ["idle", "idle"]:
                return
            await asyncio.sleep(0.1)


async def ask(
    session: aiohttp.ClientSession, method: str, path: str, body: Any = None, **headers: str
) -> tuple[int, Any, str]:
    """Send a request; return status, body and ETag."""
    given = {name.replace("_", "-"): text for name, text in headers.items()}
    async with session.request(method, f"/api/v1{path}", json=body, headers=given) as reply:
        text = await reply.text()
        return reply.status, json.loads(text) if text else None, reply.headers.get("ETag", "")


def session_of(url: str, token: str = "operator") -> aiohttp.ClientSession:
    return aiohttp.ClientSession(url, headers={"Authorization": f"Bearer {token}"})


async def check_that_the_manager_keeps_requests(erp: aiohttp.ClientSession) -> None:
    """Block and free a cell, pause and resume the fleet, send a robot: events of the manager with the user.

    They are the first requests to this station, which does not know yet whether there is a manager.
    """
    for blocked in (True, False):
        status, said, _ = await ask(erp, "PUT", "/cells/30", {"blocked": blocked})
        assert (status, "cell 30" in said["message"]) == (200, True)
    for mode in ("paused", "automatic"):
        assert (await ask(erp, "PUT", "/mode", {"mode": mode}))[0] == 200
    assert (await ask(erp, "PUT", "/robots/Robot1/goal", {"cell": 8}))[0] == 200
    status, said, _ = await ask(erp, "PUT", "/robots/Robot9/goal", {"cell": 8})
    assert (status, "Robot9" in said["error"]) == (409, True)
    events = (await ask(erp, "GET", "/events?limit=5000"))[1]["events"]
    told = [(one["name"], one["user"]) for one in events if one["kind"] in KEPT and one["user"]]
    assert told == [(name, "the_operator") for name in ("blocked", "freed", "paused", "automatic", "goal")]
    assert (await ask(erp, "PUT", "/robots/Robot1/goal", {"cell": None}))[0] == 200


async def check_requests(fleet: ManagedFleet) -> None:
    users = RoleAuthenticator()
    async with fleet_station(fleet.core.uri, authenticator=users) as url, session_of(url) as erp:
        await check_that_the_manager_keeps_requests(erp)
        users.actions.clear()
        status, task, tag = await ask(erp, "POST", "/tasks", GO, Idempotency_Key="a-1")
        assert (status, task["requester"], tag) == (201, "the_operator", f'"{task["revision"]}"')
        assert (await ask(erp, "POST", "/tasks", GO, Idempotency_Key="a-1"))[1]["id"] == task["id"]
        path = f"/tasks/{task['id']}"
        assert (await ask(erp, "PATCH", path, {"priority": 3}, If_Match='"999"'))[0] == 412
        status, said, _ = await ask(erp, "POST", "/tasks", {"stops": [{"cell": -1}]})
        assert (status, "stops.0.cell" in said["error"]) == (422, True)
        status, said, _ = await ask(erp, "GET", "/tasks?colour=red")
        assert (status, "colour" in said["error"]) == (422, True)
        assert (await ask(erp, "GET", "/tasks/T9999"))[0] == 404
        assert (await ask(erp, "POST", "/tasks", GO, Idempotency_Key="x" * 201))[0] == 400
        assert (await ask(erp, "PATCH", path, {"priority": 4}, If_Match="x" * 201))[0] == 400
        async with erp.post("/api/v1/tasks", data=b"\xff\xfe") as reply:
            assert reply.status == 400
        async with erp.post("/api/v1/tasks", data=io.BytesIO(b"[" * (1 << 21))) as reply:
            assert reply.status == 413
        page = (await ask(erp, "GET", "/tasks?state=open,ended&limit=1"))[1]
        assert len(page["tasks"]) == 1
        robots = (await ask(erp, "GET", "/robots"))[1]["robots"]
        assert [robot["id"] for robot in robots] == ["Robot1", "Robot2"]
        page = (await ask(erp, "GET", "/robots?limit=1"))[1]
        assert ([robot["id"] for robot in page["robots"]], page["next"]) == (["Robot1"], "Robot1")
        page = (await ask(erp, "GET", "/robots?limit=1&cursor=Robot1"))[1]
        assert ([robot["id"] for robot in page["robots"]], page["next"]) == (["Robot2"], None)
        status, said, _ = await ask(erp, "GET", "/robots?limit=9999")
        assert (status, "limit" in said["error"]) == (422, True)
        _, _, tag = await ask(erp, "GET", "/chargers")
        status, body, _ = await ask(erp, "GET", "/chargers", If_None_Match=tag)
        assert (status, body["charging"]) == (200, {}), "who charges changes without the revision"
        zone = {"kind": "slow", "cells": [3], "value": 0.3}
        _, _, tag = await ask(erp, "PUT", "/zones/gate", zone)
        assert (await ask(erp, "GET", "/zones/gate", If_None_Match=tag))[0] == 304
        assert (await ask(erp, "GET", "/map"))[1]["rows"] == 8
        assert [(one.name, one.done) for one in users.actions][:1] == [("create_task", True)]
        async with session_of(url, "viewer") as viewer:
            assert (await ask(viewer, "GET", "/tasks"))[0] == 200
            status, said, _ = await ask(viewer, "POST", "/tasks", GO)
            assert (status, "may only see" in said["error"]) == (403, True)
            assert (await ask(viewer, "GET", "/webhooks"))[0] == 403
        async with session_of(url, "stranger") as stranger:
            status, said, _ = await ask(stranger, "GET", "/tasks")
            assert (status, "not valid here" in said["error"]) == (401, True)
        assert (await ask(erp, "GET", "/webhooks"))[0] == 403


class LoopbackAuthenticator(RoleAuthenticator):
    """An engine's users, and no login for requests without a token."""

    async def authenticate(self, token: str) -> StationUser | None:
        return await super().authenticate(token or "operator")


async def run_command(url: str, login: Path) -> tuple[int | None, str]:
    """Run ``rce fleet robots`` with a login; return its exit code, and what it prints."""
    env = {name: text for name, text in os.environ.items() if name != "RCE_STATION_TOKEN"}
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", "from rce.cli import main; main()", "fleet", "robots"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**env, "RCE_STATION": url, "RCE_LOGIN_FILE": str(login)},
    )
    told, _ = await process.communicate()
    return process.returncode, told.decode()


async def check_logins_of_the_command(fleet: ManagedFleet, login: Path) -> None:
    there = {"url": "http://localhost:9000/", "user": "ada", "expires": time.time() + 3600}
    for token, refused in (("viewer", False), ("stranger", True)):
        login.write_text(json.dumps({**there, "token": token}))
        async with fleet_station(fleet.core.uri, authenticator=RoleAuthenticator()) as url:
            code, told = await run_command(url, login)
            expected = "the login at http://localhost:9000/ is not valid" if refused else "Robot2"
            assert (code, expected in told) == (int(refused), True), told
        async with fleet_station(fleet.core.uri, authenticator=LoopbackAuthenticator()) as url:
            code, told = await run_command(url, login)
            assert (code, "Robot2" in told) == (0, True), told


async def check_events(fleet: ManagedFleet) -> None:
    async with fleet_station(fleet.core.uri) as url, FleetClient(url) as client:
        task = await client.create_task(TaskRequest(stops=[StopModel(cell=20)]))
        first = [event async for event in client.history(subject=task.id)]
        assert first[0].name == "created"
        seen: list[int] = []
        async with asyncio.timeout(150):
            async for event in client.events(first[0].number - 1):
                seen.append(event.number)
                if (event.id, event.state) == (task.id, "done"):
                    break
        assert seen == list(range(first[0].number, seen[-1] + 1))
        again: list[int] = []
        async with asyncio.timeout(150):
            async for event in client.events(seen[1]):
                again.append(event.number)
                if event.number == seen[-1]:
                    break
        assert again == seen[2:]
        lines = [line async for line in client.history_csv()]
        assert lines[0].startswith("number,time,kind,id,name,state,robot,user,text")
        assert len(lines) - 1 >= len(seen)
        only = [line async for line in client.history_csv(subject=task.id, kinds=("task", "zone"))]
        assert len(only) - 1 == len([event async for event in client.history(subject=task.id)])
        assert [line async for line in client.history_csv(kinds=["zone"])] == lines[:1]


async def check_client(fleet: ManagedFleet) -> None:
    async with fleet_station(fleet.core.uri) as url, FleetClient(url) as client:
        later = TaskRequest(stops=[StopModel(cell=30)], earliest_start=time.time() + 3600)
        task = await client.create_task(later, key="later")
        assert (await client.create_task(later, key="later")).id == task.id
        async with asyncio.timeout(150):
            while not task.reason:  # why it waits is a change, too
                await asyncio.sleep(0.05)
                task = await client.task(task.id)
        changed = await client.change_task(task.id, TaskChange(priority=7), revision=task.revision)
        assert changed.priority == 7
        with pytest.raises(OutdatedError, match="revision"):
            await client.change_task(task.id, TaskChange(priority=8), revision=task.revision)
        with pytest.raises(ApiError, match="queued: it cannot be released"):
            await client.reassign_task(task.id)
        assert (await client.hold_task(task.id, "wait for the truck")).state == "held"
        assert (await client.resume_task(task.id)).state == "queued"
        assert (await client.cancel_task(task.id)).state == "cancelled"
        held = [await client.create_task(later, key=f"held {number}") for number in range(2)]
        for task in held:
            await client.hold_task(task.id)
        assert {task.id for task in held} <= {*await client.cancel_tasks(state=["held"])}
        with pytest.raises(ValueError, match="give state, robot or requester"):
            await client.cancel_tasks()
        with pytest.raises(NotFoundError, match="T77777"):
            await client.task("T77777")
        with pytest.raises(ApiError, match="cell"):
            await client.create_task(TaskRequest(stops=[StopModel(cell=10_000)]))
        until = time.time() + 3600
        await client.set_blocked(62, blocked=True, reason="spill", until=until)
        (block,) = (await client.map()).blocks
        assert (block.cell, block.reason, block.until, block.robot) == (62, "spill", until, "")
        async with asyncio.timeout(60):
            while [(one.cell, one.reason) for one in (await client.fleet()).blocks] != [(62, "spill")]:
                await asyncio.sleep(0.05)  # the planner's state comes a little later
        await client.set_blocked(62, blocked=False)
        assert await client.robot("Robot1") in await client.robots()
        changed_robot = await client.change_robot("Robot1", ProfileModel(payload=20))
        assert (await client.robot("Robot1")).revision == changed_robot.revision
        with pytest.raises(NotFoundError, match="Robot77"):
            await client.robot("Robot77")
        zone = await client.set_zone("gate", ZoneRequest(kind="slow", cells=[62], value=0.2))
        assert await client.zone("gate") == zone
        await client.remove_zone("gate")
        for mode in ("paused", "automatic"):
            assert await client.set_mode(mode, "fire drill")
        assert {robot.id for robot in (await client.fleet()).robots} == {"Robot1", "Robot2"}
        assert (await client.statistics()).robots == 2


def put_in_the_way(file: Path) -> None:
    """Make a folder of a file, so that it cannot be written; the station may be writing it at this moment."""
    while not file.is_dir():
        file.unlink(missing_ok=True)
        with suppress(FileExistsError):
            file.mkdir()
    (file / "in the way").mkdir()


async def check_webhooks(fleet: ManagedFleet, tmp_path: Path) -> None:
    receiver, file = Receiver(), tmp_path / "station" / "webhooks.json"
    async with receiver.running() as target:
        async with fleet_station(fleet.core.uri, file) as url, FleetClient(url) as client:
            with pytest.raises(ApiError, match="private network"):
                await client.add_webhook(WebhookRequest(url=target))
            hook = await client.add_webhook(WebhookRequest(url=target, kinds=["task"], allow_private=True))
            receiver.secret = hook.secret
            first = await client.create_task(TaskRequest(stops=[StopModel(cell=3)]))
            await until(lambda: receiver.numbers, "a delivery")
            await fleet.until_state(first.id, "done")
            receiver.refuses = True
            await client.create_task(TaskRequest(stops=[StopModel(cell=12)]))
            await until(lambda: receiver.refused, "a refusal")
            async with asyncio.timeout(150):
                while not (await client.webhooks())[0].failures:
                    await asyncio.sleep(0.05)
            assert "answered 500" in (await client.webhooks())[0].error
        receiver.refuses = False
        known = len(receiver.numbers)
        async with fleet_station(fleet.core.uri, file) as url, FleetClient(url) as client:
            await until(lambda: len(receiver.numbers) > known, "the delivery after a restart")
            kept = file.read_bytes()
            put_in_the_way(file)
            with pytest.raises(ApiError, match=r"cannot be removed: .*check --state-dir") as refused:
                await client.remove_webhook(hook.id)
            assert (refused.value.status, [one.id for one in await client.webhooks()]) == (507, [hook.id])
            known = len(receiver.numbers)
            await client.create_task(TaskRequest(stops=[StopModel(cell=3)]))
            await until(lambda: len(receiver.numbers) > known, "a delivery to the webhook that stayed")
            (file / "in the way").rmdir()
            file.rmdir()
            file.write_bytes(kept)
            await client.remove_webhook(hook.id)
            assert await client.webhooks() == []
    assert receiver.forged == 0
    assert receiver.numbers == sorted(set(receiver.numbers))


async def follow(client: FleetClient, after: int) -> None:
    """Follow the events for a while."""
    async with asyncio.timeout(150):
        async for event in client.events(after):
            assert event.number > after


async def check_lost_journal(fleet: ManagedFleet, tmp_path: Path) -> None:
    """Who follows the events is told that their numbers begin anew, also who was away meanwhile."""
    receiver, file = Receiver(), tmp_path / "station" / "webhooks.json"
    async with receiver.running() as target:
        async with fleet_station(fleet.core.uri, file) as url, FleetClient(url) as client:
            hook = await client.add_webhook(WebhookRequest(url=target, allow_private=True))
            receiver.secret = hook.secret
            task = await client.create_task(TaskRequest(stops=[StopModel(cell=3)]))
            await until(lambda: receiver.numbers, "a delivery")
            await fleet.lose_journal()
            with pytest.raises(EventsRestartedError, match="lost its journal"):
                await follow(client, receiver.numbers[-1])
            await until(lambda: receiver.gaps, "a delivery that tells of the gap")
            with pytest.raises(NotFoundError):
                await client.task(task.id)
        await fleet.lose_journal()
        async with fleet_station(fleet.core.uri, file):
            await until(lambda: len(receiver.gaps) == 2, "the same after the station was away")
    assert len(set(receiver.gaps)) == 2
    assert receiver.forged == 0


async def test_requests_reach_the_manager(tmp_path: Path) -> None:
    """Status, revision and key pass through; roles are checked; the client says what went wrong."""
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:
        await until_all_are_there(fleet)
        await check_requests(fleet)
        await check_client(fleet)
        await check_logins_of_the_command(fleet, tmp_path / "login.json")


async def test_events_reach_streams_and_webhooks(tmp_path: Path) -> None:
    """A stream is resumed where it broke; deliveries are signed, retried, and kept over a restart."""
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:
        await until_all_are_there(fleet)
        await check_events(fleet)
        await check_webhooks(fleet, tmp_path)


async def test_a_lost_journal_is_told(tmp_path: Path) -> None:
    (tmp_path / "manager").mkdir()
    async with managed_fleet(tmp_path / "manager" / "journal.sqlite", [0, 7]) as fleet:
        await until_all_are_there(fleet)
        await check_lost_journal(fleet, tmp_path)
