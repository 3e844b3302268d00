"""The station asks one of several masters who its users are."""

from __future__ import annotations

import asyncio
import contextlib

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.absent_masters import silent_master, unreachable_port

from rce_fleet.station.authentication import AuthenticationError
from rce_fleet.station.engine_authenticator import EngineAuthenticator, StationAccount


@pytest.mark.parametrize("fault", ["hangs", "is off"])
async def test_a_master_that_answers_nothing_is_passed_over(
    fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its program hangs, or its machine is off: another one tells who the user is."""
    short = aiohttp.ClientTimeout(total=600, sock_connect=1, sock_read=2)
    monkeypatch.setattr("rce_fleet.station.engine_authenticator._TIMEOUT_OF_SEVERAL", short)
    logins = 0

    async def user(_: web.Request) -> web.Response:
        return web.json_response({"name": "alice", "role": "operator"})

    async def log_in(_: web.Request) -> web.Response:
        nonlocal logins
        logins += 1
        return web.json_response({"token": "t", "role": "operator"})

    app = web.Application()
    app.router.add_get("/api/v1/user", user)
    app.router.add_post("/api/v1/login", log_in)
    async with TestServer(app) as master, contextlib.AsyncExitStack() as stack, asyncio.timeout(60):
        if fault == "hangs":
            absent, _ = await stack.enter_async_context(silent_master())
        else:
            absent = f"http://127.0.0.1:{stack.enter_context(unreachable_port())}/"
        account = StationAccount(f"{absent},{master.make_url('/')}", "alice", "secret")
        async with EngineAuthenticator(account) as authenticator:
            found = await authenticator.authenticate("a token")
            assert found is not None
            assert found.name == "alice"
        async with EngineAuthenticator(account) as authenticator:
            if fault == "is off":
                await authenticator.log_in("alice", "secret", "127.0.0.1")
            else:  # it may have made a token
                with pytest.raises(AuthenticationError, match="the engine cannot be reached"):
                    await authenticator.log_in("alice", "secret", "127.0.0.1")
    assert logins == (fault == "is off")
