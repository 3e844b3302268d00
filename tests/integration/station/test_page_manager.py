"""The page with a real planner, fleet manager and robots: tasks, robots and zones in an operator's hands."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.browser import BROWSER, CHROMIUM, FEW_FRAMES, press
from support.fleet_station import fleet_station
from support.managed_fleet import ManagedFleet, managed_fleet

if TYPE_CHECKING:
    from playwright.async_api import ConsoleMessage, Page, Response

WAIT_MS = 150_000

pytestmark = pytest.mark.needs("chromium")


CONFLICT = 412
"""A task changed meanwhile; the page asks again."""
CHANGED_BEFORE = """() => {
    const send = window.fetch;
    window.fetch = async (path, asked) => {
        if (asked.headers["If-Match"]) {
            window.fetch = send;
            const headers = { "Content-Type": "application/json" };
            await send(path, { method: "PATCH", headers, body: JSON.stringify({ deadline: 5e9 }) });
        }
        return send(path, asked);
    };
}"""
"""Let a task change once just before a change of it that is for one revision."""


def refused(answer: Response) -> list[str]:
    if answer.status < 400 or (answer.request.method, answer.status) == ("PATCH", CONFLICT):
        return []
    return [f"{answer.request.method} {answer.url}: {answer.status}"]


def errors(said: ConsoleMessage) -> list[str]:
    return [said.text] if said.type == "error" and f"status of {CONFLICT}" not in said.text else []


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[Page]:
    """The page, once it shows two robots and what the manager says; errors of the browser fail the test."""
    from playwright.async_api import async_playwright

    problems: list[str] = []
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        try:
            page = await browser.new_page(viewport={"width": 1280, "height": 900})
            await page.add_init_script(FEW_FRAMES)
            page.on("console", lambda said: problems.extend(errors(said)))
            page.on("response", lambda answer: problems.extend(refused(answer)))
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.set_default_timeout(WAIT_MS)
            await page.goto(url)
            await page.wait_for_function("rceFleet.view.scene.robotCount === 2")
            await page.wait_for_function("rceFleet.work.trouble === null")
            yield page
        finally:
            await browser.close()
    assert problems == []


async def click_cell(page: Page, cell: int) -> None:
    x, y = await page.evaluate("cell => rceFleet.view.screenOf(cell)", cell)
    await page.locator("#map").click(position={"x": x, "y": y})


async def check_task(page: Page) -> None:
    """Pick and drop are clicked; the list shows the task until it is done."""
    await page.locator("#tool-task").click()
    await click_cell(page, 18)
    await click_cell(page, 21)
    await page.wait_for_selector("#tasks tr[data-task=T1]")
    await page.wait_for_function(
        "rceFleet.work.recent.some(({ id, state }) => id === 'T1' && state === 'done')"
    )
    row = await page.inner_text("#tasks tr[data-task=T1]")
    assert "pick up at 18, drop at 21" in row
    assert "done" in row


async def check_lost_answer(page: Page, fleet: ManagedFleet) -> None:
    """The answer of the manager is lost: the task is created once, and undo cancels it."""
    before = (await fleet.ask("GET", "/tasks")).body["tasks"]
    await page.evaluate("""() => {
        const [send, sent] = [window.fetch, new Set()];
        window.fetch = async (path, asked) => {
            const answer = await send(path, asked);
            if (asked.method !== "POST" || !path.endsWith("/tasks") || sent.has(asked.body)) return answer;
            sent.add(asked.body);
            throw new TypeError("Failed to fetch");
        };
    }""")
    made = await page.evaluate("rceFleet.actions.createTask([{ cell: 18 }], { earliest_start: 4e9 })")
    after = (await fleet.ask("GET", "/tasks")).body["tasks"]
    assert [task["id"] for task in after[len(before) :]] == [made["id"]]
    await page.locator("#undo").click()
    await fleet.until_state(made["id"], "cancelled")


async def click_while_tasks_change(page: Page, selector: str) -> None:
    """Click; the list is drawn again between press and release, as when all tasks change then."""
    await press(page.locator(selector))
    await page.evaluate(
        """() => {
            for (const task of rceFleet.work.tasks.values()) task.state = "cancelling";
            rceFleet.work.dispatchEvent(new Event("change"));
        }"""
    )
    await page.mouse.up()


async def check_buttons(page: Page, fleet: ManagedFleet) -> None:
    """A task is held, resumed, given to another robot and cancelled by its buttons."""
    created = await fleet.ask("POST", "/tasks", {"stops": [{"cell": 27, "confirm": True}]})
    task = created.body["id"]
    await page.locator(f"#task-{task}-hold").click()
    await fleet.until_state(task, "held")
    await click_while_tasks_change(page, f"#task-{task}-resume")
    running = await fleet.until_state(task, "running")
    robot = running["robot_assigned"]
    await fleet.ask("POST", f"/robots/{robot}/pause")
    if await fleet.until_standing(robot) != 27:  # a robot that has arrived keeps the task
        await page.wait_for_function("id => rceFleet.fleet.robots.get(id).task", arg=robot)
        await page.evaluate("id => void rceFleet.actions.reassign(id)", robot)
        await page.locator("#question-yes").click()
    await fleet.ask("POST", f"/robots/{robot}/resume")
    await page.locator(f"#task-{task}-confirm").click()
    await fleet.until_state(task, "done")
    later = (await fleet.ask("POST", "/tasks", {"stops": [{"cell": 5}], "earliest_start": 4e9})).body["id"]
    await page.locator(f"#task-{later}-cancel").click()
    await page.locator("#question-yes").click()  # it is another user's: undo could not bring it back
    await fleet.until_state(later, "cancelled")
    order = {"stops": [{"cell": 5}], "repeat": {"every": 86400}}
    daily = (await fleet.ask("POST", "/tasks", order)).body["id"]
    await page.wait_for_function("rceFleet.work.recurring.length === 1")  # done, between two occurrences
    await page.locator(f"#task-{daily}-cancel").click()
    await page.locator("#question-yes").click()
    await page.wait_for_function("rceFleet.work.recurring.length === 0")
    assert (await fleet.ask("GET", "/tasks?state=recurring")).body["tasks"] == []


async def check_robot(page: Page) -> None:
    """A robot is taken out by its card, and put in by undo; charging says what is missing."""
    await page.locator("tr[data-robot=Robot2]").click()
    await page.locator("#robot-card button", has_text="Take out").click()
    await page.wait_for_function("rceFleet.fleet.robots.get('Robot2').activity === 'out'")
    await page.locator("#robot-card button", has_text="Put in").wait_for()
    await page.locator("#undo").click()
    await page.wait_for_function("rceFleet.fleet.robots.get('Robot2').activity !== 'out'")
    await page.locator("#robot-card button", has_text="Send to charge").click()
    await page.wait_for_function(
        "[...rceFleet.work.tasks.values()].some(({ name }) => name === 'charge Robot2')"
    )
    await page.wait_for_function(
        "[...rceFleet.work.tasks.values()].some(({ reason }) => reason.includes('charger'))"
    )


async def check_zone(page: Page, fleet: ManagedFleet) -> None:
    """A zone is made by a click, reaches the planner, and is removed by another click."""
    await page.locator("#tool-zone").click()
    await click_cell(page, 40)
    await page.locator("#zone-kind").select_option("slow")
    await page.locator("#zone-value").fill("0.2")
    await page.locator("#zone-form [type=submit]").click()
    await page.wait_for_function("rceFleet.work.zones.length === 1")
    await until_zones(fleet, ["zone1"])
    await click_cell(page, 40)
    await page.locator("#zone-remove").click()
    await page.wait_for_function("rceFleet.work.zones.length === 0")
    await until_zones(fleet, [])


async def until_zones(fleet: ManagedFleet, wanted: list[str]) -> None:
    """Wait until the planner has these zones."""
    async with asyncio.timeout(WAIT_MS / 1000):
        while await fleet.planner_zones() != wanted:
            await asyncio.sleep(0.1)


async def test_an_operator_works_with_the_manager(tmp_path: Path) -> None:
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:
        while (await fleet.ask("GET", "/map")).status != 200:
            await asyncio.sleep(0.1)
        async with fleet_station(fleet.core.uri) as url, opened(url) as page:
            await check_task(page)
            await check_lost_answer(page, fleet)
            await check_buttons(page, fleet)
            await check_robot(page)
            await check_zone(page, fleet)


async def check_late_task(page: Page, fleet: ManagedFleet) -> None:
    """It is told as late by its robot, and preferred and given its own priority again."""
    stops = [{"cell": 27, "confirm": True}]
    created = await fleet.ask("POST", "/tasks", {"stops": stops, "priority": 7, "deadline": 1.0})
    task = created.body["id"]
    late = page.locator("#attention-list li", has_text=f"task {task} may miss its deadline")
    await late.locator("button", has_text="Prefer").click()
    await until_priority(fleet, task, 100)
    await page.wait_for_selector("#undo:enabled")
    await page.locator("#undo").click()
    await until_priority(fleet, task, 7)


async def check_unlisted_task(page: Page, fleet: ManagedFleet) -> None:
    """A task that the page does not know gets its own priority again, too, although it changes meanwhile."""
    order = {"stops": [{"cell": 5}], "earliest_start": 4e9, "priority": 3}
    task = (await fleet.ask("POST", "/tasks", order)).body["id"]
    await page.evaluate("id => rceFleet.actions.raise(id, 50)", task)
    await until_priority(fleet, task, 50)
    await page.evaluate(CHANGED_BEFORE)
    await page.locator("#undo").click()
    await until_priority(fleet, task, 3)
    assert (await fleet.ask("GET", f"/tasks/{task}")).body["deadline"] == 5e9


async def until_priority(fleet: ManagedFleet, task: str, wanted: int) -> None:
    async with asyncio.timeout(WAIT_MS / 1000):
        while (await fleet.ask("GET", f"/tasks/{task}")).body["priority"] != wanted:
            await asyncio.sleep(0.1)


async def test_deadlines_are_watched_beyond_many_tasks(tmp_path: Path) -> None:
    """More tasks are open than the page lists."""
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:
        while (await fleet.ask("GET", "/map")).status != 200:
            await asyncio.sleep(0.1)
        order = {"stops": [{"cell": 5}], "earliest_start": 4e9}
        for _ in range(41):
            await asyncio.gather(*(fleet.ask("POST", "/tasks", order) for _ in range(5)))
        async with fleet_station(fleet.core.uri) as url, opened(url) as page:
            await check_late_task(page, fleet)
            await page.locator("#tasks td", has_text="and 106 more").wait_for()
            await check_unlisted_task(page, fleet)
