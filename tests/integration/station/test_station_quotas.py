"""What one user may ask of a station: no user takes it from the others."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import WSServerHandshakeError
from aiohttp.test_utils import TestClient, TestServer
from integration.station.test_page_operator import Planner
from support.fleet_station import RoleAuthenticator

from rce.guard import Places
from rce_fleet.station import access
from rce_fleet.station.authentication import StationUser
from rce_fleet.station.feed import Feed
from rce_fleet.station.quotas import PAGES_EACH, REQUESTS_PER_PAGE, REQUESTS_PER_S, StationQuotas
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

VIEWER, OPERATOR, ADMIN = ({"Authorization": f"Bearer {role}"} for role in ("viewer", "operator", "admin"))


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@asynccontextmanager
async def station(
    quotas: StationQuotas, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[TestClient[Any, Any]]:
    """A station with these quotas, whose tokens are roles."""
    monkeypatch.setattr(access, "StationQuotas", lambda: quotas)
    view = FleetView()
    feed = Feed(view)
    made = Station(view, Planner(view, feed), feed.pages, authenticator=RoleAuthenticator())
    async with TestClient(TestServer(made.make_app())) as client, asyncio.timeout(60):
        yield client


async def test_requests_of_one_user_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """An emergency stop is not, nor are other users, nor an administrator."""
    clock = Clock()
    async with station(StationQuotas(2.0, 300, clock), monkeypatch) as client:

        async def statuses(headers: dict[str, str], count: int) -> set[int]:
            return {(await client.get("/api/v1/me", headers=headers)).status for _ in range(count)}

        assert await statuses(OPERATOR, 300) == {200}
        refused = await client.get("/api/v1/me", headers=OPERATOR)
        assert (refused.status, refused.headers["Retry-After"]) == (429, "1")
        assert await refused.json() == {"error": "too many requests; try again in 1 s"}
        assert await statuses(VIEWER, 1) == {200}
        assert await statuses(ADMIN, 301) == {200}
        stop = await client.put("/api/v1/emergency-stop", json={"stopped": True}, headers=OPERATOR)
        assert (await stop.json())["error"] == "this station cannot reach robots"
        clock.now = 1.0
        assert await statuses(OPERATOR, 2) == {200}
        assert await statuses(OPERATOR, 1) == {429}


def test_requests_of_all_pages_fit_beside_other_requests() -> None:
    """Half of the pages that a user may open took all of the user's requests, so that clicks were refused."""
    clock, user = Clock(), StationUser("operator", "operator")
    quotas = StationQuotas(clock=clock)
    with ExitStack() as stack:
        for _ in range(PAGES_EACH):
            stack.enter_context(quotas.pages.place(user.name))
        while not quotas.request(user):
            pass
        for clock.now in range(1, 61):
            asked = int(REQUESTS_PER_S + PAGES_EACH * REQUESTS_PER_PAGE)
            assert [quotas.request(user) for _ in range(asked)] == [0] * asked
            assert quotas.request(user) == 1
    clock.now += 1
    assert sum(not quotas.request(user) for _ in range(1000)) == REQUESTS_PER_S


async def test_pages_are_bounded_for_each_user_and_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    quotas = StationQuotas()
    quotas.pages = Places(each=2, most=3)
    async with station(quotas, monkeypatch) as client, AsyncExitStack() as stack:

        async def open_page(headers: dict[str, str]) -> Any:
            return await stack.enter_async_context(client.ws_connect("/api/v1/live", headers=headers))

        first, _ = [await open_page(VIEWER) for _ in range(2)]
        for headers, text in ((VIEWER, "you have 2 pages open"), (ADMIN, "the station's users have 3 pages")):
            with pytest.raises(WSServerHandshakeError, match="429"):
                await open_page(headers)
            answer = await client.get("/api/v1/live", headers=headers)
            assert (answer.status, text in (await answer.json())["error"]) == (429, True)
            if headers is VIEWER:
                await open_page(OPERATOR)
        await first.close()
        while len(quotas.pages) == 3:
            await asyncio.sleep(0.01)
        await open_page(ADMIN)


async def test_streams_of_events_are_bounded_for_each_user(monkeypatch: pytest.MonkeyPatch) -> None:
    quotas = StationQuotas()
    quotas.streams = Places(each=1, most=2)
    async with station(quotas, monkeypatch) as client, AsyncExitStack() as stack:

        async def follow(headers: dict[str, str]) -> Any:
            accept = {"Accept": "text/event-stream"}
            return await stack.enter_async_context(client.get("/api/v1/events", headers=headers | accept))

        assert (await follow(VIEWER)).status == 200
        refused = await follow(VIEWER)
        assert (refused.status, "you have 1 streams" in (await refused.json())["error"]) == (429, True)
        assert (await client.get("/api/v1/history?format=csv", headers=VIEWER)).status == 429
        assert (await follow(OPERATOR)).status == 200
        assert "users have 2" in (await (await follow(ADMIN)).json())["error"]
