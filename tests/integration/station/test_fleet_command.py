"""``rce fleet`` at a station: which token it sends, JSON, recurring tasks, texts with control codes."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from pydantic import BaseModel
from typer.testing import CliRunner

from rce_fleet.api.fleet import (
    FleetMapModel,
    FleetRobotModel,
    RobotList,
    StatisticsModel,
    ZoneList,
    ZoneModel,
)
from rce_fleet.api.tasks import TaskModel, TaskPage, TaskRequest
from rce_fleet.cli.access import TOKEN_VARIABLE, why_not_sent
from rce_fleet.cli.commands import app as commands
from rce_fleet.station.api import Answer
from rce_fleet.station.commands.routes import StopAnswer
from rce_master.cli.credentials import FILE_VARIABLE

TOKEN = "of-the-login"
BELL = "box\x1b]0;owned\x07"
TASK = TaskModel.model_validate(
    {
        "id": "T7",
        "stops": [{"cell": 5}],
        "name": BELL,
        "state": "running",
        "reason": BELL,
        "question": "Where is the load that R1 has?",
        "robot_assigned": "R1",
        "target": 5,
        "position": 0,
        "loads": 0,
        "visits": [{"stop": 0, "robot": BELL, "cell": 5, "started_at": 1.0, "ended_at": None}],
        "requester": "erp",
        "key": "",
        "created_at": 1.0,
        "changed_at": 1.0,
        "started_at": 1.0,
        "expected_end": None,
        "late": False,
        "occurrence": 1,
        "revision": 1,
    }
)
ROBOT = FleetRobotModel.model_validate(
    {
        "id": "R1",
        "state": "idle",
        "activity": "idle",
        "mode": "automatic",
        "reason": BELL,
        "cell": 5,
        "goal": None,
        "battery": 0.5,
        "task": None,
        "queue": [],
        "profile": {},
        "revision": 1,
    }
)
ZONE = ZoneModel(id="gate", kind="blocked", cells=[4], edges=[[12, 13]], user="ada", revision=1)
LANE = {"name": "bay", "cells": [4, 12, 20], "one_way": False, "speed": 0.0, "width": 0.0, "cost": 1}
MAP = FleetMapModel.model_validate(
    {
        "rows": 8,
        "columns": 8,
        "cell_size": 1.0,
        "origin": [0.0, 0.0],
        "yaw": 0.0,
        "walls": [],
        "blocked": [],
        "lanes": [LANE, {**LANE, "name": "out", "cells": [0, 1], "one_way": True}],
    }
)
FIGURES = StatisticsModel.model_validate(dict.fromkeys(StatisticsModel.model_fields, 0))


class Station:
    """A web server with the routes of a station, and the tokens and bodies that came to it."""

    def __init__(self) -> None:
        self.tokens: list[str] = []
        self.bodies: list[Any] = []
        self.changes: list[str] = []
        self.zones: list[str] = []
        self.missed: list[str] = []
        self.has_manager = True
        self.lost = 0
        """How many answers to changes are lost."""
        self.wants = ""
        """The token that it asks for; empty: none."""

    async def answer(self, request: web.Request) -> web.Response:
        self.tokens.append(request.headers.get("Authorization", "").removeprefix("Bearer "))
        if self.wants and self.tokens[-1] != self.wants:
            return web.json_response({"error": "log in"}, status=401)
        if request.can_read_body:
            self.bodies.append(await request.json())
        path = request.path.removeprefix("/api/v1/")
        if path.startswith("zones") and not self.has_manager:
            return web.json_response({"error": "the fleet manager did not answer"}, status=503)
        if request.method != "GET":
            self.changes.append(f"{request.method} {path}")
            if self.lost:
                self.lost -= 1
                return web.json_response({"error": "the fleet manager did not answer"}, status=503)
        shown = self.shown(path, request.method).model_dump_json()
        return web.Response(text=shown, content_type="application/json")

    def shown(self, path: str, method: str) -> BaseModel:
        """Return what the station answers to a request."""
        if path.endswith("emergency-stop"):
            return StopAnswer(message="", missed=self.missed)
        if path == "mode":
            return Answer(message="")
        if path.startswith("robots/"):
            return ROBOT
        if path.startswith("zones/"):
            return ZONE
        if path.startswith("cells/"):
            word = "blocked" if self.bodies[-1]["blocked"] else "free"
            return Answer(message=f"cell {path.removeprefix('cells/')} is {word}")
        zones = [ZONE.model_copy(update={"id": name}) for name in self.zones]
        found = {
            "robots": RobotList(robots=[ROBOT]),
            "map": MAP,
            "zones": ZoneList(zones=[ZONE, *zones]),
            "statistics": FIGURES,
        }
        is_list = path == "tasks" and method == "GET"
        return TaskPage(tasks=[TASK], next=None) if is_list else found.get(path, TASK)


@pytest.fixture
def station() -> Station:
    return Station()


@pytest.fixture
async def url(station: Station) -> AsyncIterator[str]:
    app = web.Application()
    app.router.add_route("*", "/{path:.*}", station.answer)
    async with TestServer(app) as server:
        yield str(server.make_url("/"))


@pytest.fixture(autouse=True)
def login(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    file = tmp_path / "login.json"
    monkeypatch.setenv(FILE_VARIABLE, str(file))
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    monkeypatch.delenv("RCE_STATION", raising=False)
    return file


def keep_login(file: Path, engine: str) -> None:
    kept = {"url": engine, "user": "ada", "token": TOKEN, "expires": time.time() + 3600}
    file.write_text(json.dumps(kept))


async def run(url: str, *words: str) -> tuple[int, str]:
    """Run a command in a thread; return its exit code, and what it prints."""

    def invoke() -> tuple[int, str]:
        found = CliRunner().invoke(commands, words, env={"RCE_STATION": url})
        return found.exit_code, found.output

    return await asyncio.to_thread(invoke)


async def test_a_login_is_not_sent_to_a_station_of_others(station: Station, url: str, login: Path) -> None:
    keep_login(login, "http://engine.example.org:9000/")
    assert (await run(url, "robots"))[0] == 0
    assert station.tokens == [""]
    station.wants = TOKEN
    code, told = await run(url, "robots")
    assert (code, station.tokens[1:]) == (1, [""])
    assert "127.0.0.1 is not a host of that engine" in told
    assert "--send-login" in told
    assert (await run(url, "--send-login", "robots"))[0] == 0
    assert station.tokens[2:] == [TOKEN]


async def test_a_login_is_sent_to_the_station_beside_its_engine(
    station: Station, url: str, login: Path
) -> None:
    keep_login(login, "http://one.example.org:9000/,http://localhost:9000/")
    station.wants = TOKEN
    assert (await run(url, "robots"))[0] == 0
    assert station.tokens == [TOKEN]
    assert (await run(url, "--token", "another", "robots"))[0] == 1
    assert station.tokens[1:] == ["another"]


@pytest.mark.parametrize(
    ("engine", "station", "why"),
    [
        ("http://cloud:9000/", "http://cloud:9080", ""),
        ("http://cloud:9000/", "http://CLOUD.:9080", ""),
        ("http://cloud:9000/", "https://cloud", ""),
        ("https://cloud:9000/", "https://cloud", ""),
        ("https://cloud:9000/", "http://cloud:9080", "not encrypted"),
        ("https://localhost:9000/", "http://[::1]:9080", ""),
        ("http://a:9000/,http://b:9000/", "http://b:9080", ""),
        ("http://cloud:9000/", "http://cloud.example.org:9080", "not a host of that engine"),
        ("http://cloud:9000/", "http://cloud@evil.example.org:9080", "evil.example.org is not a host"),
        ("http://cloud:9000/", "http://127.0.0.1:9080", "not a host of that engine"),
        ("http://cloud:9000/", "http://[::1", "cannot be read"),
    ],
)
def test_the_token_of_a_login_stays_with_its_engine(engine: str, station: str, why: str) -> None:
    found = why_not_sent(engine, station)
    assert why in found
    assert bool(why) == bool(found)


async def test_rce_fleet_prints_json(url: str) -> None:
    """As the API returns it; a terminal interprets nothing in it."""
    robots = ["robots", "--json"]
    for words, expected in (
        (robots, [ROBOT.model_dump(mode="json")]),
        (["tasks", "--json"], [TASK.model_dump(mode="json")]),
        (["task", "show", "T7", "--json"], TASK.model_dump(mode="json")),
        (["statistics", "--json"], FIGURES.model_dump(mode="json")),
    ):
        code, told = await run(url, *words)
        assert (code, json.loads(told)) == (0, expected), words
        assert "\x1b" not in told


@pytest.mark.parametrize("words", [["robots"], ["tasks"], ["task", "show", "T7"]])
async def test_rce_fleet_prints_no_control_codes(url: str, words: list[str]) -> None:
    """A task's name or reason is written by another user."""
    code, told = await run(url, *words)
    assert (code, "owned" in told) == (0, True)
    assert "\x1b" not in told
    assert "\x07" not in told


