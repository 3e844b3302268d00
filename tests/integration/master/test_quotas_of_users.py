"""One user asks for as much as they can of each kind; another one's requests are answered all the same."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import aiohttp
import pytest
from integration.master.conftest import SECRET
from support.cloud import robot_task_set
from support.fuzzing import Tracebacks

from rce.control.messages import ClientReply, LogChunk, ReadLog, ToTaskSet
from rce_client.connection import Connection
from rce_master.auth import client_digest
from rce_master.http import api_stream, paging
from rce_master.quotas import QuotaSettings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from integration.master.conftest import RunSite, Site, TaskSet


SMALL = QuotaSettings(requests=1, request_burst=20, streams=3, log_reads=2)
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}
HEADERS = {"Content-Type": "application/gzip"}


@asynccontextmanager
async def two_users(run_site: RunSite) -> AsyncIterator[tuple[Site, str, str]]:
    """A master, and the tokens of two users."""
    async with run_site(quotas=SMALL) as site:
        for name in ("anna", "bert"):
            body = {"name": name, "password": name, "role": "user"}
            await site.api("POST", "/users", body, status=201)
        yield site, await site.login("anna", "anna"), await site.login("bert", "bert")


async def ask(site: Site, token: str, path: str = "/robots") -> tuple[int, str | None]:
    headers = {"Authorization": f"Bearer {token}"}
    async with site.session.get(f"{site.url}api/v1{path}", headers=headers) as reply:
        await reply.read()
        return reply.status, reply.headers.get("Retry-After")


async def test_requests_over_rest(run_site: RunSite) -> None:
    async with two_users(run_site) as (site, anna, bert):
        answers = await asyncio.gather(*(ask(site, anna) for _ in range(60)))
        assert {status for status, _ in answers} == {200, 429}
        assert all(wait is not None and int(wait) >= 1 for status, wait in answers if status == 429)
        reply = await site.api("GET", "/robots", token=anna, status=429)
        assert "too many requests: you may make 1 a second; try again in 1 s" in reply["error"]
        await site.api("GET", "/robots", token=bert)
        for _ in range(60):  # administrators have no quotas
            await site.api("GET", "/robots")


async def test_logins_with_the_right_password(run_site: RunSite) -> None:
    async with two_users(run_site) as (site, _, _):

        async def log_in() -> tuple[int, str | None]:
            body = {"userID": "anna", "password": "anna"}
            async with site.session.post(f"{site.url}api/v1/login", json=body) as reply:
                return reply.status, reply.headers.get("Retry-After")

        answers = await asyncio.gather(*(log_in() for _ in range(60)))
        assert {status for status, _ in answers} == {200, 429}
        assert all(wait is not None and int(wait) >= 1 for status, wait in answers if status == 429)
        assert await site.login("bert", "bert")


async def test_logins_of_robots(run_site: RunSite) -> None:
    """The handshake says when to try again; a robot of another user gets in."""
    async with two_users(run_site) as (site, _, _), robot_task_set(site.master.control_port, SECRET) as url:

        async def connect(user: str, robot: str) -> tuple[int, str | None]:
            query = f"userID={user}&robotID={robot}&password={client_digest(user)}"
            address = url.replace("ws", "http", 1)
            async with site.session.get(f"{address}?{query}", headers=UPGRADE) as reply:
                return reply.status, reply.headers.get("Retry-After")

        answers = await asyncio.gather(*(connect("anna", f"r{number}") for number in range(60)))
        assert {status for status, _ in answers} == {101, 429}
        assert all(wait is not None and int(wait) >= 1 for status, wait in answers if status == 429)
        assert (await connect("bert", "rob"))[0] == 101


async def test_requests_of_robots(run_site: RunSite) -> None:
    async with two_users(run_site) as (site, _, _), site.robots() as robots, site.containers():
        for name in ("anna", "bert"):
            assert (await robots.channel.login(name, "rob", client_digest(name))).status == 200

        async def create(user: str, tag: str) -> ClientReply:
            return await robots.channel.client_request(f"{user}/rob", "CC", {"containerTag": tag})

        answers = await asyncio.gather(*(create("anna", f"c{number}") for number in range(60)))
        refused = [error for reply in answers for error in reply.errors]
        assert {fault.code for reply in answers for fault in reply.faults} == {"busy"}
        assert 0 < len(refused) < 60
        assert all("CC: too many requests" in error and "try again in" in error for error in refused)
        assert (await create("bert", "c")).errors == ()


async def test_requests_of_robots_beyond_it_are_repeated(run_site: RunSite) -> None:
    """A program that makes more at once than its user may has all of it at last."""
    quotas = QuotaSettings(requests=5, request_burst=10)
    wanted = {f"say{number}" for number in range(30)}
    async with run_site(quotas=quotas) as site, robot_task_set(site.master.control_port, SECRET):
        body = {"name": "anna", "password": "anna", "role": "user"}
        await site.api("POST", "/users", body, status=201)
        async with Connection(site.url, "anna", "anna", "rob") as conn:
            await asyncio.gather(*(conn.publisher(tag, "std_msgs/String") for tag in wanted))
            async with asyncio.timeout(60):
                while not any("the engine is busy" in error for error in conn.errors):
                    await asyncio.sleep(0.05)
                made: set[str] = set()
                while made != wanted:
                    await asyncio.sleep(0.05)
                    reply = await site.api("GET", "/interfaces", user="anna")
                    made = {one["tag"] for one in reply["interfaces"]}


async def test_streams(run_site: RunSite) -> None:
    async with two_users(run_site) as (site, anna, bert), AsyncExitStack() as stack:

        async def follow(token: str, path: str) -> aiohttp.ClientResponse:
            headers = {"Authorization": f"Bearer {token}"}
            return await stack.enter_async_context(
                site.session.get(f"{site.url}api/v1{path}", headers=headers)
            )

        first = await follow(anna, "/events")
        for path in ("/usage/live", "/events"):
            assert (await follow(anna, path)).status == 200
        for path in ("/usage/live", "/events"):
            refused = await follow(anna, path)
            assert (refused.status, refused.headers["Retry-After"]) == (429, "1")
        assert (await follow(bert, "/events")).status == 200
        first.close()
        async with asyncio.timeout(60):
            while (await follow(anna, "/usage/live")).status != 200:
                await asyncio.sleep(0.5)


@pytest.mark.parametrize("path", ["/interfaces", "/interfaces?limit=5", "/usage"])
async def test_lists_are_made_one_at_a_time(
    run_site: RunSite, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """The first list of one user takes long: their others wait for it, and another user's do not."""
    begun, gate = 0, asyncio.Event()

    def hold(make: Callable[..., Awaitable[object]]) -> Callable[..., Awaitable[object]]:
        async def held(*args: object) -> object:
            nonlocal begun
            begun += 1
            if begun == 1:
                await gate.wait()
            return await make(*args)

        return held

    for name in ("_whole", "_page"):
        monkeypatch.setattr(paging, name, hold(getattr(paging, name)))
    async with two_users(run_site) as (site, anna, bert), asyncio.timeout(60):
        waiting = [asyncio.create_task(ask(site, anna, path)) for _ in range(8)]
        while begun < 1:
            await asyncio.sleep(0.01)
        for _ in range(5):
            assert (await ask(site, bert, path))[0] == 200
        assert begun == 6
        assert not any(task.done() for task in waiting)
        gate.set()
        assert {status for status, _ in await asyncio.gather(*waiting)} == {200}
        assert begun == 5 + 8


