"""The operator's page in a browser, on a demo that runs for real."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from math import hypot
from pathlib import Path
from typing import Any

import psutil
import pytest
import pytest_asyncio
from playwright.async_api import Browser, Page, ViewportSize, async_playwright
from support.browser import CHROMIUM, FEW_FRAMES
from support.demo import Demo, running_demo
from support.engine import command_line, until

from rce_fleet.demo.floor import FLOOR
from rce_fleet.drivers.report import WorldReport, read_report
from rce_fleet.planning.scenario import midway_cell

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.real_time("robots"),
    pytest.mark.needs("chromium", "pymunk"),
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(900),
]

ARTIFACTS = Path(__file__).parents[2] / "artifacts"
BROWSER = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
DESKTOP, PHONE = ViewportSize(width=1280, height=800), ViewportSize(width=390, height=844)
WAIT_MS = 180_000


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_demo() -> AsyncIterator[Demo]:
    """Three robots that stand until a test sends them; the first one has sensors, for layers and detours."""
    kinds = ("--robots", 3, "--full-stack", 1)
    async with running_demo(*kinds, "--seed", 4, "--runtime", "process", "--no-auto") as demo:
        yield demo


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def browser() -> AsyncIterator[Browser]:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=list(BROWSER))
        try:
            yield browser
        finally:
            await browser.close()


def artifact(name: str) -> Path:
    """Where a picture is kept to be looked at after the test."""
    ARTIFACTS.mkdir(exist_ok=True)
    return ARTIFACTS / name


@contextlib.asynccontextmanager
async def opened(
    browser: Browser, demo: Demo, viewport: ViewportSize = DESKTOP, *, expected: str = ""
) -> AsyncIterator[Page]:
    """The page in a browser; what the browser complains of and is not ``expected`` fails the test."""
    messages: list[str] = []
    page = await browser.new_page(viewport=viewport, color_scheme="light", has_touch=viewport is PHONE)
    try:
        await page.add_init_script(FEW_FRAMES)
        page.on("console", lambda said: messages.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.set_default_timeout(WAIT_MS)
        await page.goto(demo.page)
        await page.wait_for_function("document.querySelector('#link').textContent === 'live'")
        yield page
    finally:
        await page.close()
    assert [text for text in messages if not (expected and expected in text)] == []


async def robots_placed(page: Page, count: int) -> None:
    await page.wait_for_function(
        """count => [...rceFleet.fleet.robots.values()]
            .filter(robot => robot.pose && robot.cell !== null).length === count""",
        arg=count,
    )


async def click_cell(page: Page, cell: int) -> None:
    x, y = await page.evaluate("cell => rceFleet.view.screenOf(cell)", cell)
    await page.locator("#map").click(position={"x": x, "y": y})


async def robot_of(page: Page, robot: str) -> dict[str, Any]:
    found: dict[str, Any] = await page.evaluate(
        """id => {
            const { plan, goal, granted, replans } = rceFleet.fleet.robots.get(id);
            return { plan, goal, granted, replans };
        }""",
        robot,
    )
    return found


def world_of(demo: Demo) -> WorldReport:
    (report,) = demo.folder.glob("rce-demo-*/world.json")
    truth = read_report(report)
    assert truth is not None
    return truth


def midway(demo: Demo, robot: str, seen: dict[str, Any]) -> int:
    """A cell on a robot's way that it does not need."""
    grid = FLOOR.with_blocked(FLOOR.blocked.union(world_of(demo).boxes))
    cell = midway_cell(grid, {robot: seen["plan"]}, {robot: seen["goal"]}, seen["granted"][:3])
    assert cell is not None
    return cell