async def test_rce_fleet_adds_a_recurring_task(station: Station, url: str) -> None:
    code, told = await run(url, "task", "add", "--cell", "5", "--every", "3600", "--count", "10")
    assert (code, told) == (0, "T7\n")
    task = TaskRequest.model_validate(station.bodies[0])
    assert task.repeat is not None
    assert (task.repeat.every, task.repeat.count) == (3600, 10)
    assert (await run(url, "task", "add", "--cell", "5", "--every", "60"))[0] == 0
    assert station.bodies[1]["repeat"]["count"] is None
    for wrong, value in ((["--count", "2"], "count"), (["--every", "0"], "every")):
        code, told = await run(url, "task", "add", "--cell", "5", *wrong)
        assert (code, f"Invalid value for {value}" in told) == (2, True), told
    assert len(station.bodies) == 2


async def test_rce_fleet_repeats_a_task_with_its_dates(station: Station, url: str) -> None:
    """Seconds from now would be another content, which a second request with the key must not have."""
    words = ["task", "add", "--cell", "5", "--key", "order-1"]
    dates = ["--start", "2026-11-28T18:00", "--deadline", "2026-11-28T18:30"]
    for _ in range(2):
        assert await run(url, *words, *dates) == (0, "T7\n")
    first, second = station.bodies
    assert first == second
    assert first["deadline"] - first["earliest_start"] == 1800
    now = time.time()
    assert (await run(url, "task", "add", "--cell", "5", "--deadline", "600", "--start", "0"))[0] == 0
    assert now + 600 <= station.bodies[2]["deadline"] <= time.time() + 600
    assert station.bodies[2]["earliest_start"] is None
    code, told = await run(url, "task", "add", "--cell", "5", "--deadline", "soon")
    told = " ".join(told.replace("│", " ").split())
    assert (code, "expected seconds from now, or a time such as 18:30" in told) == (2, True), told