async def test_reads_of_logs(run_site: RunSite) -> None:
    """The machine answers none of the first user's reads, and is asked for no more than it may be."""
    async with two_users(run_site) as (site, anna, bert), site.containers() as machine:
        silent(machine, "anna")
        for token in (anna, bert):
            await site.api("POST", "/containers", {"tag": "c"}, token=token, status=204)
        waiting = [asyncio.create_task(ask(site, anna, "/containers/c/log")) for _ in range(10)]
        while len(machine.asked) < SMALL.log_reads:
            await asyncio.sleep(0.01)
        reply = await site.api("GET", "/containers/c/log", token=bert)
        assert reply["text"] == "said bert"
        assert [message.id for message in machine.asked] == ["anna/c", "anna/c", "bert/c"]
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)


def silent(machine: TaskSet, user: str) -> None:
    """Have a machine keep its answers to one user's reads of logs to itself."""

    async def handle(message: ToTaskSet) -> None:
        if not isinstance(message, ReadLog):
            machine.inbox.put_nowait(message)
            return
        machine.asked.append(message)
        owner = message.id.partition("/")[0]
        if owner != user:
            machine.channel.send(LogChunk(request=message.request, offset=0, text=f"said {owner}"))

    machine.channel._handler = handle


async def test_events_of_a_flood_leave_others_theirs(run_site: RunSite) -> None:
    async with two_users(run_site) as (site, anna, bert):
        await site.api("POST", "/containers", {"tag": "mine"}, token=bert, status=204)
        headers = {"Authorization": f"Bearer {bert}"}
        for number in range(15):
            await site.api("POST", "/containers", {"tag": f"c{number}"}, token=anna, status=204)
        async with site.session.get(f"{site.url}api/v1/events?since=0", headers=headers) as stream:
            async with asyncio.timeout(60):
                lines = [await stream.content.readline() for _ in range(6)]
        assert b'"subject":"bert/mine"' in b"".join(lines)
        assert b"anna" not in b"".join(lines)


async def test_streams_that_wait_for_a_client_end_with_it(
    run_site: RunSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clients read nothing, and disappear while the master waits to send: that is not an error."""
    frame = api_stream._frame
    monkeypatch.setattr(api_stream, "_frame", lambda event: frame(event) + b":" + bytes(4 << 20) + b"\n\n")
    async with two_users(run_site) as (site, anna, _):
        for number in range(3):
            await site.api("POST", "/containers", {"tag": f"c{number}"}, token=anna, status=204)
        url = urlsplit(site.url)
        with Tracebacks().watching() as log:
            clients = []
            for _ in range(SMALL.streams):
                reader, writer = await asyncio.open_connection(url.hostname, url.port)
                clients.append(writer)
                writer.write(
                    f"GET /api/v1/events?since=0 HTTP/1.1\r\nHost: {url.netloc}\r\n"
                    f"Authorization: Bearer {anna}\r\n\r\n".encode()
                )
                assert b" 200 " in await reader.readline()
            await asyncio.sleep(0.5)  # the master begins to wait meanwhile
            for writer in clients:
                writer.transport.abort()
            status = 0
            async with asyncio.timeout(60):
                while status != 200:
                    await asyncio.sleep(0.5)
                    headers = {"Authorization": f"Bearer {anna}"}
                    async with site.session.get(f"{site.url}api/v1/events", headers=headers) as stream:
                        status = stream.status
        assert not log.found
