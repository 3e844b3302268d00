"""Presses on the page hit what was meant, whatever changes until their release."""

from __future__ import annotations

import pytest
from integration.station.test_page_operator import site
from support.browser import press
from support.planner_states import changes, robot

pytestmark = pytest.mark.needs("chromium")

SEARCH = """() => {
    const find = document.querySelector("#robots-find");
    find.value = "robot";
    find.dispatchEvent(new Event("input"));
}"""
"""Sort the table anew at once; all robots are found."""


async def test_a_row_that_changes_leaves_other_rows_their_clicks() -> None:
    """Nothing moves, or is made again, between a press and its release; the focus stays in one made again."""
    async with site() as made:
        page = await made.open()

        def tell(name: str, robot_state: str) -> None:
            made.feed.on_change(made.view.on_changes(changes(robot(name, state=robot_state, reason="why"))))

        tell("Robot1", "unreachable")
        cancel = page.locator("#attention-list button[aria-label$=': Robot1']", has_text="Cancel")
        other = page.locator("#attention-list li", has_text="Robot2")
        await press(cancel)
        tell("Robot2", "silent")
        tell("Robot1", "stuck")
        await page.wait_for_function("rceFleet.fleet.robots.get('Robot1').state === 'stuck'")
        await page.evaluate("void rceFleet.fleet.dispatchEvent(new Event('planner'))")  # the list is drawn
        async with page.expect_response("**/robots/Robot1/goal"):
            await page.mouse.up()
        await other.wait_for()
        tell("Robot1", "unreachable")  # again: the goal was removed
        await cancel.focus()
        tell("Robot2", "idle")
        await other.wait_for(state="detached")
        async with page.expect_response("**/robots/Robot1/goal"):
            await page.keyboard.press("Enter")
        tell("Robot1", "unreachable")
        await cancel.focus()
        made.feed.on_control({"Robot1": "an operator"}, {})
        await page.locator("#attention-list button", has_text="Release").wait_for()
        async with page.expect_response("**/robots/Robot1/goal"):
            await page.keyboard.press("Enter")


async def test_a_press_on_the_card_hits_its_button() -> None:
    """Other buttons fit the robot before the release."""
    async with site() as made:
        page = await made.open()
        await page.locator("tr[data-robot=Robot1]").click()
        await press(page.locator("#robot-card button.stop"))
        await page.evaluate("rceFleet.fleet.things.Robot1 = ['light']")
        await page.evaluate("void rceFleet.fleet.dispatchEvent(new Event('selected'))")  # the card is drawn
        async with page.expect_request("**/robots/Robot1/emergency-stop"):
            await page.mouse.up()
        await page.locator("#robot-card button", has_text="Localize").wait_for(state="detached")


async def test_a_press_hits_what_moves_away() -> None:
    """Another robot is in the table above the card before the release."""
    async with site() as made:
        page = await made.open()
        await page.locator("tr[data-robot=Robot1]").click()
        stop = page.locator("#robot-card button.stop")
        await press(stop)
        before = await stop.bounding_box()
        made.feed.on_change(made.view.on_changes(changes(robot("Robot3"))))
        await page.locator("tr[data-robot=Robot3]").wait_for()
        after = await stop.bounding_box()
        assert before is not None
        assert after is not None
        assert after["y"] > before["y"] + before["height"]
        async with page.expect_request("**/robots/Robot1/emergency-stop"):
            await page.mouse.up()


@pytest.mark.parametrize("width", [1280, 400])
async def test_stops_keep_their_places(width: int) -> None:
    """Whatever needs attention, whatever can be released, and whatever is said of the robot."""
    async with site() as made:
        page = await made.open(width)
        await page.wait_for_load_state("networkidle")
        await page.locator("tr[data-robot=Robot1]").click()
        stops = [page.locator(selector) for selector in ("#robot-card button.stop", "#stop-all")]
        before = [await stop.bounding_box() for stop in stops]
        assert not await page.locator("#release-all").is_visible()
        trouble = [robot(name, state="stuck", reason="why " * 50) for name in ("Robot1", "Robot2")]
        made.feed.on_change(made.view.on_changes(changes(*trouble)))
        made.feed.on_control({"Robot2": "an operator"}, {})
        await page.locator("#attention-list button", has_text="Release").wait_for()
        await page.locator("#robot-card p", has_text="why why").wait_for()
        await page.locator("#release-all").wait_for()
        assert [await stop.bounding_box() for stop in stops] == before


async def test_a_finger_hits_what_it_pressed() -> None:
    """Another button is at its place before the release: another operator has paused the fleet."""
    async with site() as made:
        page = await made.open(has_touch=True)
        await page.wait_for_load_state("networkidle")
        box = await page.locator("#fleet-pause").bounding_box()
        assert box is not None
        middle = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        fingers = await page.context.new_cdp_session(page)
        await fingers.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [middle]})
        made.feed.on_change(made.view.on_changes({**changes(), "mode": "paused"}))
        await page.locator("#fleet-resume").wait_for()
        async with page.expect_response("**/mode"):
            await fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        assert made.modes == ["paused"]


async def test_a_press_is_taken_back_by_a_release_elsewhere() -> None:
    async with site() as made:
        page = await made.open()
        sent: list[str] = []
        page.on("request", lambda request: sent.append(request.url))
        await press(page.locator("#fleet-pause"))
        await page.locator("#fleet-buttons").locator("xpath=..").hover(position={"x": 5, "y": 5}, force=True)
        await page.mouse.up()
        await page.locator("tr[data-robot=Robot1]").click()
        await page.locator("#robot-card").wait_for()
        assert [url for url in sent if url.endswith("/mode")] == []
        await page.locator("#fleet-pause").click()
        await page.locator("#fleet-resume").wait_for()


async def test_a_key_is_not_taken_for_a_lost_click() -> None:
    """No click comes, as what was pressed was removed before its release; then a key presses another one."""
    async with site() as made:
        page = await made.open()
        sent: list[str] = []
        page.on("request", lambda request: sent.append(request.url))
        await page.locator("tr[data-robot=Robot1]").click()
        stop = page.locator("#robot-card button.stop")
        await press(stop)
        await stop.evaluate("stop => stop.remove()")
        await page.mouse.up()
        await page.locator("#fleet-pause").focus()
        await page.keyboard.press("Enter")
        await page.locator("#fleet-resume").wait_for()
        assert made.modes == ["paused"]
        assert [url for url in sent if url.endswith("/emergency-stop")] == []


async def test_a_press_on_a_row_selects_its_robot() -> None:
    """The table is sorted anew before the release: robots in trouble come first."""
    async with site() as made:
        page = await made.open()
        await press(page.locator("tr[data-robot=Robot2]"))
        made.feed.on_change(made.view.on_changes(changes(robot("Robot2", state="silent"))))
        await page.wait_for_function("rceFleet.fleet.robots.get('Robot2').state === 'silent'")
        await page.evaluate(SEARCH)
        await page.mouse.up()
        await page.wait_for_function("rceFleet.fleet.selected !== null")
        assert await page.evaluate("rceFleet.fleet.selected") == "Robot2"
        await page.wait_for_function(
            "document.querySelector('#robots tr[data-robot]').dataset.robot === 'Robot2'"
        )
