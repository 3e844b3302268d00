"""What the page asks for before it changes a simulated world for good, and what it says of its robots."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from integration.station.test_page_operator import site
from support.planner_states import changes, robot

from rce_fleet.station.world_link import states_text, things_text

if TYPE_CHECKING:
    from playwright.async_api import Route

pytestmark = pytest.mark.needs("chromium")


async def test_a_reset_of_the_world_is_asked_for() -> None:
    async with site() as made:
        page = await made.open()
        asked: list[dict[str, Any]] = []

        async def act(route: Route) -> None:
            asked.append(json.loads(route.request.post_data or ""))
            await route.fulfill(json={"message": "done"})

        await page.route("**/api/v1/simulation", act)
        made.feed.pages.send("world", states_text([["Box1", 2.0, 2.0, 0.0]]))
        await page.locator("#view-both").click()
        for answer, sent in (("no", []), ("yes", [{"action": "reset"}])):
            await page.locator("#simulation-reset").click()
            await page.locator(f"#question-{answer}").click()
            await page.locator("#question").wait_for(state="hidden")
            if sent:
                await page.locator("#message", has_text="done").wait_for()
            assert asked == sent


async def test_robots_that_are_not_of_the_fleet_are_named() -> None:
    """A robot that was put into the world has a ROS master of its own: the fleet, and its list, lack it."""
    async with site() as made:
        page = await made.open()
        made.feed.pages.send("world", states_text([["Robot9", 2.0, 2.0, 0.0]]))
        things = {"Robot1": ["robot"], "Robot9": ["robot"], "box1": ["box", 0.5, 0.5]}
        made.feed.pages.send("things", things_text({"paused": False, "things": things}))
        await page.locator("#simulation-outside", has_text="not of the fleet: Robot9.").wait_for()
        made.feed.on_change(made.view.on_changes(changes(robot("Robot9"))))
        await page.wait_for_function("!document.querySelector('#simulation-outside').textContent")
