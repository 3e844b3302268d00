"""The station's HTTP: the API for an ERP, who may use it, what the page gets."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from typing import Any

import pytest
from aiohttp import ClientSession, CookieJar, web
from aiohttp.test_utils import TestClient, TestServer

from rce_fleet.station.authentication import TokenAuthenticator
from rce_fleet.station.desired import DesiredCell
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.live import Broadcast
from rce_fleet.station.planner_client import PlannerError, PlannerUnavailableError
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView


class RecordingFleet(FleetLink):
    """Takes requests in place of the planner."""

    can_ask_manager = expects_manager = False

    def __init__(self) -> None:
        self.desired: list[tuple[object, ...]] = []
        self.fault: PlannerError | None = None

    async def set_goal(self, robot: str, cell: int | None) -> str:
        return self._note("goal", robot, cell)

    async def block_cell(self, wanted: DesiredCell) -> str:
        return self._note("cell", wanted.cell, wanted.blocked, *filter(None, (wanted.reason, wanted.until)))

    async def set_grid(self, choice: dict[str, Any], *, preview: bool) -> dict[str, Any]:
        answer = self._note("preview" if preview else "grid", *choice.values())
        return {"message": answer, "rows": 4, "columns": 4, "walls": [12], "blocked_share": 0.1}

    def _note(self, *requested: object) -> str:
        if self.fault is not None:
            raise self.fault
        self.desired.append(requested)
        return "done"


class RunningStation:
    """A station with its parts at hand."""

    def __init__(self) -> None:
        self.view, self.fleet, self.pages = FleetView(), RecordingFleet(), Broadcast(self.everything)
        self.client: TestClient[web.Request, web.Application]

    def everything(self) -> list[str]:
        return [json.dumps({"type": "everything"})]

    async def start(self, token: str = "") -> None:
        app = Station(self.view, self.fleet, self.pages, authenticator=TokenAuthenticator(token)).make_app()
        self.client = TestClient(TestServer(app))
        await self.client.start_server()


@pytest.fixture
async def running() -> AsyncIterator[RunningStation]:
    made = RunningStation()
    yield made
    await made.client.close()


STATE = {
    "rows": 2,
    "columns": 2,
    "cell_size": 1.0,
    "origin_x": 0.0,
    "origin_y": 0.0,
    "blocked": [3],
    "pending": [1],
    "walls": [3],
    "robots": [
        {
            "id": "Robot1",
            "state": "driving",
            "reason": "",
            "cell": 0,
            "goal": 2,
            "plan": [0, 2],
            "granted": [0, 2],
            "replans": 1,
        }
    ],
}


async def test_reads_the_fleet(running: RunningStation) -> None:
    await running.start()
    spill = {"cell": 1, "sensed": False, "by": "ann", "reason": "spill", "age": 10.0, "lifetime": 60.0}
    running.view.on_state({**STATE, "blocks": [spill]}, 1000.0)
    fleet = await (await running.client.get("/api/v1/fleet")).json()
    assert fleet["map"]["rows"] == 2
    assert (fleet["blocked"], fleet["pending"]) == ([3], [1])
    told = {"cell": 1, "user": "ann", "robot": "", "reason": "spill", "since": 990.0, "until": 1060.0}
    assert fleet["blocks"] == [told]
    robot = await (await running.client.get("/api/v1/robots/Robot1")).json()
    assert (robot["goal"], robot["plan"], robot["pose"]) == (2, [0, 2], None)
    assert (fleet["age"], robot["age"]) == (None, None)
    running.view.planner_heard_at = time.monotonic() - 100
    fleet = await (await running.client.get("/api/v1/fleet")).json()
    assert (fleet["age"] >= 100, fleet["robots"][0]["age"] >= 100) == (True, True)
    poses = {"robots": ["Robot1"], "x": [1.0], "y": [0.0], "yaw": [0.0], "age": [5.0]}
    running.view.on_poses(poses, time.monotonic() - 300)
    robot = await (await running.client.get("/api/v1/robots/Robot1")).json()
    assert robot["age"] >= 305, "the robot's own age, which grows"
    missing = await running.client.get("/api/v1/robots/Robot9")
    assert missing.status == 404
    assert "Robot1" in (await missing.json())["error"]


@pytest.mark.parametrize(
    ("path", "accept", "fault"),
    [
        ("webhooks?limit=3", "", "query parameter 'limit' is unknown here; known are: none"),
        ("figures?second=60", "", "query parameter 'second' is unknown here; known are: seconds"),
        ("fleet?robot=Robot1", "", "query parameter 'robot' is unknown here; known are: none"),
        (
            "tasks?states=open",
            "",
            "known are: cursor, deadline_before, limit, order, requester, robot, state",
        ),
        ("tasks?state=open&state=ended", "", "query parameter 'state' is given 2 times; give it once"),
        ("events?task=7", "text/event-stream", "known are: after, id, kind, limit, robot"),
        ("events?id=7", "text/event-stream", "a stream of events takes no 'id'"),
        ("events?robot=Robot1", "text/event-stream", "a stream of events takes no 'robot'"),
        ("history?format=csv&task=7", "", "query parameter 'task' is unknown here"),
    ],
)
async def test_unknown_and_repeated_parameters_are_refused(
    running: RunningStation, path: str, accept: str, fault: str
) -> None:
    """A filter that is ignored shows what others did as if it passed; of two states one was ignored."""
    await running.start("secret")
    # The token counts as known everywhere.
    answer = await running.client.get(f"/api/v1/{path}&token=secret", headers={"Accept": accept})
    assert (answer.status, fault in (await answer.json())["error"]) == (422, True)
    document = await (await running.client.get("/api/v1/openapi.json")).json()
    assert "422" in document["paths"][f"/api/v1/{path.partition('?')[0]}"]["get"]["responses"]


async def test_known_parameters_are_described(running: RunningStation) -> None:
    await running.start()
    document = await (await running.client.get("/api/v1/openapi.json")).json()
    for path in ("figures", "replay/{at}"):
        (query,) = [
            one for one in document["paths"][f"/api/v1/{path}"]["get"]["parameters"] if one["in"] == "query"
        ]
        assert query["name"] == "seconds"
    assert (await running.client.get("/api/v1/figures?seconds=60")).status == 200


async def test_emergency_stops_are_not_refused_for_parameters(running: RunningStation) -> None:
    await running.start()
    plain = await running.client.post("/api/v1/robots/Robot1/emergency-stop", json={"stopped": True})
    other = await running.client.post("/api/v1/robots/Robot1/emergency-stop?x=1", json={"stopped": True})
    assert (other.status, await other.text()) == (plain.status, await plain.text())


async def test_sets_goals_and_blocks_cells(running: RunningStation) -> None:
    await running.start()
    assert (await running.client.put("/api/v1/robots/Robot1/goal", json={"cell": 5})).status == 200
    assert (await running.client.put("/api/v1/robots/Robot1/goal", json={"cell": None})).status == 200
    assert (await running.client.put("/api/v1/cells/7", json={"blocked": True})).status == 200
    assert running.fleet.desired == [("goal", "Robot1", 5), ("goal", "Robot1", None), ("cell", 7, True)]
    until = round(time.time()) + 600
    spill = {"blocked": True, "reason": "spill", "until": until}
    assert (await running.client.put("/api/v1/cells/7", json=spill)).status == 200
    assert running.fleet.desired[-1] == ("cell", 7, True, "spill", until)
    reply = await running.client.put("/api/v1/cells/7", json={"blocked": True, "until": 1.0})
    assert (reply.status, "the end 1 is not after now" in (await reply.json())["error"]) == (409, True)


async def test_previews_and_changes_the_grid(running: RunningStation) -> None:
    await running.start()
    early = await running.client.put("/api/v1/grid", json={"cell_size": 0.5})
    assert (early.status, "not known yet" in (await early.json())["error"]) == (503, True)
    running.view.on_state(STATE)
    shown = await running.client.post("/api/v1/grid/preview", json={"cell_size": 0.5, "blocked_share": 0.2})
    assert await shown.json() == {
        "message": "done", "rows": 4, "columns": 4, "cell_size": 0.5, "origin": [0.0, 0.0], "yaw": 0.0,
        "blocked_share": 0.1, "walls": [12],
    }  # fmt: skip
    assert (await running.client.put("/api/v1/grid", json={"origin": [1, 2], "yaw": 0.3})).status == 200
    assert running.fleet.desired == [
        ("preview", 0.5, 0.0, 0.0, 0.0, 0.2),
        ("grid", 1.0, 1.0, 2.0, 0.3, -1.0),
    ]


@pytest.mark.parametrize(
    ("path", "body", "words"),
    [
        ("/api/v1/robots/Robot1/goal", '{"cell": "far"}', "cell"),
        ("/api/v1/robots/Robot1/goal", '{"cell": -4}', "cell"),
        ("/api/v1/cells/7", '{"blocked": true, "colour": "red"}', "colour"),
        ("/api/v1/cells/7", "no json", "JSON"),
        ("/api/v1/grid", '{"cell_size": 0}', "cell_size"),
        ("/api/v1/grid", '{"cell_size": 1e999}', "cell_size"),
        ("/api/v1/grid", '{"blocked_share": 1.5}', "blocked_share"),
        ("/api/v1/grid", '{"origin": [0]}', "origin"),
        ("/api/v1/cells/seven", '{"blocked": true}', "seven"),
    ],
)
async def test_bad_input_names_the_place(running: RunningStation, path: str, body: str, words: str) -> None:
    await running.start()
    reply = await running.client.put(path, data=body)
    assert reply.status in (400, 404)
    assert words in (await reply.json())["error"]
    assert running.fleet.desired == []


@pytest.mark.parametrize(
    ("fault", "status"), [(PlannerError("cell 7 is a wall"), 409), (PlannerUnavailableError("away"), 503)]
)
async def test_planners_refusal_is_returned(
    running: RunningStation, fault: PlannerError, status: int
) -> None:
    await running.start()
    running.fleet.fault = fault
    reply = await running.client.put("/api/v1/cells/7", json={"blocked": True})
    assert (reply.status, (await reply.json())["error"]) == (status, str(fault))


async def test_pages_of_other_sites_are_refused(running: RunningStation) -> None:
    await running.start()
    evil = {"Origin": "http://evil.example"}
    assert (await running.client.put("/api/v1/cells/7", json={"blocked": True}, headers=evil)).status == 403
    own = {"Origin": str(running.client.make_url("/").origin())}
    assert (await running.client.put("/api/v1/cells/7", json={"blocked": True}, headers=own)).status == 200


async def test_unknown_host_name_is_refused(running: RunningStation) -> None:
    """A page whose name was made to lead here (DNS rebinding) steers nothing."""
    await running.start()
    evil = {"Host": "evil.example:9080", "Origin": "http://evil.example:9080"}
    reply = await running.client.put("/api/v1/cells/7", json={"blocked": True}, headers=evil)
    assert reply.status == 421
    assert "--public-name" in (await reply.json())["error"]
    for path in ("/", "/api/v1/fleet", "/api/v1/live"):
        assert (await running.client.get(path, headers={"Host": "evil.example"})).status == 421
    assert running.fleet.desired == []


async def test_token_is_required_if_one_is_set(running: RunningStation) -> None:
    await running.start(token="open sesame")
    assert (await running.client.get("/api/v1/fleet")).status == 401
    bearer = {"Authorization": "Bearer open sesame"}
    assert (await running.client.get("/api/v1/fleet", headers=bearer)).status == 200
    assert (await running.client.get("/?token=wrong")).status == 401
    assert (await running.client.get("/", params={"token": "open sesame"})).status == 200
    assert (await running.client.get("/static/main.js")).status == 200, "the page's cookie lets its parts in"


async def test_stations_on_one_host_keep_their_own_cookies() -> None:
    """A browser sends a cookie to all ports of a host."""
    tokens = ("one", "two")
    async with AsyncExitStack() as stack:
        browser = await stack.enter_async_context(ClientSession(cookie_jar=CookieJar(unsafe=True)))
        urls = []
        for token in tokens:
            access = TokenAuthenticator(token)
            app = Station(FleetView(), RecordingFleet(), Broadcast(), authenticator=access).make_app()
            server = await stack.enter_async_context(TestServer(app))
            urls.append(server.make_url("/"))
        for url, token in zip(urls, tokens, strict=True):
            assert (await browser.get(url, params={"token": token})).status == 200
        for url in urls:
            assert (await browser.get(url / "api/v1/fleet")).status == 200


async def test_live_socket_sends_changes(running: RunningStation) -> None:
    await running.start()
    running.pages.send("state", json.dumps({"type": "state"}))
    async with running.client.ws_connect("/api/v1/live") as socket:
        assert (await socket.receive_json())["type"] == "everything"
        assert (await socket.receive_json())["type"] == "state"
        running.pages.send_event(json.dumps({"type": "event", "text": "news"}))
        assert (await socket.receive_json())["text"] == "news"
    assert (await running.client.get("/")).status == 200


async def test_a_page_that_takes_changes_gets_them(running: RunningStation) -> None:
    await running.start()
    async with running.client.ws_connect("/api/v1/live?changes=1") as socket:
        assert (await socket.receive_json())["type"] == "everything"
        running.pages.send_change(json.dumps({"type": "changes"}))
        assert (await socket.receive_json())["type"] == "changes"


async def test_a_page_of_an_earlier_release_gets_everything(running: RunningStation) -> None:
    await running.start()
    async with running.client.ws_connect("/api/v1/live") as socket:
        assert (await socket.receive_json())["type"] == "everything"
        running.pages.send_change(json.dumps({"type": "changes"}))
        assert (await socket.receive_json())["type"] == "everything"


async def test_the_document_describes_every_route(running: RunningStation) -> None:
    await running.start()
    document = await (await running.client.get("/api/v1/openapi.json")).json()
    assert document["openapi"].startswith("3.1")
    assert set(document["paths"]) >= {
        "/api/v1/login",
        "/api/v1/me",
        "/api/v1/fleet",
        "/api/v1/robots/{robot}",
        "/api/v1/robots/{robot}/goal",
        "/api/v1/cells/{cell}",
        "/api/v1/grid",
        "/api/v1/grid/preview",
        "/api/v1/mode",
        "/api/v1/emergency-stop",
        "/api/v1/robots/{robot}/emergency-stop",
        "/api/v1/robots/{robot}/pose",
        "/api/v1/replay",
        "/api/v1/replay/{at}",
        "/api/v1/simulation",
        "/api/v1/tasks",
        "/api/v1/tasks/{id}/hold",
        "/api/v1/robots",
        "/api/v1/zones/{id}",
        "/api/v1/events",
        "/api/v1/history",
        "/api/v1/webhooks",
    }
    assert "GoalRequest" in document["components"]["schemas"]


async def test_pages_are_asked_for_again_and_never_framed(running: RunningStation) -> None:
    await running.start()
    for path in ("/", "/login", "/static/main.js", "/api/v1/fleet", "/nowhere"):
        async with running.client.get(path) as reply:
            assert reply.headers["X-Frame-Options"] == "DENY"
            assert "frame-ancestors 'none'" in reply.headers["Content-Security-Policy"]
            if reply.status == 200 and not path.startswith("/api"):
                assert reply.headers["Cache-Control"] == "no-cache"
    async with running.client.get("/static/main.js") as reply:
        mark = {"If-None-Match": reply.headers["ETag"]}
    async with running.client.get("/static/main.js", headers=mark) as reply:
        assert reply.status == 304
