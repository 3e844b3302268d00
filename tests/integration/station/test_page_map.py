"""The map in a browser: zoom, pan, clicks at any zoom, many robots, and drawing without WebGL."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from aiohttp.test_utils import TestServer
from support.browser import BROWSER, CHROMIUM, FEW_FRAMES
from support.planner_states import pose, robot, state

from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

if TYPE_CHECKING:
    from playwright.async_api import Page

WAIT_MS = 60_000
COUNT = 300
SPLIT = "WebGL below, canvas for robots"
RENDERERS = [("", SPLIT), ("?renderer=webgl", "WebGL"), ("?renderer=canvas", "canvas")]
"""The first is what the page chooses on a machine without a graphics card."""

pytestmark = pytest.mark.needs("chromium")


@asynccontextmanager
async def opened(query: str = "") -> AsyncIterator[Page]:
    """A page with 300 robots in a row; errors of the browser fail the test."""
    from playwright.async_api import async_playwright

    view = FleetView()
    feed = Feed(view)
    robots = [robot(f"Robot{n}", cell=n, plan=[n, n + 1], granted=[n], goal=n + 1) for n in range(COUNT)]
    feed.on_change(view.on_state({**state(*robots, blocked=[400]), "rows": 20, "columns": 40}))
    for n in range(COUNT):
        view.on_pose(f"Robot{n}", pose(n % 40 + 0.5, n // 40 + 0.5, 0.0))
    station = Station(view, FleetLink.__new__(FleetLink), feed.pages)
    problems: list[str] = []
    async with TestServer(station.make_app()) as server, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        try:
            page = await browser.new_page(viewport={"width": 1280, "height": 900})
            await page.add_init_script(FEW_FRAMES)
            page.on("console", lambda said: problems.append(said.text) if said.type == "error" else None)
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.set_default_timeout(WAIT_MS)
            await page.goto(str(server.make_url(f"/{query}")))
            await page.wait_for_function(f"rceFleet.view.scene.robotCount === {COUNT}")
            yield page
        finally:
            await browser.close()
    assert problems == []


async def test_wheel_and_drag_move_the_map_not_the_cells() -> None:
    async with opened() as page:
        scale = await page.evaluate("rceFleet.view.scale")
        box = await page.locator("#map").bounding_box()
        assert box is not None
        x, y = await page.evaluate("rceFleet.view.screenOf(620)")
        await page.mouse.move(box["x"] + x, box["y"] + y)
        await page.mouse.wheel(0, -600)
        await page.wait_for_function("before => rceFleet.view.scale > 2 * before", arg=scale)
        assert await page.evaluate("rceFleet.view.screenOf(620)") == pytest.approx([x, y], abs=4.0)
        await page.mouse.down()
        await page.mouse.move(box["x"] + x - 80, box["y"] + y - 40, steps=4)
        await page.mouse.up()
        assert await page.evaluate("rceFleet.view.screenOf(620)") == pytest.approx([x - 80, y - 40], abs=5.0)
        assert await page.evaluate("rceFleet.fleet.selected") is None, "a drag is not a click"
        await page.locator("#zoom-fit").click()
        assert await page.evaluate("rceFleet.view.scale") == pytest.approx(scale)


async def test_a_click_finds_the_robot_at_any_zoom() -> None:
    async with opened() as page:
        await page.locator("#map").focus()
        for _ in range(3):
            await page.keyboard.press("+")
        x, y = await page.evaluate("rceFleet.view.screenOf(260)")
        await page.locator("#map").click(position={"x": x, "y": y})
        assert await page.evaluate("rceFleet.fleet.selected") == "Robot260"


async def test_a_robot_that_stands_is_not_shown_as_old() -> None:
    """Its last pose is a minute old; what counts is the sign of life that the planner heard last."""
    async with opened() as page:
        ages = await page.evaluate(
            """async () => {
                const { heartbeatAge } = await import("/static/conditions.js");
                const heard = { state: "idle", seen: 0, heard: 59500 };
                const silent = { state: "silent", seen: 60000, heard: 48000 };
                const old = ["idle", "silent"].map(state => ({ state, seen: 0, heard: null }));
                return [heard, silent, ...old].map(robot => heartbeatAge(robot, 60000));
            }"""
        )
        assert ages == [0.5, 12, 0, 60], "the last two: of a planner that tells none"


async def test_a_long_table_has_only_visible_rows() -> None:
    async with opened() as page:
        assert await page.locator("#robots tr[data-robot]").count() < 60
        await page.locator("#robots-box").evaluate("box => { box.scrollTop = 150 * 31; }")
        await page.wait_for_selector("tr[data-robot=Robot150]")
        await page.locator("#robots-find").fill("Robot29")
        await page.wait_for_function("document.querySelectorAll('#robots tr[data-robot]').length === 11")


@pytest.mark.parametrize(("query", "name"), RENDERERS)
async def test_a_robot_is_drawn_in_its_colour(query: str, name: str) -> None:
    """A robot's edge has its colour, a wall's middle another, in each renderer."""
    async with opened(query) as page:
        assert await page.evaluate("rceFleet.view.renderer.name") == name
        drawn = await page.evaluate(
            """async () => {
                const { view, fleet } = rceFleet;
                const corner = view.screenOf(5).map(at => at * view.ratio);
                for (let step = 0; step < 12; step++) view.camera.zoom(1.25, ...corner);
                await new Promise(done => setTimeout(done, 300));
                view.touch();
                view.draw();
                const source = view.stage.querySelector("#fleet");
                const copy = new OffscreenCanvas(source.width, source.height);
                const context = copy.getContext("2d");
                context.drawImage(source, 0, 0);
                const [x, y] = fleet.centre(5);
                const at = [view.camera.x(x), view.camera.y(y + 0.18)].map(Math.round);
                return [...context.getImageData(...at, 1, 1).data];
            }"""
        )
        assert drawn == pytest.approx([194, 37, 92, 255], abs=6)


async def test_the_page_rests_while_nothing_changes() -> None:
    """Frames are drawn after a change, and not while everything stands."""
    async with opened() as page:
        await page.evaluate("rceFleet.fleet.select('Robot3')")
        async with asyncio.timeout(WAIT_MS / 1000):
            while not await page.evaluate(
                """async () => {
                    const before = rceFleet.view.meter.frames;
                    await new Promise(done => setTimeout(done, 300));
                    return rceFleet.view.meter.frames === before;
                }"""
            ):
                pass
        before = await page.evaluate("rceFleet.view.meter.drawn")
        await page.evaluate("rceFleet.fleet.select('Robot4')")
        await page.wait_for_function("before => rceFleet.view.meter.drawn > before", arg=before)


async def test_a_lost_robot_and_a_load_have_marks_of_their_own() -> None:
    """A robot that does not know its place has a diamond, and is first in the list, with an answer."""
    async with opened() as page:
        looks = await page.evaluate(
            """() => {
                const { fleet, view } = rceFleet;
                const [lost, loaded] = ["Robot7", "Robot8"].map(id => fleet.robots.get(id));
                Object.assign(lost, { state: "lost", reason: "uncertain by 2.1 m" });
                loaded.loads = 1;
                view.touch("fleet");
                view.draw();
                const ids = [...fleet.robots.keys()];
                return ["Robot7", "Robot8"].map(id => view.scene.robots[8 * ids.indexOf(id) + 3]);
            }"""
        )
        assert looks == [10, 16]
        item = page.locator("#attention-list li").first
        await item.locator(".why", has_text="uncertain by 2.1 m").wait_for()
        await item.get_by_role("button", name="Localize: Robot7").click()
        assert await page.evaluate("[rceFleet.fleet.selected, rceFleet.tools.tool]") == ["Robot7", "pose"]


async def test_dark_is_kept_and_congestion_is_a_layer() -> None:
    """The chosen colours stay after the page is loaded again; cells on many paths are hot."""
    async with opened() as page:
        light = await page.evaluate("rceFleet.view.colour.cell")
        await page.locator("#theme").click()
        dark = await page.evaluate("rceFleet.view.colour.cell")
        assert dark != light
        await page.locator("#layer-congestion").check()
        hot = "cell => rceFleet.view.scene.cells[4 * cell + 1] > 0"
        await page.wait_for_function(hot, arg=3)
        assert not await page.evaluate(hot, 500), "no path leads there"
        await page.reload()
        await page.wait_for_function("window.rceFleet?.view.colour.cell")
        assert await page.evaluate("rceFleet.view.colour.cell") == dark
