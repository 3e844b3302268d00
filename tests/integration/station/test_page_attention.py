"""What the page lists as needing attention: of robots that are out, and beyond the first rows."""

from __future__ import annotations

import pytest
from integration.station.test_page_operator import site
from support.planner_states import changes, robot

from rce_fleet.station.world_link import things_text

pytestmark = pytest.mark.needs("chromium")


async def test_robots_that_people_took_out_need_no_attention() -> None:
    """They are switched off for a repair, and listed for all of it, they would hide others."""
    async with site() as made:
        page = await made.open()

        def tell(mode: str) -> None:
            change = changes(robot("Robot1", state="silent", mode=mode), robot("Robot2", state="unreachable"))
            made.feed.on_change(made.view.on_changes(change))

        listed = page.locator("#attention-list li", has_text="Robot1")
        for mode in ("out_of_service", "dead"):
            tell("automatic")
            await listed.wait_for()
            tell(mode)
            await listed.wait_for(state="detached")
            assert await page.inner_text("#attention-count") == "1"
        made.feed.on_control({"Robot1": "ada"}, {}, None, ["Robot1"])
        await listed.locator("text=it may drive").wait_for()


async def test_all_that_needs_attention_can_be_shown() -> None:
    async with site() as made:
        page = await made.open()
        silent = [robot(f"Robot{number}", state="silent") for number in range(1, 31)]
        made.feed.on_change(made.view.on_changes(changes(*silent)))
        more = page.locator("#attention-list button", has_text="and 10 more")
        await more.click()
        await page.wait_for_function("document.querySelectorAll('#attention-list li').length === 30")
        await page.locator("#attention-list li", has_text="Robot30").wait_for()
        assert await more.count() == 0


async def test_a_light_robot_is_not_localized() -> None:
    """It has no topic for it: the request was offered, and refused."""
    async with site() as made:
        page = await made.open()
        made.feed.pages.send("things", things_text({"paused": False, "things": {"Robot1": ["light"]}}))
        await page.wait_for_function("rceFleet.fleet.things.Robot1")
        localize = page.locator("#robot-card button", has_text="Localize")
        await page.locator("tr[data-robot=Robot2]").click()
        await localize.wait_for()
        await page.locator("tr[data-robot=Robot1]").click()
        await localize.wait_for(state="detached")
        await page.evaluate("void rceFleet.actions.setPose('Robot1', 1, 1, 0)")
        await page.locator("text=it always knows where it is").first.wait_for()