async def test_rce_fleet_tells_the_key_without_an_answer(station: Station, url: str) -> None:
    """The task may have been created: only with its key does a second command not make another one."""
    station.lost = 3  # as often as the command asks
    code, told = await run(url, "task", "add", "--cell", "5")
    assert (code, len(station.bodies), station.lost) == (1, 3, 0)
    key = station.bodies[0]["key"]
    assert told.endswith(f"to repeat the command without a second task, add --key {key}\n")
    assert await run(url, "task", "add", "--cell", "5", "--key", key) == (0, "T7\n")
    assert station.bodies == [station.bodies[0]] * 4


async def test_rce_fleet_makes_lists_and_removes_zones(station: Station, url: str) -> None:
    """With a reason, an end, robots and moves."""
    now = time.time()
    words = ["--kind", "slow", "--value", "0.2", "--robot", "R1", "--reason", "wet", "--for", "60"]
    assert await run(url, "zone", "add", "gate", "4", "5", *words) == (
        0,
        "zone gate: blocked, 1 cells, 1 moves\n",
    )
    (body,) = station.bodies
    assert now + 60 <= body.pop("until") <= time.time() + 60
    assert body == {
        "kind": "slow",
        "value": 0.2,
        "cells": [4, 5],
        "edges": [],
        "robots": ["R1"],
        "reason": "wet",
    }
    assert (await run(url, "zone", "add", "gate", "--edge", "12>13"))[0] == 0
    assert station.bodies[-1]["edges"] == [[12, 13]]
    code, told = await run(url, "zone", "add", "gate", "--edge", "12")
    assert (code, "a move is written as 12>13" in told) == (2, True)
    assert "gate  blocked  -      4 12>13  all     -      ada" in (await run(url, "zone", "list"))[1]
    assert await run(url, "zone", "remove", "gate") == (0, "zone gate is removed\n")
    assert station.changes == ["PUT zones/gate", "PUT zones/gate", "DELETE zones/gate"]


