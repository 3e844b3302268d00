"""The station's OpenAPI document is true: requests made of it, good and bad, are answered as it says."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest
from support.fuzzing import Tracebacks, answers_of
from support.master_program import master

from rce.web.server import HttpServer
from rce_fleet.station.authentication import AuthenticationError
from rce_fleet.station.desired import DesiredCell
from rce_fleet.station.engine_authenticator import EngineAuthenticator, StationAccount
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.live import Broadcast
from rce_fleet.station.planner_client import PlannerError
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

if TYPE_CHECKING:
    from pathlib import Path

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
            "id": "0",
            "state": "driving",
            "reason": "",
            "cell": 0,
            "goal": -1,
            "plan": [0, 2],
            "granted": [0],
            "replans": 1,
        }
    ],
}


GRID_ANSWER = {"rows": 2, "columns": 2, "walls": [3], "blocked_share": 0.1}

EVENTS = '{"events": [], "next": 0, "journal": "ab", "newest": 0}'


class Planner(FleetLink):
    """Does what it is asked for, or refuses it, by turns."""

    can_ask_manager = expects_manager = False

    def __init__(self) -> None:
        """Need no wire to a planner."""
        self._asked = 0

    async def set_goal(self, robot: str, cell: int | None) -> str:
        return self._answer()

    async def block_cell(self, wanted: DesiredCell) -> str:
        return self._answer()

    async def set_grid(self, choice: dict[str, Any], *, preview: bool) -> dict[str, Any]:
        return {**GRID_ANSWER, "message": self._answer()}

    async def set_mode(self, robot: str, mode: str, *, reason: str, user: str) -> str:
        return self._answer()

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer as the manager does to what it does not know."""
        if request["path"].startswith("/events?after="):
            return {"status": 200, "body": EVENTS, "revision": ""}
        return {"status": 404, "body": '{"error": "unknown"}', "revision": ""}

    def _answer(self) -> str:
        self._asked += 1
        if self._asked % 2:
            raise PlannerError("refused")
        return "done"


async def token_of(authenticator: EngineAuthenticator) -> str:
    """Log in; the first password that a master checks takes long on a loaded machine."""
    async with asyncio.timeout(150):
        while True:
            with contextlib.suppress(AuthenticationError):
                return await authenticator.log_in("testUser", "testUser", "")
            await asyncio.sleep(0.5)


# The library uses random numbers of its own within its strategies.
@pytest.mark.filterwarnings("ignore::hypothesis.errors.HypothesisDeprecationWarning")
async def test_answers_are_those_of_the_document(tmp_path: Path) -> None:
    """With the logins of a real master."""
    async with (
        master(tmp_path, "--dev") as url,
        aiohttp.ClientSession() as session,
        EngineAuthenticator(StationAccount(url, "testUser", "testUser")) as authenticator,
    ):
        token = await token_of(authenticator)
        view = FleetView()
        view.on_state(STATE)
        app = Station(view, Planner(), Broadcast(), authenticator=authenticator).make_app()
        async with HttpServer(app, "127.0.0.1", 0) as server:
            async with session.get(f"{server.url}api/v1/openapi.json") as reply:
                document: dict[str, Any] = await reply.json()
            for path, operations in document["paths"].items():
                for method, operation in operations.items():
                    assert "default" not in operation["responses"], (method, path)
            del document["paths"]["/api/v1/login"]["delete"]  # it would end the token
            with Tracebacks().watching() as log:
                answered = await asyncio.to_thread(answers_of, document, server.url.rstrip("/"), token)
    assert answered > len(document["paths"])
    assert not log.found


@pytest.mark.parametrize("number", ["9" * 5000, "2147483648", "-1", "²", "1e3"])
async def test_unknown_cell_number_is_not_found(number: str) -> None:
    app = Station(FleetView(), Planner(), Broadcast()).make_app()
    async with HttpServer(app, "127.0.0.1", 0) as server, aiohttp.ClientSession() as session:
        with Tracebacks().watching() as log:
            url = f"{server.url}api/v1/cells/{number}"
            async with session.put(url, json={"blocked": True}) as reply:
                assert reply.status == 404
                assert "is not the number of a cell" in (await reply.json())["error"]
    assert not log.found
