"""What the page asks for before it does what undo does not take back."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from integration.station.test_page_operator import site

from rce_fleet.station.world_link import states_text

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
