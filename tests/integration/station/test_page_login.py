"""The page when logins end and roles change while it has no connection."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from integration.station.test_page_operator import Planner
from support.browser import BROWSER, CHROMIUM
from support.controlled_robots import Login
from support.planner_states import robot, state
from support.ports import free_port

from rce.guard import Places
from rce.web.server import HttpServer
from rce_fleet.station import access
from rce_fleet.station.authentication import StationUser
from rce_fleet.station.feed import Feed
from rce_fleet.station.quotas import StationQuotas
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

if TYPE_CHECKING:
    from playwright.async_api import Page, Route

WAIT_MS = 60_000

pytestmark = pytest.mark.needs("chromium")


class NamedLogin(Login):
    """Users of an engine, who log in at the page."""

    has_logins = True


class Site:
    """A station that can be restarted at its address."""

    def __init__(self) -> None:
        self.login = NamedLogin()
        self.port = free_port()
        self._view = FleetView()
        self._feed = Feed(self._view)
        self._feed.on_change(self._view.on_state(state(robot("Robot1"))))

    def serve(self) -> HttpServer:
        """Return a server with a station, as a new start of it would make."""
        planner = Planner(self._view, self._feed)
        station = Station(self._view, planner, self._feed.pages, authenticator=self.login)
        return HttpServer(station.make_app(), "127.0.0.1", self.port)


@asynccontextmanager
async def opened() -> AsyncIterator[Page]:
    from playwright.async_api import async_playwright

    problems: list[str] = []
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        try:
            page = await browser.new_page(viewport={"width": 1280, "height": 900})
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.set_default_timeout(WAIT_MS)
            yield page
        finally:
            await browser.close()
    assert problems == []


async def test_a_login_that_ends_meanwhile_leads_to_the_login_page() -> None:
    """A browser does not say that its connection was refused for want of a login."""
    site = Site()
    async with opened() as page:
        async with site.serve() as server:
            await page.goto(server.url)
            await page.locator("#link.live").wait_for()
        await page.locator("#link:not(.live)").wait_for()
        await page.locator("#stages.stale").wait_for()
        site.login.user = None
        async with site.serve():
            await page.wait_for_url("**/login")


async def test_a_role_that_changes_meanwhile_counts_after_a_reconnect() -> None:
    site = Site()
    async with opened() as page:
        async with site.serve() as server:
            await page.goto(server.url)
            await page.locator("#person", has_text="operator (operator)").wait_for()
            await page.locator("#stop-all").wait_for()
        site.login.user = StationUser("operator", "viewer")
        async with site.serve():
            await page.locator("#person", has_text="operator (viewer)").wait_for()
            await page.locator("#stop-all").wait_for(state="hidden")


async def test_a_user_who_is_not_known_at_first_is_asked_for_again() -> None:
    """A viewer does not keep the buttons of operators."""
    site = Site()
    site.login.user = StationUser("guest", "viewer")
    async with opened() as page, site.serve() as server:
        refusals = 2

        async def fail(route: Route) -> None:
            nonlocal refusals
            refusals -= 1
            if refusals >= 0:
                await route.fulfill(status=503, json={"error": "no master answers"})
            else:
                await route.continue_()

        await page.route("**/api/v1/me", fail)
        await page.goto(server.url)
        await page.locator("#message.bad", has_text="no master answers").wait_for()
        await page.locator("#person", has_text="guest (viewer)").wait_for()
        await page.locator("#stop-all").wait_for(state="hidden")


async def test_a_page_that_is_one_too_many_says_so_until_it_has_a_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A browser does not say why its connection was refused."""
    quotas = StationQuotas()
    quotas.pages = Places(each=1, most=1)
    monkeypatch.setattr(access, "StationQuotas", lambda: quotas)
    async with opened() as page, Site().serve() as server:
        with quotas.pages.place("another page"):
            await page.goto(server.url)
            await page.locator("#message.bad", has_text="the station's users have 1 pages open").wait_for()
            assert await page.locator("#link").text_content() == "connecting"
        await page.locator("#link.live").wait_for()
        assert await page.locator("#message").text_content() == ""
