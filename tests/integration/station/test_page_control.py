"""What reaches a robot without the planner, done on the page: stops, initial poses, driving by hand."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from integration.station.test_page_operator import drag
from support.browser import BROWSER, CHROMIUM, FEW_FRAMES
from support.controlled_robots import Site, site

if TYPE_CHECKING:
    from playwright.async_api import Page

WAIT_MS = 60_000

pytestmark = pytest.mark.needs("chromium")


@asynccontextmanager
async def opened(made: Site) -> AsyncIterator[Page]:
    """The page with Robot1 selected."""
    from playwright.async_api import async_playwright

    problems: list[str] = []
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        try:
            page = await browser.new_page(viewport={"width": 1280, "height": 1000})
            await page.add_init_script(FEW_FRAMES)
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.set_default_timeout(WAIT_MS)
            await page.goto(str(made.client.make_url("/")))
            await page.locator("tr[data-robot=Robot1]").click()
            yield page
        finally:
            await browser.close()
    assert problems == []


async def check_stops(made: Site, page: Page) -> None:
    """One robot by its card, all by the header; a stopped robot needs attention.

    The topic is latched: a message may come twice.
    """
    await page.locator("#robot-card button", has_text="Stop").click()
    await made.until(lambda: made.stops and made.stops[-1])
    await page.locator("#attention-list button", has_text="Release").click()
    await page.keyboard.press("Escape")  # the question is answered by no
    await page.locator("#question").wait_for(state="hidden")
    assert made.stops[-1]
    await page.locator("#attention-list button", has_text="Release").click()
    await page.keyboard.press("Tab")
    await page.keyboard.press("Enter")
    await made.until(lambda: not made.stops[-1])
    await page.locator("#stop-all").click()
    await made.until(lambda: made.stops[-1])
    await page.locator("#release-all").wait_for()
    await page.locator("#release-all").click()
    await page.locator("#question-yes").click()
    await made.until(lambda: not made.stops[-1])
    await page.locator("#release-all").wait_for(state="hidden")


async def check_missed(page: Page) -> None:
    """Robot2 does not listen: the page says so as long as its stop is not delivered."""
    await page.locator("#stop-all").click()
    await page.locator("#message.bad", has_text="Robot1 reached, 1 not reached; not Robot2").wait_for()
    await page.locator("#events .bad", has_text="not Robot2").wait_for()
    await page.locator("#attention-list li.severe", has_text="has not reached it").first.wait_for()
    first = await page.locator("#attention-list li").first.inner_text()
    assert first.startswith("!!Robot2"), first
    assert ("Stop" in first, "Release" in first) == (True, True)
    await page.locator("tr[data-robot=Robot2]", has_text="idle, stop not delivered").wait_for()
    await page.locator("tr[data-robot=Robot1]", has_text="e-stop").wait_for()
    await page.locator("tr[data-robot=Robot2]").click()
    for name in ("Stop", "Release"):
        await page.locator("#robot-card button", has_text=name).wait_for()
    await page.locator("#release-all").click()
    await page.locator("#question-yes").click()
    await page.locator("tr[data-robot=Robot2]", has_text="stop not delivered").wait_for(state="detached")


async def check_pose(made: Site, page: Page) -> None:
    """A drag says where the robot is and in which direction it looks; two cells do without a pointer."""
    await page.locator("#robot-card button", has_text="Localize").click()
    await drag(page, 18, 34)
    await made.until(lambda: made.poses)
    pose = made.poses[0].pose.pose
    assert (pose.position.x, pose.position.y) == pytest.approx((2.5, 2.5), abs=0.05)
    assert pose.orientation.z == pytest.approx(0.7071, abs=0.02), "up: a quarter turn"
    await page.locator("#map").focus()
    await page.evaluate("rceFleet.view.cursorCell = 10")
    for key in ("Enter", "ArrowLeft", "Enter"):
        await page.keyboard.press(key)
    await made.until(lambda: len(made.poses) > 1)
    pose = made.poses[1].pose.pose
    assert (pose.position.x, pose.position.y) == pytest.approx((2.5, 1.5))
    assert abs(pose.orientation.z) == pytest.approx(1.0, abs=0.02), "left: half a turn"


GAMEPAD = """() => {
    rceFleet.gamepad = { connected: true, axes: [0, -1], buttons: Array(8).fill({ pressed: false }) };
    navigator.getGamepads = () => [null, rceFleet.gamepad];
}"""
"""A gamepad whose stick is pushed forward."""


async def check_gamepad(made: Site, page: Page) -> None:
    """It drives while a shoulder button is pressed, but not a page that is hidden or not in focus.

    A browser does not tell a gamepad's changes to such a page.
    """
    await page.evaluate(GAMEPAD)
    made.velocities.clear()
    await made.until(lambda: len(made.velocities) > 1)
    assert set(made.velocities) == {(0.0, 0.0)}
    await page.evaluate("void (rceFleet.gamepad.buttons[5] = { pressed: true })")
    await made.until(lambda: made.velocities[-1] == pytest.approx((0.35, 0.0)))
    for lost, back in (
        ("document.hasFocus = () => false", "delete document.hasFocus"),
        (
            "Object.defineProperty(document, 'hidden', { value: true, configurable: true })",
            "delete document.hidden",
        ),
    ):
        await page.evaluate(f"void ({lost})")
        await made.until(lambda: made.velocities[-1] == (0.0, 0.0))
        await page.evaluate(f"void ({back})")
        await made.until(lambda: made.velocities[-1] == pytest.approx((0.35, 0.0)))
    await page.evaluate("void (navigator.getGamepads = () => [])")
    await made.until(lambda: made.velocities[-1] == (0.0, 0.0))


async def check_drive(made: Site, page: Page) -> None:
    """Keys drive while the switch is held, the stick by itself; the round trip is shown."""
    await page.locator("#robot-card button", has_text="Drive by hand").click()
    await page.locator("#drive-latency", has_text="round trip to the station").wait_for()
    await page.keyboard.down("ArrowUp")
    await page.keyboard.down("Space")
    await made.until(lambda: made.velocities and made.velocities[-1] == pytest.approx((0.35, 0.0)))
    await page.keyboard.up("Space")
    await made.until(lambda: made.velocities[-1] == (0.0, 0.0))
    await page.keyboard.up("ArrowUp")
    await check_gamepad(made, page)
    pad = await page.locator("#drive-pad").bounding_box()
    assert pad is not None
    x, y = pad["x"] + pad["width"] / 2, pad["y"] + pad["height"] / 2
    await page.mouse.move(x, y)
    await page.mouse.down()
    await page.mouse.move(x - pad["width"] / 2, y, steps=3)
    await made.until(lambda: made.velocities[-1] == pytest.approx((0.0, 0.9), abs=0.05))
    await page.mouse.up()
    await made.until(lambda: made.velocities[-1] == (0.0, 0.0))
    await page.locator("#drive-latency", has_text="to the robot not measured").wait_for()
    made.answers = True
    await page.locator("#drive-latency", has_text=re.compile(r"to the robot \d+ ms")).wait_for()
    await page.keyboard.press("Escape")
    await page.locator("#drive").wait_for(state="hidden")
    await made.until(lambda: made.fleet.modes == [("Robot1", "manual"), ("Robot1", "automatic")])


async def test_a_robot_that_a_stop_does_not_reach_is_shown() -> None:
    async with site() as made, opened(made) as page:
        await check_missed(page)


async def test_a_stop_of_all_robots_is_one_row() -> None:
    """A thousand rows hid what else was wrong; one click releases all, and the robots are shown on demand."""
    async with site(robots=12) as made, opened(made) as page:
        await page.locator("#stop-all").click()
        group = page.locator("#attention-list li", has_text="11 robots:")
        await made.until(lambda: made.control.undelivered == ["Robot2"])
        await group.wait_for()
        await page.wait_for_function(
            """() => {
                const rows = document.querySelectorAll("#attention-list li");
                const count = document.querySelector("#attention-count").innerText;
                return rows.length === 2 && rows[0].innerText.startsWith("!!Robot2") && count === "12";
            }"""
        )
        await group.locator("summary").click()
        await group.locator("button", has_text="Robot12").click()
        await page.locator("#robot-card", has_text="Robot12").wait_for()
        await group.locator("button", has_text="Release all").click()
        await page.locator("#question-yes").click()
        await made.until(lambda: made.stops and not made.stops[-1])
        await group.wait_for(state="detached")


async def test_an_operator_stops_places_and_drives_a_robot() -> None:
    async with site() as made, opened(made) as page:
        await check_stops(made, page)
        await check_pose(made, page)
        await check_drive(made, page)


LATE_SOCKET = """() => {
    const Real = WebSocket;
    window.WebSocket = function () {
        window.WebSocket = Real;
        return rceFleet.late = Object.assign(new EventTarget(), { readyState: 1, send() {}, close() {} });
    };
}"""
"""The next WebSocket does nothing but what is told to ``rceFleet.late``."""


async def test_a_late_close_of_an_earlier_drive_stops_nothing() -> None:
    """Neither does what its socket tells."""
    async with site() as made, opened(made) as page:
        await page.evaluate(LATE_SOCKET)
        await page.evaluate("rceFleet.drive.begin('Robot1')")
        await page.evaluate("void rceFleet.late.dispatchEvent(new Event('open'))")
        await page.evaluate("rceFleet.drive.begin('Robot1')")
        await page.locator("#drive-latency", has_text="round trip").wait_for()
        refusal = """new MessageEvent("message", { data: '{"error": "it is driven"}' })"""
        for event in (refusal, "new Event('close')"):
            await page.evaluate(f"void rceFleet.late.dispatchEvent({event})")
        assert await page.evaluate("rceFleet.drive.error") is None
        await page.keyboard.down("ArrowUp")
        await page.keyboard.down("Space")
        await made.until(lambda: made.velocities and made.velocities[-1] == pytest.approx((0.35, 0.0)))
