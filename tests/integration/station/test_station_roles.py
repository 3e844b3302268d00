"""The engine's users at a station: API, page and audit log, against a real master."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.browser import CHROMIUM
from support.engine import until
from support.master_program import master
from yarl import URL

from rce.web.bodies import read_whole
from rce_fleet.station import access, engine_authenticator, page_socket
from rce_fleet.station.desired import DesiredCell
from rce_fleet.station.engine_authenticator import CACHE_S, EngineAuthenticator, StationAccount
from rce_fleet.station.live import Broadcast
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

pytestmark = pytest.mark.timeout(180)

ROLES = ("viewer", "user", "operator", "admin")


class RecordingFleet:
    """Takes requests in place of a planner."""

    can_ask_manager = expects_manager = False

    def __init__(self) -> None:
        self.desired: list[tuple[Any, ...]] = []

    async def set_goal(self, robot: str, cell: int | None) -> str:
        self.desired.append((robot, cell))
        return "done"

    async def block_cell(self, wanted: DesiredCell) -> str:
        self.desired.append((wanted.cell, wanted.blocked))
        return "done"

    async def set_grid(self, choice: dict[str, Any], *, preview: bool) -> dict[str, Any]:
        self.desired.append((choice["cell_size"], preview))
        return {"message": "done", "rows": 2, "columns": 2, "walls": [], "blocked_share": 0.1}


class Site:
    """A master with a user of each role, and a station of testUser's fleet."""

    def __init__(self, url: str, session: aiohttp.ClientSession) -> None:
        self.url = url
        self.session = session
        self.fleet = RecordingFleet()
        self.station = ""
        self.tokens: dict[str, str] = {}

    async def master(
        self, method: str, path: str, body: object = None, *, token: str = "", status: int = 200
    ) -> Any:
        headers = {"Authorization": f"Bearer {token or self.tokens['testUser']}"} if self.tokens else {}
        async with self.session.request(
            method, f"{self.url}api/v1{path}", json=body, headers=headers
        ) as reply:
            assert reply.status == status, await reply.text()
            return await reply.json() if reply.status in (200, 201) else None

    async def log_in(self, user: str, password: str) -> None:
        body = {"userID": user, "password": password}
        self.tokens[user] = (await self.master("POST", "/login", body))["token"]

    async def steer(self, token: str) -> int:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        url = f"{self.station}api/v1/robots/Robot1/goal"
        async with self.session.put(url, json={"cell": 7}, headers=headers) as reply:
            return reply.status

    async def lay_grid(self, token: str) -> int:
        url, headers = f"{self.station}api/v1/grid", {"Authorization": f"Bearer {token}"}
        async with self.session.put(url, json={"cell_size": 2}, headers=headers) as reply:
            return reply.status

    async def look(self, token: str) -> int:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        async with self.session.get(f"{self.station}api/v1/fleet", headers=headers) as reply:
            return reply.status


@contextlib.asynccontextmanager
async def running_site(folder: Path, *, open_: bool = False) -> AsyncIterator[Site]:
    async with (
        master(folder, "--dev") as url,
        aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar()) as session,
        EngineAuthenticator(
            StationAccount(url, "testUser", "testUser"), allow_anonymous=open_
        ) as authenticator,
    ):
        site = Site(url, session)
        await site.log_in("testUser", "testUser")
        for role in ROLES:
            await site.master("POST", "/users", {"name": role, "password": "pw", "role": role}, status=201)
            await site.log_in(role, "pw")
        view = FleetView()
        size = {"rows": 4, "columns": 4, "cell_size": 1.0, "origin_x": 0.0, "origin_y": 0.0}
        view.on_state({**size, "walls": [], "blocked": [], "pending": [], "robots": []})
        app = Station(view, site.fleet, Broadcast(), authenticator=authenticator).make_app()  # type: ignore[arg-type]  # as wide as what is called
        async with TestServer(app) as server:
            site.station = str(server.make_url("/"))
            yield site


async def test_roles_at_station_and_audit(tmp_path: Path) -> None:
    async with running_site(tmp_path) as site:
        expected = {
            "viewer": (200, 403),
            "user": (403, 403),  # of another fleet
            "operator": (200, 200),
            "admin": (200, 200),
            "testUser": (200, 200),  # whose fleet it is
        }
        found = {who: (await site.look(token), await site.steer(token)) for who, token in site.tokens.items()}
        assert found == expected
        assert await site.look("") == await site.look("rce_guess") == 401
        assert site.fleet.desired == [("Robot1", 7)] * 3
        laid = [await site.lay_grid(site.tokens[who]) for who in ("viewer", "operator")]
        assert (laid, site.fleet.desired[3:]) == ([403, 200], [(2.0, False)])
        robot = (await site.master("POST", "/robot-tokens", {"robot": "R1"}, status=201))["token"]
        assert await site.look(robot) == 401, "a robot's token is for robots"

        for who in ("viewer", "operator"):
            made = await site.master("POST", f"/tokens?user={who}", {"scope": "fleet"}, status=201)
            assert (await site.look(made["token"]), await site.steer(made["token"])) == expected[who]

        actions = ("set_goal", "set_grid")

        async def noted() -> list[tuple[str, str, str]]:
            records = (await site.master("GET", "/audit?since=-1000"))["records"]
            return [(r["user"], r["detail"], r["outcome"]) for r in records if r["action"] in actions]

        wanted = {
            ("viewer", "", "refused"),
            ("operator", "cell 7", "done"),
            ("operator", "2 x 2 cells of 2 m at (0.0, 0.0), yaw 0", "done"),
            ("admin", "cell 7", "done"),
            ("testUser", "cell 7", "done"),
        }

        async def complete() -> bool:
            return set(await noted()) == wanted

        await until(complete, what="the station's actions are in the audit log")


