"""A station that notes what ``rce fleet`` asks it for."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

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
from rce_fleet.api.tasks import TaskModel, TaskPage
from rce_fleet.cli.commands import app as commands
from rce_fleet.station.api import Answer
from rce_fleet.station.commands.routes import StopAnswer

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


@asynccontextmanager
async def served(handler: Callable[[web.Request], Awaitable[web.Response]]) -> AsyncIterator[str]:
    """Serve all requests by one handler; give the address."""
    app = web.Application()
    app.router.add_route("*", "/{path:.*}", handler)
    async with TestServer(app) as server:
        yield str(server.make_url("/"))


async def run(url: str, *words: str) -> tuple[int, str]:
    """Run a command in a thread; return its exit code, and what it prints."""

    def invoke() -> tuple[int, str]:
        found = CliRunner().invoke(commands, words, env={"RCE_STATION": url})
        return found.exit_code, found.output

    return await asyncio.to_thread(invoke)
