"""The replay of the page while the station is slow to answer."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import pytest
from integration.station.test_page_operator import fill_records, site

if TYPE_CHECKING:
    from playwright.async_api import Route

pytestmark = pytest.mark.needs("chromium")


async def test_a_slow_answer_is_shown_while_the_page_plays() -> None:
    """An answer takes longer than the time between two moments that are played.

    Moments of another day are shown with their date.
    """
    async with site() as made:
        start = time.time() - 90_000
        await fill_records(made, start)
        page = await made.open()

        async def delay(route: Route) -> None:
            await asyncio.sleep(1.5)
            await route.continue_()

        await page.route("**/api/v1/replay/*", delay)
        await page.evaluate("at => void rceFleet.replay.show(at)", start + 10.4)
        await page.locator("#replay-play:enabled").click()
        await page.wait_for_function("rceFleet.replay.shown > 0")
        await page.wait_for_function("at => rceFleet.replay.shown >= at", arg=start + 12)
        shown = "document.querySelector('#replay-at').textContent"
        await page.wait_for_function(f"{shown} === new Date(1000 * rceFleet.replay.at).toLocaleString()")


async def test_a_drag_of_the_slider_loads_one_moment_at_a_time() -> None:
    """The first one, and then the newest."""
    async with site() as made:
        await fill_records(made, time.time() - 100)
        page = await made.open()
        running: list[str] = []
        counts: list[int] = []

        async def delay(route: Route) -> None:
            running.append(route.request.url)
            counts.append(len(running))
            await asyncio.sleep(0.5)
            running.remove(route.request.url)
            await route.continue_()

        await page.route("**/api/v1/replay/*", delay)
        await page.evaluate(
            """() => {
                const slider = document.querySelector("#replay-time");
                for (let value = 900; value >= 100; value -= 40) {
                    slider.value = value;
                    slider.dispatchEvent(new Event("input"));
                }
            }"""
        )
        await page.wait_for_function("rceFleet.replay.at && rceFleet.replay.shown === rceFleet.replay.at")
        robots = "[...rceFleet.view.scene.replay.robots.keys()].sort()"
        assert await page.evaluate(robots) == ["Robot1", "Robot2"]
        assert counts == [1, 1]
        assert await page.locator("#replay-at", has_text="loading").count() == 0