async def send_away(page: Page, robot: str) -> dict[str, Any]:
    """Pick a robot and click a free goal, the next one on whose way a cell can be blocked."""
    goal = await page.evaluate(
        """id => {
            const { fleet } = rceFleet;
            const { rows, columns } = fleet.map;
            const here = fleet.robots.get(id).cell;
            const taken = new Set([...fleet.robots.values()].flatMap(r => [r.cell, r.goal]));
            const away = cell => Math.abs(cell % columns - here % columns)
                + Math.abs(Math.floor(cell / columns) - Math.floor(here / columns));
            return [...Array(rows * columns).keys()]
                .filter(cell => !fleet.blocked.has(cell) && !taken.has(cell))
                .filter(cell => away(cell) >= 6)
                .sort((a, b) => away(a) - away(b))[0];
        }""",
        robot,
    )
    await page.locator(f"tr[data-robot={robot}]").click()
    await page.wait_for_function("id => rceFleet.fleet.selected === id", arg=robot)
    await click_cell(page, goal)
    await page.wait_for_function(
        """([id, goal]) => {
            const robot = rceFleet.fleet.robots.get(id);
            return robot.goal === goal && robot.plan.length > 5;
        }""",
        arg=[robot, goal],
    )
    assert await page.evaluate("rceFleet.fleet.selected") is None
    return await robot_of(page, robot)


async def test_an_operator_sends_a_robot_and_blocks_its_way(browser: Browser, shared_demo: Demo) -> None:
    async with opened(browser, shared_demo) as page:
        await robots_placed(page, 3)
        await page.wait_for_function("rceFleet.fleet.models?.some(([name]) => name === 'Robot1')")
        before = await send_away(page, "Robot1")
        cell = midway(shared_demo, "Robot1", before)
        await click_cell(page, cell)
        await page.wait_for_function("cell => rceFleet.fleet.blocked.has(cell)", arg=cell)
        await page.wait_for_function(
            """([id, cell]) => {
                const { plan, goal } = rceFleet.fleet.robots.get(id);
                return plan.length > 1 && plan.at(-1) === goal && !plan.includes(cell);
            }""",
            arg=["Robot1", cell],
        )
        after = await robot_of(page, "Robot1")
        assert after["goal"] == before["goal"]
        assert after["replans"] >= before["replans"] + 1
        assert cell not in after["plan"]
        await send_away(page, "Robot2")
        await send_away(page, "Robot3")
        await page.wait_for_function("[...rceFleet.fleet.robots.values()].every(r => r.trail.length > 5)")
        await page.mouse.move(2, 2)
        await page.screenshot(path=artifact("fleet.png"))

        await click_cell(page, cell)
        # Robots may report the cell once more, until its box is gone: what was freed stands in the events.
        await page.wait_for_function(
            "cell => document.querySelector('#events').innerText.includes(`cell ${cell} is free`)", arg=cell
        )
        await page.wait_for_function("id => rceFleet.fleet.robots.get(id).state === 'arrived'", arg="Robot1")
        words = await page.locator("#events").inner_text()
        assert f"cell {cell} is blocked" in words
        assert f"cell {cell} is free" in words
        assert "Robot1 gets a new path" in words
        assert "Robot1 is at its goal" in words


async def test_the_page_shows_engine_and_refusals(browser: Browser, shared_demo: Demo) -> None:
    async with opened(browser, shared_demo, expected="409") as page:
        await robots_placed(page, 3)
        await page.wait_for_function(
            "document.querySelector('#engine').textContent.includes('fleetPlanner running')"
        )
        engine = await page.locator("#engine").inner_text()
        assert "cTag_01 running" in engine
        assert "moveClient_1 running" in engine
        # The station hears changes in place of whole states.
        await page.wait_for_function(
            """() => {
                const tags = rceFleet.fleet.engine.connections.map(connection => connection.tag_a);
                const has = tag => tags.includes(`cTag_fleet/${tag}`);
                return has("fleetChanges") && has("getState") && !has("fleetState");
            }"""
        )
        # Layers come from the robot's own graph, through the engine.
        await page.get_by_label("of robot").select_option("Robot1")
        await page.get_by_label("Scan", exact=True).check()
        await page.wait_for_function("rceFleet.layers.newest.get('scan')?.points?.length > 100")
        placed, at = await page.evaluate(
            "[rceFleet.layers.newest.get('scan').header.pose, rceFleet.fleet.robots.get('Robot1').pose]"
        )
        assert hypot(placed[0] - at["x"], placed[1] - at["y"]) < 0.5
        await page.screenshot(path=artifact("fleet-scan.png"), full_page=True)
        await page.get_by_label("Scan", exact=True).uncheck()
        wall = await page.evaluate("[...rceFleet.fleet.walls][0]")
        async with page.expect_response(lambda reply: f"/cells/{wall}" in reply.url) as answered:
            await click_cell(page, wall)
        assert (await answered.value).status == 409
        await page.wait_for_function("document.querySelector('#message').textContent.includes('wall')")