@pytest.mark.parametrize(
    ("words", "change", "body"),
    [
        ("task confirm T7", "POST tasks/T7/confirm", None),
        ("task load T7 --cell 12", "POST tasks/T7/load", {"cell": 12}),
        ("task load T7 --lost", "POST tasks/T7/load", {"cell": None}),
        ("pause R1 --reason visitors", "POST robots/R1/pause", {"reason": "visitors"}),
        ("resume R1", "POST robots/R1/resume", None),
    ],
)
async def test_rce_fleet_does_what_waits_for_people(
    station: Station, url: str, words: str, change: str, body: Any
) -> None:
    code, told = await run(url, *words.split())
    assert (code, station.changes) == (0, [change]), told
    assert station.bodies == ([] if body is None else [body])


@pytest.mark.parametrize(
    ("words", "change", "body", "told"),
    [
        (
            "pause --all --reason fire",
            "PUT mode",
            {"mode": "paused", "reason": "fire"},
            "the fleet is paused",
        ),
        ("resume --all", "PUT mode", {"mode": "automatic", "reason": ""}, "the fleet drives"),
        ("emergency-stop --all", "PUT emergency-stop", {"stopped": True}, "all robots: stopped"),
        (
            *("emergency-stop R1 --release", "PUT robots/R1/emergency-stop"),
            *({"stopped": False}, "R1: released"),
        ),
    ],
)
async def test_rce_fleet_stops_the_whole_fleet(
    station: Station, url: str, words: str, change: str, body: Any, told: str
) -> None:
    assert await run(url, *words.split()) == (0, f"{told}\n")
    assert (station.changes, station.bodies) == ([change], [body])


async def test_rce_fleet_tells_who_was_not_stopped(station: Station, url: str) -> None:
    station.missed = ["R2", "R3"]
    code, told = await run(url, "emergency-stop", "--all")
    assert (code, "not reached yet: R2, R3;" in told) == (1, True)


@pytest.mark.parametrize("words", ["pause", "resume R1 --all", "emergency-stop"])
async def test_rce_fleet_stops_one_robot_or_all(station: Station, url: str, words: str) -> None:
    code, told = await run(url, *words.split())
    assert (code, station.changes) == (2, [])
    assert "name one robot, or give --all" in " ".join(told.replace("│", " ").split())


async def test_rce_fleet_shows_a_question_with_its_answer(url: str) -> None:
    told = (await run(url, "task", "show", "T7"))[1]
    assert "Where is the load that R1 has? (rce fleet task load T7 --cell CELL, or --lost)" in told


@pytest.mark.parametrize("words", ["", "--lost --cell 3", "--cell -1"])
async def test_rce_fleet_refuses_an_unclear_load(station: Station, url: str, words: str) -> None:
    code, told = await run(url, "task", "load", "T7", *words.split())
    assert (code, "Invalid value" in told, station.changes) == (2, True, []), told


async def test_cells_are_blocked_with_a_reason_an_end_and_robots(station: Station, url: str) -> None:
    code, told = await run(url, "block", "4", "5")
    assert (code, told) == (0, "cell 4 is blocked\ncell 5 is blocked\n")
    assert station.changes == ["PUT cells/4", "PUT cells/5"]
    station.changes.clear()
    station.bodies.clear()
    began = time.time()
    code, told = await run(
        url, "block", "4", "4>5", "--robot", "R2", "--robot", "R1", "--reason", "oil", "--for", "60"
    )
    assert (code, told.splitlines()[1].split(" until ")[0]) == (0, "the move 4>5 is blocked for R1, R2")
    assert station.changes == ["PUT zones/block 4 for R1 R2", "PUT zones/block 4>5 for R1 R2"]
    cell, move = station.bodies
    assert (cell["cells"], cell["edges"], cell["robots"], cell["reason"]) == ([4], [], ["R1", "R2"], "oil")
    assert (move["cells"], move["edges"]) == ([], [[4, 5]])
    assert 60 <= cell["until"] - began < 120


async def test_lanes_are_blocked_by_their_names(station: Station, url: str) -> None:
    code, told = await run(url, "block", "--lane", "bay", "--lane", "out")
    assert (code, told) == (0, "lane bay is blocked\nlane out is blocked\n")
    assert station.changes == ["PUT zones/block lane bay", "PUT zones/block lane out"]
    assert [zone["edges"] for zone in station.bodies] == [[[4, 12], [12, 20], [12, 4], [20, 12]], [[0, 1]]]
    code, told = await run(url, "block", "--lane", "in")
    assert (code, "unknown lane 'in'; lanes are bay, out" in " ".join(told.split())) == (2, True)


