"""What an operator does on the page: drags, undo, exceptions, replay, and what other operators see of it."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp.test_utils import TestServer
from support.browser import BROWSER, CHROMIUM, FEW_FRAMES
from support.planner_states import block, changes, pose, robot, state

from rce_fleet.station.desired import DesiredCell
from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.station.recording import Recorder, Records
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView
from rce_fleet.station.world_link import states_text

if TYPE_CHECKING:
    from playwright.async_api import Browser, Page, Route

WAIT_MS = 60_000

pytestmark = pytest.mark.needs("chromium")


class Planner(FleetLink):
    """Takes goals and blocked cells, and tells the pages, as a planner would."""

    can_ask_manager = expects_manager = False

    def __init__(self, view: FleetView, feed: Feed) -> None:
        """Need no wire to a planner."""
        self.view, self.feed = view, feed
        self.modes: list[str] = []

    async def set_mode(self, robot: str, mode: str, *, reason: str, user: str) -> str:
        del robot, reason, user
        self.modes.append(mode)
        self.feed.on_change(self.view.on_changes({**changes(), "mode": mode}))
        return ""

    async def set_goal(self, robot_id: str, cell: int | None) -> str:
        goal = -1 if cell is None else cell
        self.feed.on_change(self.view.on_changes(changes(robot(robot_id, goal=goal, cell=9))))
        return f"{robot_id} goes to cell {cell}"

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        raise PlannerUnavailableError("no manager")

    async def block_cell(self, wanted: DesiredCell) -> str:
        cell, lifetime = wanted.cell, wanted.until - time.time() if wanted.until else 0.0
        said = block(cell, wanted.user, reason=wanted.reason, age=0.0, lifetime=lifetime)
        blocked = changes(blocked=[cell], blocks=[said])
        freed = changes(freed=[cell], removed_blocks=[cell])
        self.feed.on_change(self.view.on_changes(blocked if wanted.blocked else freed, time.time()))
        return f"cell {cell}"


@dataclass
class Site:
    """A station with two robots, and browsers."""

    url: str
    browser: Browser
    view: FleetView
    feed: Feed
    recorder: Recorder
    modes: list[str]
    problems: list[str] = field(default_factory=list)

    async def open(self, width: int = 1280, *, has_touch: bool = False) -> Page:
        page = await self.browser.new_page(viewport={"width": width, "height": 900}, has_touch=has_touch)
        await page.add_init_script(FEW_FRAMES)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.set_default_timeout(WAIT_MS)
        await page.goto(self.url)
        await page.wait_for_function("rceFleet.view.scene.robotCount === 2")
        return page


@asynccontextmanager
async def site(make_planner: Callable[[FleetView, Feed], Planner] = Planner) -> AsyncIterator[Site]:
    from playwright.async_api import async_playwright

    view = FleetView()
    feed = Feed(view)
    feed.on_change(view.on_state(state(robot("Robot1", cell=9), robot("Robot2", cell=54))))
    view.on_pose("Robot1", pose(1.5, 1.5, 0.0))
    view.on_pose("Robot2", pose(6.5, 6.5, 0.0))
    recorder = Recorder(view, Records())
    planner = make_planner(view, feed)
    station = Station(view, planner, feed.pages, records=recorder.records)
    if planner.can_ask_manager:
        await station.fleet_api.manager.look()
    async with TestServer(station.make_app()) as server, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        made = Site(str(server.make_url("/")), browser, view, feed, recorder, planner.modes)
        try:
            yield made
        finally:
            await browser.close()
            recorder.records.close()
    assert made.problems == []


async def drag(page: Page, first: int, last: int) -> None:
    """Drag the pointer from one cell to another."""
    box = await page.locator("#map").bounding_box()
    assert box is not None
    (x0, y0), (x1, y1) = [
        await page.evaluate("c => rceFleet.view.screenOf(c)", cell) for cell in (first, last)
    ]
    await page.mouse.move(box["x"] + x0, box["y"] + y0)
    await page.mouse.down()
    await page.mouse.move(box["x"] + x1, box["y"] + y1, steps=5)
    await page.mouse.up()


async def test_a_drag_blocks_cells_and_undo_frees_them() -> None:
    """A second operator sees the cells, and who blocked them."""
    async with site() as made:
        page, other = await made.open(), await made.open()
        await page.locator("#tool-block").click()
        await drag(page, 18, 28)
        for each in (page, other):
            await each.wait_for_function("String([...rceFleet.fleet.blocked].sort()) === '18,19,20,26,27,28'")
        await other.wait_for_function("document.querySelectorAll('#audit li').length === 6")
        assert "block cell 28" in await other.inner_text("#audit")
        await page.wait_for_selector("#undo:enabled")
        await page.locator("#undo").click()
        await other.wait_for_function("rceFleet.fleet.blocked.size === 0")
        late = await made.open()
        await late.wait_for_function("document.querySelectorAll('#audit li').length === 12")


async def test_blocked_cells_get_the_reason_and_end_of_the_fields() -> None:
    """What is filled in counts for cells that are blocked from then on; an empty end means none."""
    async with site() as made:
        page = await made.open()
        assert not await page.is_visible("#block-fields")
        await page.locator("#tool-block").click()
        await page.locator("#block-reason").fill("wet floor")
        await page.locator("#block-minutes").fill("30")
        await drag(page, 18, 19)
        await page.wait_for_function("rceFleet.fleet.blocks.size === 2")
        for block in made.view.blocks():
            assert block["reason"] == "wet floor"
            assert block["until"] == pytest.approx(time.time() + 1800, abs=60)
        await page.locator("#block-reason").fill("spill")
        await page.locator("#block-minutes").fill("")
        await click(page, 18)
        await page.wait_for_function("rceFleet.fleet.blocks.get(18).reason === 'spill'")
        assert await page.evaluate("rceFleet.fleet.blocks.get(18).until") is None
        await page.locator("#tool-act").click()
        assert not await page.is_visible("#block-fields")
        await click(page, 20)
        await page.wait_for_function("rceFleet.fleet.blocks.get(20)")
        assert await page.evaluate("rceFleet.fleet.blocks.get(20).reason") == ""


async def test_a_robot_is_dragged_to_its_goal() -> None:
    async with site() as made:
        page = await made.open()
        await drag(page, 9, 44)
        await page.wait_for_function("rceFleet.fleet.robots.get('Robot1').goal === 44")
        await page.keyboard.press("Control+z")
        await page.wait_for_function("rceFleet.fleet.robots.get('Robot1').goal === null")


async def test_a_silent_robot_comes_first_with_its_answers() -> None:
    async with site() as made:
        page = await made.open()
        made.feed.on_change(
            made.view.on_changes(changes(robot("Robot2", state="silent", reason="no message for 9 s")))
        )
        await page.wait_for_selector("#attention-list .severe")
        assert "Robot2" in await page.inner_text("#attention-list .severe")
        assert "no message for 9 s" in await page.inner_text("#attention-list .severe")
        take_out = page.locator("#attention-list button", has_text="Take out")
        assert await take_out.count() == 0, "only a fleet manager takes robots out"
        made.feed.pages.send("manager", json.dumps({"type": "manager", "here": True}))
        await take_out.wait_for()
        await page.wait_for_function(
            "document.querySelector('#robots tr[data-robot]').dataset.robot === 'Robot2'"
        )


async def test_the_page_tells_that_the_planner_is_away() -> None:
    """Also a page that is opened later; what it shows is old."""
    async with site() as made:
        made.feed.on_planner(time.time() - 60)
        page = await made.open()
        await page.locator("#planner", has_text="planner away").wait_for()
        await page.locator("#stages.stale").wait_for()
        made.feed.on_change(made.view.on_changes(changes(robot("Robot2", state="silent", reason="gone"))))
        await page.locator("#attention-list li.severe", has_text="gone").wait_for()
        texts = await page.locator("#attention-list li").all_inner_texts()
        assert ("the planner is away since" in texts[0], "Robot2" in texts[1]) == (True, True)
        made.feed.on_planner(None)
        await page.locator("#planner").wait_for(state="hidden")
        await page.locator("#stages.stale").wait_for(state="detached")
        await page.locator("#attention-list li", has_text="planner").wait_for(state="detached")


async def test_the_page_tells_that_the_fleet_is_paused() -> None:
    """Only the button that does something is shown; what it asks for reaches the planner."""
    async with site() as made:
        page = await made.open()
        assert not await page.locator("#fleet-resume").is_visible()
        await page.locator("#fleet-pause").click()
        await page.locator("#mode", has_text="the fleet is paused").wait_for()
        assert not await page.locator("#fleet-pause").is_visible()
        await page.locator("#fleet-resume").click()
        await page.locator("#fleet-pause").wait_for()
        assert not await page.locator("#mode").is_visible()
        assert made.modes == ["paused", "automatic"]


async def test_a_past_moment_is_shown_and_left_again() -> None:
    async with site() as made:
        start = time.time() - 100
        for second in range(60):
            made.view.on_pose("Robot1", pose(1.5 + 0.05 * second, 1.5, 0.0))
            entry = made.recorder.take(start + second)
            assert entry is not None
            made.recorder.records.add(entry[0], entry[1], whole=entry[2])
        for hours, count in ((3, 70), (0.5, 20), (0, 40)):
            made.recorder.records.add_figures(time.time() - 3600 * hours - 5, {"moving": count})
        page = await made.open()
        await page.locator("#figures canvas[aria-label='Robots that drive: 40 (20 to 40)']").wait_for()
        await page.locator("#figures-span").select_option("4")
        await page.locator("#figures canvas[aria-label='Robots that drive: 40 (20 to 70)']").wait_for()
        await page.evaluate("at => rceFleet.replay.show(at)", start + 20.4)
        await page.wait_for_function(
            "Math.abs(rceFleet.view.scene.replay.robots.get('Robot1').pose.x - 2.5) < 1e-6"
        )
        await page.locator("#replay-play").click()
        await page.wait_for_function("rceFleet.view.scene.replay.robots.get('Robot1').pose.x >= 2.6 - 1e-6")
        await page.locator("#replay-live").click()
        assert await page.evaluate("rceFleet.view.scene.replay") is None


async def click(page: Page, cell: int) -> None:
    await drag(page, cell, cell)


async def fill_records(made: Site, start: float) -> None:
    """Robot1 was in the cell 9, where it is not any more."""
    for second in range(60):
        entry = made.recorder.take(start + second)
        if entry is not None:
            made.recorder.records.add(entry[0], entry[1], whole=entry[2])
    made.view.on_pose("Robot1", pose(4.5, 4.5, 0.0))
    made.feed.on_pose("Robot1")
    made.feed.send_poses(0.0)


async def test_clicks_in_the_past_send_nothing() -> None:
    """Neither clicks, nor drags, nor keys; a robot can be selected where it was."""
    async with site() as made:
        start = time.time() - 100
        await fill_records(made, start)
        page = await made.open()
        await page.wait_for_function("rceFleet.fleet.robots.get('Robot1').pose.x === 4.5")
        await page.evaluate("at => rceFleet.replay.show(at)", start + 20.4)
        await page.locator("#hint", has_text="The map shows the past").wait_for()
        await click(page, 9)
        await page.wait_for_function("rceFleet.fleet.selected === 'Robot1'")
        await click(page, 44)
        await page.locator("#message.bad", has_text="The map shows the past").wait_for()
        await drag(page, 9, 44)  # it moves the map
        await page.locator("#zoom-fit").click()
        await page.locator("#map").focus()
        await page.evaluate("rceFleet.view.cursorCell = 44")
        await page.keyboard.press("Enter")
        await page.locator("#tool-block").click()
        await drag(page, 18, 28)
        await page.locator("#zoom-fit").click()
        await click(page, 20)
        assert await page.evaluate("rceFleet.operator.undoable") is None, "nothing was done"
        await page.locator("#replay-live").click()
        await page.locator("#hint", has_text="block them").wait_for()
        await click(page, 20)
        await page.wait_for_function("rceFleet.fleet.blocked.has(20)")
        assert made.view.blocked() == [20]
        assert made.view.robots()[0]["goal"] is None


async def test_a_past_that_cannot_be_loaded_leaves_the_page_live() -> None:
    async with site() as made:
        await fill_records(made, time.time() - 100)
        page = await made.open()
        waits, asked = asyncio.Event(), asyncio.Event()

        async def fail(route: Route) -> None:
            asked.set()
            await waits.wait()
            await route.fulfill(status=503, json={"error": "no records now"})

        await page.route("**/api/v1/replay/*", fail)
        await page.evaluate(
            """() => {
                const slider = document.querySelector("#replay-time");
                slider.value = 500;
                slider.dispatchEvent(new Event("input"));
            }"""
        )
        await asked.wait()
        await page.locator("#replay-at", has_text="loading").wait_for()
        await click(page, 20)
        await page.locator("#message.bad", has_text="The map shows the past").wait_for()
        waits.set()
        await page.locator("#message.bad", has_text="no records now").wait_for()
        await page.locator("#replay-live[aria-pressed=true]").wait_for()
        assert not await page.locator("#stage.past").count()
        assert made.view.blocked() == []


async def test_the_page_fits_a_phone() -> None:
    """Nothing is wider than the screen; every control has a name."""
    async with site() as made:
        page = await made.open(width=390)
        assert await page.evaluate("document.documentElement.scrollWidth") <= 390
        nameless = await page.evaluate(
            """[...document.querySelectorAll("button, input, select, canvas[tabindex]")]
                .filter(e => e.checkVisibility() && !e.textContent.trim())
                .filter(e => !e.ariaLabel && !e.labels?.length)
                .map(e => e.outerHTML)"""
        )
        assert nameless == []


async def test_views_rest_while_robots_stand() -> None:
    """Poses and places that come again, or with the noise of a robot that stands, are not drawn."""
    async with site() as made:
        page = await made.open()
        made.feed.pages.send("world", states_text([["Box1", 2.0, 2.0, 0.0]]))
        await page.locator("#view-world").click()
        await page.evaluate(
            """() => {
                const { view, world } = rceFleet;
                for (const drawing of [view, world]) {
                    const draw = drawing.draw.bind(drawing);
                    drawing.count = 0;
                    drawing.draw = (...given) => { drawing.count++; draw(...given); };
                }
                rceFleet.counts = () => [view.count, world.count];
                rceFleet.heard = () => rceFleet.fleet.robots.get("Robot1").seen;
            }"""
        )

        later = count(1000.0, 10.0)

        async def say(x: float, yaw: float, box: float) -> None:
            """Send poses and places that the page gets even if they are as before."""
            heard = await page.evaluate("rceFleet.heard()")
            made.view.on_pose("Robot1", pose(x, 4.5, yaw))
            made.feed.on_pose("Robot1")
            made.feed.send_poses(time.monotonic() + next(later))
            made.feed.pages.send("world", states_text([["Box1", box, 2.0, yaw]]))
            await page.wait_for_function("heard => rceFleet.heard() > heard", arg=heard)

        async def frames_after(x: float, yaw: float, box: float) -> list[int]:
            """Send poses and places; return how many frames are drawn within the second after it."""
            before = await page.evaluate("rceFleet.counts()")
            await say(x, yaw, box)
            await asyncio.sleep(1.0)
            counts = await page.evaluate("rceFleet.counts()")
            return [now - was for now, was in zip(counts, before, strict=True)]

        async def rests(x: float, yaw: float, box: float) -> None:
            async with asyncio.timeout(WAIT_MS / 1000):
                while any(await frames_after(x, yaw, box)):
                    pass

        await rests(4.5, 3.141, 2.0)
        assert await frames_after(4.501, -3.142, 2.001) == [0, 0], "it looks along -x: the turn is small"
        for moved in ((4.7, 3.141, 2.0), (4.7, 3.141, 2.5)):
            before = await page.evaluate("rceFleet.counts()")
            await say(*moved)
            await page.wait_for_function("before => rceFleet.counts()[1] > before[1]", arg=before)
            await rests(*moved)
        before = await page.evaluate("rceFleet.counts()")
        made.feed.on_control({"Robot1": "an operator"}, {})
        await page.wait_for_function(
            "before => rceFleet.counts().every((count, at) => count > before[at])", arg=before
        )


async def test_the_world_is_drawn_in_three_dimensions() -> None:
    """A robot in the middle of the view has its colour; the floor under a pixel is known."""
    async with site() as made:
        page = await made.open()
        await page.locator("#view-world").click()
        await page.wait_for_function("rceFleet.world.canvas.width > 300")
        drawn = await page.evaluate(
            """() => {
                const { world } = rceFleet;
                Object.assign(world.orbit, { x: 1.5, y: 1.5, distance: 4, tilt: 1.5 });
                const pixel = (right) => {
                    world.draw();
                    const at = [world.canvas.width / 2 + right, world.canvas.height / 2];
                    const out = new Uint8Array(4);
                    const { gl } = world;
                    gl.readPixels(...at.map(Math.round), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, out);
                    return [...out];
                };
                const box = world.canvas.getBoundingClientRect();
                const middle = { clientX: box.x + box.width / 2, clientY: box.y + box.height / 2 };
                return [pixel(0), pixel(0.45 * world.canvas.height), world.floorAt(middle)];
            }"""
        )
        assert drawn[0] == [255, 255, 255, 255], "the arrow on top of the robot"
        assert drawn[1] != drawn[0]
        assert drawn[2] == pytest.approx([1.5, 1.5], abs=0.02)


async def test_undo_of_a_drag_in_the_world_moves_it_back() -> None:
    """A click moves nothing, and what is dragged is drawn where the pointer has it."""
    async with site() as made:
        page = await made.open()
        asked: list[dict[str, Any]] = []

        async def act(route: Route) -> None:
            asked.append(json.loads(route.request.post_data or ""))
            await route.fulfill(json={"message": "moved"})

        await page.route("**/api/v1/simulation", act)
        made.feed.pages.send("world", states_text([["Box1", 2.0, 2.0, 0.5]]))
        await page.locator("#view-world").click()
        await page.wait_for_function(
            "rceFleet.world.models.length === 1 && rceFleet.world.canvas.width > 300"
        )
        canvas = page.locator("#world")
        await canvas.scroll_into_view_if_needed()
        box = await canvas.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        orbit = "Object.assign(rceFleet.world.orbit, { x: 2, y: 2, distance: 6, tilt: 1.5 })"
        await page.evaluate(f"rceFleet.world.follows = false; {orbit}")
        await page.mouse.move(x, y)
        await page.mouse.down()
        await page.mouse.move(x + 2, y)
        await page.mouse.up()
        await page.mouse.move(x, y)
        await page.mouse.down()
        await page.mouse.move(x + 60, y, steps=3)
        assert await page.evaluate("rceFleet.world.dragged[1]") > 2.2
        await page.mouse.up()
        await page.locator("#message", has_text="moved").wait_for()
        assert [(one["name"], one["x"] > 2.2, one["yaw"]) for one in asked] == [("Box1", True, 0.5)]
        await page.locator("#undo:enabled").click()
        await page.locator("#undo:disabled").wait_for()
        assert asked[1:] == [{"action": "move", "name": "Box1", "x": 2.0, "y": 2.0, "yaw": 0.5}]
