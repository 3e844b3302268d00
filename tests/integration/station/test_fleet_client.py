"""The client of the fleet's API at servers that redirect, fail, end streams, or are no stations."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from typer.testing import CliRunner

from rce_fleet.api.tasks import StopModel, TaskRequest
from rce_fleet.cli.commands import app as commands
from rce_fleet.client import ApiError, FleetApiUnavailableError, FleetClient, NotFoundError

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

NOTHING = "http://127.0.0.1:1"


@asynccontextmanager
async def client_of(handler: Handler, attempts: int = 2) -> AsyncIterator[FleetClient]:
    """Return a client of a server with one handler for all requests."""
    app = web.Application()
    app.router.add_route("*", "/{path:.*}", handler)
    async with TestServer(app) as server, FleetClient(str(server.make_url("/")), attempts=attempts) as client:
        yield client


async def redirect(_request: web.Request) -> web.Response:
    return web.Response(status=301, headers={"Location": "https://fleet.example.com/"})


@pytest.mark.parametrize("request_name", ["send", "block", "webhook"])
async def test_a_redirected_change_is_not_taken_as_made(request_name: str) -> None:
    """A proxy that leads to https answers 301: the client said that the robot was sent."""
    async with client_of(redirect) as client:
        made = {
            "send": client.send("Robot1", 3),
            "block": client.set_blocked(3, blocked=True),
            "webhook": client.remove_webhook("1"),
        }
        wanted = made.pop(request_name)
        for other in made.values():
            other.close()
        with pytest.raises(ApiError, match=r"nothing was done.*https://fleet\.example\.com/") as refused:
            await wanted
    assert refused.value.status == 301


@pytest.mark.parametrize("status", [502, 504])
async def test_a_proxy_without_its_station_is_unavailable(status: int) -> None:
    """Requests that can be repeated are sent again; the error is not the proxy's page."""
    asked = 0

    async def fail(_request: web.Request) -> web.Response:
        nonlocal asked
        asked += 1
        return web.Response(status=status, text="<html>", content_type="text/html")

    async with client_of(fail) as client:
        with pytest.raises(FleetApiUnavailableError, match=f"answered {status}"):
            await client.task("1")
    assert asked == 2


@pytest.mark.parametrize("is_first", [False, True])
async def test_a_zone_that_was_removed_without_an_answer_is_removed(is_first: bool) -> None:
    """The request is sent again, and finds nothing. One that is answered at once says that there was none."""
    asked = 0

    async def remove(_request: web.Request) -> web.Response:
        nonlocal asked
        asked += 1
        if asked == 1 and not is_first:
            return web.Response(status=503, text="the fleet manager did not answer")
        return web.json_response({"error": "there is no zone 'gate'"}, status=404)

    async with client_of(remove) as client:
        if is_first:
            with pytest.raises(NotFoundError, match="no zone 'gate'"):
                await client.remove_zone("gate")
        else:
            await client.remove_zone("gate")
            with pytest.raises(NotFoundError):
                await client.remove_zone("gate", revision=3)
    assert asked == (1 if is_first else 3)


async def test_rce_fleet_cancels_many_tasks() -> None:
    """It asks again until none is left."""
    left, asked = [2, 0], list[tuple[str, dict[str, str]]]()

    async def cancel(request: web.Request) -> web.Response:
        asked.append((f"{request.method} {request.path}", dict(request.query)))
        return web.json_response({"tasks": ["T7", "T8"], "left": left.pop(0)})

    app = web.Application()
    app.router.add_route("*", "/{path:.*}", cancel)
    words = ["task", "cancel-many", "--requester", "erp", "--state", "queued,held"]
    async with TestServer(app) as server:
        words += ["--station", str(server.make_url("/"))]
        found = await asyncio.to_thread(CliRunner().invoke, commands, words)
    assert (found.exit_code, found.output) == (0, "4 tasks are cancelled, or bring their loads away first\n")
    assert asked == [("DELETE /api/v1/tasks", {"requester": "erp", "state": "queued,held"})] * 2
    found = CliRunner().invoke(commands, ["task", "cancel-many", "--station", NOTHING])
    assert (found.exit_code, "say which tasks: --requester USER" in found.output) == (2, True)


@pytest.mark.parametrize("key", [" 4711", "order\n4711", "Auftrag 4711 für Jürgen"])
async def test_a_task_is_created_with_any_key(key: str) -> None:
    """In a header the first was refused as another one than that of the task, and the second failed."""
    asked: list[tuple[str, Any]] = []

    async def create(request: web.Request) -> web.Response:
        asked.append((request.headers.get("Idempotency-Key", ""), await request.json()))
        return web.json_response({"error": "seen"}, status=409)

    async with client_of(create) as client:
        stops = [StopModel(cell=9)]
        for request, other in ((TaskRequest(stops=stops, key=key), ""), (TaskRequest(stops=stops), key)):
            with pytest.raises(ApiError, match="seen"):
                await client.create_task(request, key=other)
    assert asked == [("", {"stops": [{"cell": 9}], "key": key})] * 2


async def test_an_answer_that_is_not_text_is_an_error_of_the_client() -> None:
    async def answer(_request: web.Request) -> web.Response:
        return web.Response(body=b"\xff\xfe", content_type="application/json")

    async with client_of(answer) as client:
        with pytest.raises(FleetApiUnavailableError, match="not a TaskModel"):
            await client.task("1")


@pytest.mark.parametrize("url", ["127.0.0.1:9080", "", "http://", "ftp://fleet", "http://127.0.0.1:99999"])
def test_a_url_that_is_none_of_a_station_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match=r"such as http://127\.0\.0\.1:9080"):
        FleetClient(url)


