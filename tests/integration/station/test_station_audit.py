"""What a station's users did gets into the engine's audit log, whatever happens meanwhile."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer

from rce.aio.backoff import Backoff
from rce_fleet.station import action_queue
from rce_fleet.station.authentication import AuditedAction
from rce_fleet.station.engine_authenticator import EngineAuthenticator, StationAccount

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

GOAL = AuditedAction("set_goal", "R1", "cell 7", "192.0.2.7")


class FakeMaster:
    """Knows tokens, and notes actions."""

    def __init__(self) -> None:
        self.users = {"anna's": "anna"}
        self.failures: list[int] = []
        """Statuses of its next answers to actions."""
        self.noted: list[tuple[str, str, str]] = []
        """User, detail and address."""
        self.app = web.Application()
        self.app.router.add_get("/api/v1/user", self._user)
        self.app.router.add_post("/api/v1/login", self._log_in)
        self.app.router.add_delete("/api/v1/login", self._log_out)
        self.app.router.add_post("/api/v1/audit", self._note)

    def _user_of(self, request: web.Request) -> str:
        try:
            return self.users[request.headers["Authorization"].removeprefix("Bearer ")]
        except KeyError:
            raise web.HTTPUnauthorized from None

    async def _user(self, request: web.Request) -> web.Response:
        return web.json_response({"name": self._user_of(request), "role": "operator"})

    async def _log_in(self, request: web.Request) -> web.Response:
        body: dict[str, Any] = await request.json()
        token = f"{body['userID']}'s {len(self.users)}"
        self.users[token] = body["userID"]
        return web.json_response({"token": token, "role": "operator"})

    async def _log_out(self, request: web.Request) -> web.Response:
        del self.users[request.headers["Authorization"].removeprefix("Bearer ")]
        return web.Response(status=204)

    async def _note(self, request: web.Request) -> web.Response:
        if self.failures:
            return web.Response(status=self.failures.pop(0))
        user = self._user_of(request)
        body = await request.json()
        self.noted.append((user, body["detail"], body["address"]))
        return web.Response(status=204)

    async def until_noted(self, count: int) -> None:
        async with asyncio.timeout(60):
            while len(self.noted) < count:
                await asyncio.sleep(0.01)

    @asynccontextmanager
    async def authenticator(self) -> AsyncIterator[EngineAuthenticator]:
        async with TestServer(self.app) as server:
            account = StationAccount(str(server.make_url("/")), "fleet", "secret")
            async with EngineAuthenticator(account) as authenticator:
                yield authenticator


@pytest.fixture
def master(monkeypatch: pytest.MonkeyPatch) -> FakeMaster:
    monkeypatch.setattr(action_queue, "PAUSES", Backoff(first=0.01, longest=0.01))
    return FakeMaster()


@pytest.mark.parametrize("status", [429, 500, 503])
async def test_an_action_is_sent_until_it_is_taken(master: FakeMaster, status: int) -> None:
    master.failures = [status, status]
    async with master.authenticator() as authenticator:
        await authenticator.authenticate("anna's")
        authenticator.audit("anna's", GOAL)
        await master.until_noted(1)
    assert master.noted == [("anna", "cell 7", "192.0.2.7")]


async def test_what_waits_is_sent_before_a_station_ends(master: FakeMaster) -> None:
    async with master.authenticator() as authenticator:
        for _ in range(3):
            authenticator.audit("", GOAL)
    assert master.noted == [("fleet", "cell 7", "192.0.2.7")] * 3


async def test_the_station_tells_for_a_user_whose_token_has_ended(master: FakeMaster) -> None:
    """The user logged out before the action was sent. The station's own token has ended, too."""
    async with master.authenticator() as authenticator:
        authenticator.audit("", GOAL)
        await master.until_noted(1)
        await authenticator.authenticate("anna's")
        master.users.clear()
        authenticator.audit("anna's", GOAL)
        await master.until_noted(2)
    assert master.noted[1] == ("fleet", "by anna, whose permission has ended: cell 7", "192.0.2.7")


async def test_an_action_that_is_refused_is_dropped(
    master: FakeMaster, caplog: pytest.LogCaptureFixture
) -> None:
    master.failures = [422]
    async with master.authenticator() as authenticator:
        await authenticator.authenticate("anna's")
        for _ in range(2):
            authenticator.audit("anna's", GOAL)
        await master.until_noted(1)
    assert "not in the audit log: set_goal R1 by anna: 422 Unprocessable Entity" in caplog.messages
