"""The page in a browser follows changes, and gets everything again when one is missing."""

from __future__ import annotations

import json

import pytest
from aiohttp.test_utils import TestServer
from support.browser import BROWSER, CHROMIUM
from support.planner_states import changes, pose, robot, state

from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

WAIT_MS = 40_000

SHOWN = """() => {
    const { robots, blocked, pending, sequence } = rceFleet.fleet;
    return {
        goals: Object.fromEntries([...robots.values()].map(r => [r.id, r.goal])),
        poses: Object.fromEntries([...robots.values()].map(r => [r.id, r.pose && r.pose.x])),
        blocked: [...blocked].sort(), pending: [...pending].sort(), sequence,
    };
}"""


@pytest.mark.needs("chromium")
async def test_the_page_follows_changes_and_repairs_gaps() -> None:
    from playwright.async_api import async_playwright

    view = FleetView()
    feed = Feed(view)
    fleet = FleetLink.__new__(FleetLink)  # the page sends nothing
    feed.on_change(view.on_state(state(robot("Robot1"), robot("Robot2"), blocked=[5])))
    view.on_pose("Robot1", pose(1.5, 0.5, 0.0))
    app = Station(view, fleet, feed.pages).make_app()
    async with TestServer(app) as server, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        try:
            page = await browser.new_page()
            page.set_default_timeout(WAIT_MS)
            await page.goto(str(server.make_url("/")))

            async def shows(**wanted: object) -> None:
                await page.wait_for_function(
                    f"wanted => {{ const shown = ({SHOWN})(); return Object.entries(wanted).every("
                    "([key, value]) => JSON.stringify(shown[key]) === JSON.stringify(value)); }",
                    arg=wanted,
                )

            await shows(goals={"Robot1": None, "Robot2": None}, blocked=[5], sequence=1)
            await shows(poses={"Robot1": 1.5, "Robot2": None})
            change = changes(robot("Robot2", goal=7), removed=["Robot1"], blocked=[8], pending=[9], freed=[5])
            feed.on_change(view.on_changes(change))
            await shows(goals={"Robot2": 7}, blocked=[8], pending=[9], sequence=2)
            text = await page.inner_text("#events")
            assert "cell 8 is blocked" in text
            assert "cell 5 is free" in text
            await page.wait_for_function("document.querySelectorAll('tr[data-robot]').length === 1")

            # A change is missing: the page connects anew and gets everything.
            view.on_changes(changes(robot("Robot2", goal=11)))
            feed.pages.send_change(
                json.dumps({"type": "changes", "sequence": 4, **changes(robot("Robot2", goal=99))})
            )
            await shows(goals={"Robot2": 11}, sequence=2)
            feed.on_change(view.on_changes(changes(robot("Robot2", goal=12))))
            await shows(goals={"Robot2": 12}, sequence=3)
        finally:
            await browser.close()