async def test_the_page_on_a_phone(browser: Browser, shared_demo: Demo) -> None:
    async with opened(browser, shared_demo, PHONE) as page:
        await robots_placed(page, 3)
        width = await page.evaluate("document.documentElement.scrollWidth")
        assert width <= PHONE["width"], "nothing sticks out to the right"
        box = await page.locator("#map").bounding_box()
        assert box is not None
        assert box["width"] > 0.8 * PHONE["width"]
        for button in await page.locator("button:visible").all():
            size = await button.bounding_box()
            assert size is not None
            assert size["height"] >= 30
        await page.locator("tr[data-robot=Robot2]").tap()
        await page.wait_for_function("rceFleet.fleet.selected === 'Robot2'")
        await page.screenshot(path=artifact("fleet-phone.png"))


async def test_a_robot_that_is_put_in_joins_the_fleet(browser: Browser, shared_demo: Demo) -> None:
    """It drives to a goal, and its programs end when it is taken out. Tests after this one see it as lost."""
    truth = world_of(shared_demo)
    taken = {robot.cell for robot in truth.robots if robot.cell is not None}
    free = set(FLOOR.with_blocked(FLOOR.blocked.union(truth.boxes, taken)).free)
    cell = min(cell for cell in free if cell + 1 in free and (cell + 1) % FLOOR.columns)
    async with opened(browser, shared_demo) as page:
        await robots_placed(page, 3)
        await page.locator("#view-both").click()
        await page.wait_for_function("rceFleet.world.canvas.width > 100")
        await page.locator("#simulation-add_robot").click()
        await page.evaluate(
            "([x, y]) => Object.assign(rceFleet.world.orbit, { x, y, distance: 4, tilt: 1.5 })",
            FLOOR.centre(cell),
        )
        await page.locator("#world").click()  # in its middle
        await robots_placed(page, 4)
        await page.wait_for_function("cell => rceFleet.fleet.robots.get('Robot4').cell === cell", arg=cell)
        await page.wait_for_function("document.querySelector('#simulation-outside').textContent === ''")
        await page.locator("tr[data-robot=Robot4]").click()
        await click_cell(page, cell + 1)
        await page.wait_for_function(
            """cell => {
                const robot = rceFleet.fleet.robots.get("Robot4");
                return robot.cell === cell && robot.state === "arrived";
            }""",
            arg=cell + 1,
        )
        await page.screenshot(path=artifact("fleet-newcomer.png"))
        await page.locator("#simulation-remove").click()
        await page.evaluate(
            "([x, y]) => Object.assign(rceFleet.world.orbit, { x, y })", FLOOR.centre(cell + 1)
        )
        await page.locator("#world").click()
        await page.locator("#question-yes").click()

        def programs() -> list[psutil.Process]:
            children = psutil.Process(shared_demo.process.pid).children(recursive=True)
            return [one for one in children if any("robot4.config" in word for word in command_line(one))]

        await until(lambda: not programs(), timeout=WAIT_MS / 1000, what="its bridge has ended")
        assert "Robot4 joins the fleet" in shared_demo.output()