async def test_events_of_a_station_that_is_not_there_end_with_an_error() -> None:
    """``rce fleet watch`` with a wrong URL waited without a word."""
    async with FleetClient(NOTHING, attempts=1) as client, asyncio.timeout(60):
        with pytest.raises(FleetApiUnavailableError, match=r"127\.0\.0\.1:1"):
            await anext(client.events())


async def test_events_of_another_web_server_end_with_an_error() -> None:
    async def page(_request: web.Request) -> web.Response:
        return web.Response(text="<html>", content_type="text/html")

    async with client_of(page) as client, asyncio.timeout(60):
        with pytest.raises(FleetApiUnavailableError, match="text/html instead of text/event-stream"):
            await anext(client.events())


async def test_a_stream_that_broke_before_its_first_event_is_resumed() -> None:
    """What happens between the two connections is not left out; a station that fails then is waited for."""
    asked: list[str] = []
    texts = {"id": "T1", "name": "done", "user": "", "text": "", "state": "done", "robot": ""}
    event = {"number": 8, "time": 1.0, "kind": "task", **texts, "revision": 1}

    async def stream(request: web.Request) -> web.StreamResponse:
        asked.append(request.headers.get("Last-Event-ID", ""))
        if len(asked) in (2, 3, 4):
            return web.Response(status=503, text="starting")
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await response.prepare(request)
        await response.write(b"retry: 2000\nid: abc:7\n\n")
        if len(asked) > 1:
            await response.write(f"id: abc:8\ndata: {json.dumps(event)}\n\n".encode())
        return response

    async with client_of(stream) as client, asyncio.timeout(60):
        found = await anext(client.events())
    assert (found.number, asked) == (8, ["", *["abc:7"] * 4])


async def test_the_history_until_now_ends_while_more_happens() -> None:
    """In a fleet with an event for each request it went on as long as the fleet."""
    texts = {"kind": "task", "id": "T1", "name": "", "user": "", "text": "", "state": "", "robot": ""}
    asked: list[int] = []

    async def answer(request: web.Request) -> web.Response:
        after, limit = (int(request.query.get(name, "0")) for name in ("after", "limit"))
        asked.append(after)
        known = limit + 5 + len(asked)
        numbers = range(after + 1, known + 1)[:limit] if len(asked) < 50 else []
        events = [{"number": number, "time": 1.0, "revision": 1, **texts} for number in numbers]
        page = {"events": events, "next": after + len(events), "journal": "aa", "newest": known}
        return web.json_response(page)

    async with client_of(answer) as client:
        found = [event.number async for event in client.history()]
    assert len(asked) == 2
    assert found == list(range(1, asked[1] + 8))


@pytest.mark.parametrize(
    ("command", "value"),
    [
        ("task add --cell 5 --duration -1", "duration"),
        ("task add --cell -5", "cell"),
        ("task add --cell 5 --rounds 0", "rounds"),
        ("task change T1 --priority 99999999999", "priority"),
        ("send Robot1 --cell -1", "cell"),
    ],
)
def test_rce_fleet_names_a_value_that_is_out_of_range(command: str, value: str) -> None:
    """It is a usage error; each of them was a traceback."""
    found = CliRunner().invoke(commands, [*command.split(), "--station", NOTHING])
    assert (found.exit_code, f"Invalid value for {value}" in found.output) == (2, True), found.output


@pytest.mark.parametrize("station", ["127.0.0.1:9080", "", "http://127.0.0.1:99999"])
def test_rce_fleet_says_what_the_url_of_a_station_is_like(station: str) -> None:
    found = CliRunner().invoke(commands, ["robots", "--station", station])
    assert (found.exit_code, "must be such as http://" in found.output) == (1, True), found.output


def test_the_history_of_any_time_can_be_asked_for() -> None:
    """Before 1970 there is none; the station refused such a time."""
    asked: list[str] = []

    class History(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(parse_qs(urlsplit(self.path).query)["since"][0])
            self.send_response(200)
            self.send_header("Content-Type", "text/csv")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            del format, args

    with ThreadingHTTPServer(("127.0.0.1", 0), History) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            words = ["history", "--hours", "1e6", "--station", f"http://127.0.0.1:{server.server_port}"]
            found = CliRunner().invoke(commands, words)
        finally:
            server.shutdown()
            thread.join()
    assert (found.exit_code, [float(since) for since in asked]) == (0, [0.0]), found.output


@pytest.mark.parametrize(
    ("encoding", "shown"), [("latin-1", b"\\u673a\\u5668 f\xe4hrt"), ("utf-8", "机器 fährt".encode())]
)
def test_letters_that_a_terminal_lacks_are_escaped(encoding: str, shown: bytes) -> None:
    """As in a locale from before UTF-8: the command ended with a traceback."""

    class Robots(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state = {"state": "idle", "activity": "idle", "mode": "automatic", "reason": "机器 fährt"}
            known: dict[str, Any] = {
                "cell": 1,
                "goal": None,
                "battery": None,
                "task": None,
                "queue": [],
                "profile": {},
            }
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.end_headers()
            self.wfile.write(json.dumps({"robots": [{"id": "R", **state, **known, "revision": 1}]}).encode())

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            del format, args

    with ThreadingHTTPServer(("127.0.0.1", 0), Robots) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            code = "import sys; from rce.cli.main import main; sys.argv[0] = 'rce'; main()"
            words = ("fleet", "robots", "--station", f"http://127.0.0.1:{server.server_port}")
            done = subprocess.run(
                [sys.executable, "-c", code, *words],
                capture_output=True,
                check=False,
                env=os.environ | {"PYTHONIOENCODING": encoding},
            )
        finally:
            server.shutdown()
            thread.join()
    assert (done.returncode, shown in done.stdout) == (0, True), done.stderr