async def test_what_was_blocked_is_freed(station: Station, url: str) -> None:
    """For one robot only what was blocked for it; without one, everything of the place."""
    station.zones = [
        "block 4",
        "block 4 for R1",
        "block 4 for R1 R2",
        "block 4>5",
        "block 44",
        "block lane bay",
    ]
    assert await run(url, "free", "4", "--robot", "R1") == (0, "cell 4 is free for R1\n")
    assert station.changes == ["DELETE zones/block 4 for R1"]
    station.changes.clear()
    assert await run(url, "free", "4", "4>5", "--lane", "bay") == (
        0,
        "cell 4 is free\nthe move 4>5 is free\nlane bay is free\n",
    )
    assert station.changes == [
        *(f"DELETE zones/block 4{whom}" for whom in ("", " for R1", " for R1 R2")),
        "PUT cells/4",
        "DELETE zones/block 4>5",
        "DELETE zones/block lane bay",
    ]


@pytest.mark.parametrize("words", [("4>5",), ("--lane", "bay"), ("4", "--robot", "R1"), ("4", "4>5")])
async def test_nothing_is_freed_without_a_manager(station: Station, url: str, words: tuple[str, ...]) -> None:
    """Moves, lanes and cells for some robots are zones: nothing was done, but "is free" was printed."""
    station.has_manager = False
    code, told = await run(url, "free", *words)
    assert (code, told, station.changes) == (1, "rce fleet: the fleet manager did not answer\n", [])


async def test_cells_are_freed_without_a_manager(station: Station, url: str) -> None:
    """A fleet may have none. What it says of its zones goes to the errors."""
    station.has_manager = False
    code, told = await run(url, "free", "4")
    assert (code, station.changes) == (0, ["PUT cells/4"])
    assert told.splitlines() == [
        "rce fleet: zones are left as they are, they cannot be read: the fleet manager did not answer",
        "cell 4 is free",
    ]


async def test_a_cell_has_reason_and_end_without_a_manager(station: Station, url: str) -> None:
    """A zone needs a manager; a cell for all robots does not."""
    station.has_manager = False
    began = time.time()
    code, told = await run(url, "block", "4", "--reason", "oil", "--for", "60")
    assert (code, told.split(" until ")[0], station.changes) == (0, "cell 4 is blocked", ["PUT cells/4"])
    asked = station.bodies[-1]
    assert 60 <= asked.pop("until") - began < 120
    assert asked == {"blocked": True, "reason": "oil"}
    code, told = await run(url, "block", "4>5", "--reason", "oil")
    assert (code, told) == (1, "rce fleet: the fleet manager did not answer\n")


async def test_free_of_what_was_not_blocked_fails(station: Station, url: str) -> None:
    station.zones = ["block 4>5"]
    code, told = await run(url, "free", "4>5", "5>4", "4", "--robot", "R1")
    assert (code, station.changes) == (1, [])
    assert "not blocked by rce fleet block: the move 4>5 for R1, the move 5>4 for R1, cell 4 for R1" in told
    code, told = await run(url, "free", "5>4", "4>5")
    assert (code, station.changes) == (1, ["DELETE zones/block 4>5"])
    assert told.splitlines()[0] == "the move 4>5 is free"
    assert "not blocked by rce fleet block: the move 5>4;" in told


async def test_free_without_a_login_says_so(station: Station, url: str) -> None:
    station.wants = TOKEN
    code, told = await run(url, "free", "4")
    assert (code, "log in" in told, station.changes) == (1, True, [])


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((), "name a cell, such as 12, a move, such as 12>13, or a --lane"),
        (("4>",), "expected a cell, such as 12, or a move, such as 12>13, found '4>'"),
        (("4", "--for", "9", "--until", "23:59"), "give either --for or --until"),
        (("4", "--until", "soon"), "expected a time such as 18:30 or 2026-11-28T18:30, found 'soon'"),
        (("4", "--until", "25:00"), "expected a time such as 18:30"),
        (("4", "--until", "2020-01-01"), "2020-01-01 has passed"),
    ],
)
async def test_places_and_times_that_are_none(
    station: Station, url: str, words: tuple[str, ...], text: str
) -> None:
    code, told = await run(url, "block", *words)
    assert (code, station.changes) == (2, [])
    assert text in " ".join(told.replace("│", " ").split())