async def test_revoked_token_ends_open_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_socket, "CHECK_S", 0.2)
    async with running_site(tmp_path) as site:
        headers = {"Authorization": f"Bearer {site.tokens['operator']}"}
        async with site.session.ws_connect(f"{site.station}api/v1/live", headers=headers) as socket:
            (token,) = (await site.master("GET", "/tokens?user=operator"))["tokens"]
            await site.master("DELETE", f"/tokens/{token['id']}?user=operator", status=204)
            while (message := await socket.receive(timeout=CACHE_S + 60)).type != aiohttp.WSMsgType.CLOSE:
                assert message.type is aiohttp.WSMsgType.TEXT
        assert (message.data, message.extra) == (1008, "your login has ended; log in again")
        assert await site.steer(site.tokens["operator"]) == 401


async def test_open_station_acts_as_its_user(tmp_path: Path) -> None:
    """On loopback nobody logs in; what is done counts as done by the station's user."""
    async with running_site(tmp_path, open_=True) as site:
        assert await site.steer("") == 200
        assert await site.steer(site.tokens["viewer"]) == 403

        async def noted() -> bool:
            records = (await site.master("GET", "/audit?since=-1000"))["records"]
            return any(r["action"] == "set_goal" and r["user"] == "testUser" for r in records)

        await until(noted, what="the action is in the audit log")


async def test_open_station_drops_the_cookie_of_another_engine(tmp_path: Path) -> None:
    """A station with logins may have had the same address before; a token that is sent must be valid."""
    async with running_site(tmp_path, open_=True) as site:
        name = f"rce_station_{URL(site.station).port}"
        for path, status in (("", 200), ("api/v1/fleet", 200), ("api/v1/fleet?token=old", 401)):
            left_over = {"Cookie": f"{name}=left-over"}
            async with site.session.get(site.station + path, headers=left_over) as reply:
                assert reply.status == status
                assert (status == 401) != (name in reply.cookies and reply.cookies[name]["max-age"] == "0")
        async with site.session.get(
            f"{site.station}api/v1/me", headers={"Cookie": f"{name}={site.tokens['viewer']}"}
        ) as reply:
            assert (await reply.json())["name"] == "viewer"
            assert name not in reply.cookies


@pytest.mark.needs("chromium")
async def test_page_asks_for_login(tmp_path: Path) -> None:
    """A viewer logs in at the page, looks, cannot steer, and logs out; a wrong password is told."""
    from playwright.async_api import async_playwright

    async with running_site(tmp_path) as site, async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--no-first-run"]
        )
        try:
            page = await browser.new_page()
            page.set_default_timeout(60_000)
            await page.goto(site.station)
            await page.fill("#user", "viewer")
            await page.fill("#password", "wrong")
            await page.click("button[type=submit]")
            await page.wait_for_function(
                "document.querySelector('#message').textContent.includes('password')"
            )
            await page.fill("#password", "pw")
            await page.click("button[type=submit]")
            await page.wait_for_function("document.querySelector('#link')?.textContent === 'live'")
            await page.wait_for_function(
                "document.querySelector('#person').textContent === 'viewer (viewer)'"
            )
            assert not await page.is_visible("#tool-block")
            assert "rce_" not in await page.evaluate("document.cookie"), "no script reads the token"
            status = await page.evaluate(
                "fetch('/api/v1/cells/7', {method: 'PUT', body: '{\"blocked\": true}'}).then(r => r.status)"
            )
            assert status == 403
            await page.click("#logout")
            await page.wait_for_selector("#login")
            assert await page.evaluate("fetch('/api/v1/fleet').then(r => r.status)") == 401
        finally:
            await browser.close()
    assert site.fleet.desired == []


async def test_slow_body_of_ended_login_controls_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The user's role changes between the head of a request and the end of its body."""
    monkeypatch.setattr(access, "SLOW_BODY_S", 0.0)
    monkeypatch.setattr(engine_authenticator, "CACHE_S", 0.0)
    is_reading = asyncio.Event()

    async def read_noted(request: web.Request) -> bytes:
        is_reading.set()
        return await read_whole(request)

    monkeypatch.setattr(access, "read_whole", read_noted)
    async with running_site(tmp_path) as site:

        async def late_body(change: str) -> AsyncIterator[bytes]:
            yield b'{"cell": '
            await is_reading.wait()
            await site.master("PUT", "/users/operator/role", {"role": change}, status=204)
            yield b"7}"

        url = f"{site.station}api/v1/robots/Robot1/goal"
        headers = {"Authorization": f"Bearer {site.tokens['operator']}"}
        for change, status in (("operator", 200), ("viewer", 401)):
            is_reading.clear()
            async with site.session.put(url, data=late_body(change), headers=headers) as reply:
                assert reply.status == status
        assert site.fleet.desired == [("Robot1", 7)]
