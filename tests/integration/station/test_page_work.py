"""The page with a fleet manager in the same program: tasks that need attention, undo, questions."""

from __future__ import annotations

import json
import re
import time
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from integration.station.test_page_operator import Planner, Site, site
from support.fleet_manager import ManagerClient
from support.planner_states import block, changes, robot

from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.task import StopVisit, TaskState

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from playwright.async_api import Page

    from rce_fleet.station.feed import Feed
    from rce_fleet.station.view import FleetView

pytestmark = pytest.mark.needs("chromium")

DELIVERY = {"stops": [{"action": "pick", "cell": 18}, {"action": "deliver", "cell": 21}]}


class ManagedPlanner(Planner):
    """A planner with a manager behind it."""

    can_ask_manager = expects_manager = True
    client: ManagerClient

    def forget_requests(self) -> None:
        """Keep none: no planner is connected."""

    def forget_cell(self, cell: int) -> None:
        del cell

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        given = {**request, "body": request["body"] or None}
        method, path = given.pop("method"), given.pop("path")
        status, body, revision = await self.client.ask(method, path, **given)
        return {"status": status, "body": json.dumps(body), "revision": revision}


@asynccontextmanager
async def managed(tmp_path: Path) -> AsyncIterator[tuple[Site, ManagerClient, Page]]:
    """A page that shows what the manager says."""
    client = ManagerClient(tmp_path / "journal.sqlite")

    def make(view: FleetView, feed: Feed) -> Planner:
        planner = ManagedPlanner(view, feed)
        planner.client = client
        return planner

    try:
        async with site(make) as made:
            page = await made.open()
            await page.wait_for_function("rceFleet.work.trouble === null")
            yield made, client, page
    finally:
        await client.manager.close()


def strand(client: ManagerClient, task_id: str) -> None:
    """Suspend a task whose robot has its load, and does not come back."""
    task = client.manager.book.find(task_id)
    visit = StopVisit(0, "Robot1", 18, 1.0, 2.0)
    client.manager.book.put_record(
        replace(task, state=TaskState.SUSPENDED, robot="Robot1", loads=1, position=1, visits=(visit,))
    )


async def until_state(page: Page, task: str, state: str) -> None:
    """Wait until the page knows a task in a state."""
    known = "[...rceFleet.work.tasks.values(), ...rceFleet.work.recent]"
    await page.wait_for_function(
        f"([task, state]) => {known}.some((one) => one.id === task && one.state === state)", arg=[task, state]
    )


async def test_a_question_about_a_load_is_answered_by_a_click(tmp_path: Path) -> None:
    """Where the robot stands, where the load was taken, any cell, or nowhere."""
    async with managed(tmp_path) as (made, client, page):
        made.feed.on_change(made.view.on_changes(changes(robot("Robot1", state="silent", cell=10))))
        tasks = [(await client.ask("POST", "/tasks", DELIVERY))[1]["id"] for _ in range(3)]
        for number, answer in enumerate(["At cell 10, with Robot1", "At cell 18, where it was taken"]):
            strand(client, tasks[number])
            item = page.locator("#attention-list li.severe", has_text="Where is the load that Robot1 has?")
            await item.locator("button", has_text=answer).click()
            await until_state(page, tasks[number], "queued")
            await item.wait_for(state="detached")
            stops = client.manager.book.find(tasks[number]).order.stops
            assert [stop.cells[0] for stop in stops][-2:] == [[10, 18][number], 21]
        strand(client, tasks[2])
        await page.locator("#attention-list button", has_text="It is lost").click()
        await page.locator("#question-no").click()
        await page.locator("#attention-list button", has_text="Choose its cell").click()
        await page.locator("#hint", has_text=f"where the load of task {tasks[2]} is").wait_for()
        await page.evaluate("rceFleet.tools.use(33)")
        await until_state(page, tasks[2], "queued")
        assert client.manager.book.find(tasks[2]).order.stops[-2].cells == (33,)
        strand(client, tasks[2])
        await page.locator("#attention-list button", has_text="It is lost").click()
        await page.locator("#question-yes").click()
        await until_state(page, tasks[2], "failed")


async def test_a_late_task_that_no_robot_has_needs_attention(tmp_path: Path) -> None:
    """Also before its deadline, if that comes before the task could be done."""
    async with managed(tmp_path) as (_, client, page):
        now = time.time()
        late = (await client.ask("POST", "/tasks", {**DELIVERY, "deadline": now + 5}))[1]["id"]
        slow = {"stops": [{"cell": 3, "duration": 600}], "deadline": now + 500}
        near = (await client.ask("POST", "/tasks", slow))[1]["id"]
        far = (await client.ask("POST", "/tasks", {**slow, "deadline": now + 3000}))[1]["id"]
        client.manager.facts.robots["Robot1"] = RobotFacts("Robot1")
        client.manager.dispatcher.measure(client.manager.facts)
        client.manager.dispatcher.update(now + 10, client.manager.facts)
        passed = page.locator("#attention-list li", has_text=late)
        await passed.locator(".why", has_text="its deadline").wait_for()
        assert "has passed" in await passed.inner_text()
        assert "may miss" in await page.inner_text(f"#attention-list li:has-text('{near}')")
        assert await page.locator("#attention-list li", has_text=far).count() == 0
        assert (await page.inner_text(f"#tasks tr[data-task={far}]")).split("\t")[-1].startswith("from ")
        await passed.locator("button", has_text="Prefer").click()
        await page.wait_for_function("id => rceFleet.work.find(id).priority === 100", arg=late)


async def test_a_task_that_was_cancelled_is_created_again(tmp_path: Path) -> None:
    """Only one that no robot has begun; of another one, the page asks first."""
    async with managed(tmp_path) as (_, client, page):
        created = await page.evaluate(
            "async (stops) => (await rceFleet.actions.createTask(stops, { priority: 7 })).id",
            DELIVERY["stops"],
        )
        await page.locator(f"#task-{created}-cancel").click()
        await until_state(page, created, "cancelled")
        await page.locator("#undo").click()
        await page.wait_for_function("rceFleet.work.tasks.size === 1")
        again = next(client.manager.book.open_tasks())
        assert (again.id != created, again.order.priority, again.order.stops[1].cells) == (True, 7, (21,))
        visit = StopVisit(0, "Robot1", 18, 1.0, 2.0)
        client.manager.book.put_record(replace(again, visits=(visit,), position=1, started_at=1.0))
        await page.wait_for_function("id => rceFleet.work.find(id).position === 1", arg=again.id)
        await page.locator(f"#task-{again.id}-cancel").click()
        await page.locator("#question-no").click()
        assert not client.manager.book.find(again.id).has_ended
        await page.locator(f"#task-{again.id}-cancel").click()
        await page.locator("#question-yes").click()
        await until_state(page, again.id, "cancelled")


async def test_an_undo_that_fails_can_be_tried_again(tmp_path: Path) -> None:
    """Of cells of which one was refused, undo frees the others."""
    async with managed(tmp_path) as (_, client, page):
        client.manager.facts.is_live = False  # it keeps the cells in its journal
        await page.evaluate("void rceFleet.actions.setCells([18, 64, 20], true)")  # 64 is not on the map
        await page.locator("#message.bad", has_text="blocked 2 cells, 1 not; cell 64").wait_for()
        assert set(client.manager.book.blocked.cells) == {18, 20}
        await page.route("**/api/v1/cells/*", lambda route: route.abort())
        await page.locator("#undo:enabled").click()
        await page.locator("#message.bad", has_text="fetch").wait_for()
        await page.unroute("**/api/v1/cells/*")
        await page.locator("#undo:enabled").click()
        await page.locator("#message", has_text="freed 2 cells").wait_for()
        assert not client.manager.book.blocked.cells


async def test_a_zone_has_a_reason_an_end_robots_and_moves(tmp_path: Path) -> None:
    """A zone that is changed shows them, and keeps what was not changed."""
    async with managed(tmp_path) as (_, client, page):
        await page.locator("#tool-zone").click()
        await page.evaluate("rceFleet.tools.use(18)")
        fields = {"reason": "repair", "until": "2099-05-01T12:30", "edges": "20>21, 21>20"}
        for name, text in fields.items():
            await page.locator(f"#zone-{name}").fill(text)
        await page.locator("#zone-kind").select_option("blocked")
        await page.locator("#zone-form [type=submit]").click()
        await page.wait_for_function("rceFleet.work.zones.length === 1")
        zone = client.manager.book.zones["zone1"]
        assert (zone.reason, zone.cells, zone.edges) == ("repair", (18,), ((20, 21), (21, 20)))
        local = time.mktime((2099, 5, 1, 12, 30, 0, 0, 0, -1))
        assert zone.until is not None
        assert abs(zone.until - local) < 86400  # the browser's time zone may be another one
        await page.evaluate("rceFleet.tools.use(18)")
        assert await page.locator("#zone-until").input_value() == fields["until"]
        await page.locator("#zone-edges").fill("")
        await page.locator("#zone-robots").fill("Robot1, Robot2")
        await page.locator("#zone-form [type=submit]").click()
        await page.wait_for_function("rceFleet.work.zones[0].robots.length === 2")
        changed = client.manager.book.zones["zone1"]
        assert (changed.robots, changed.until, changed.reason) == (("Robot1", "Robot2"), zone.until, "repair")


async def put_zone(page: Page, cell: int, **fields: str) -> None:
    """Fill and submit the form of a zone that a click on a cell opens."""
    await page.locator("#tool-zone").click()
    await page.evaluate("cell => rceFleet.tools.use(cell)", cell)
    for name, text in fields.items():
        await page.locator(f"#zone-{name}").fill(text)
    await page.locator("#zone-kind").select_option("blocked")
    await page.locator("#zone-form [type=submit]").click()


async def test_a_new_zone_does_not_replace_one_of_its_name(tmp_path: Path) -> None:
    """Neither one that the page shows, nor one that another user made after the form was opened."""
    async with managed(tmp_path) as (_, client, page):
        await client.ask("PUT", "/zones/gate", {"kind": "blocked", "cells": [3]})
        await put_zone(page, 18, name="gate")
        await page.locator("#message.bad", has_text="zone gate is at revision").wait_for()
        assert client.manager.book.zones["gate"].cells == (3,)
        assert await page.evaluate("rceFleet.operator.undoable") is None
        await page.locator("#zone-name").fill("door")
        await page.locator("#zone-form [type=submit]").click()  # it is still open
        await page.locator("#zone-form").wait_for(state="hidden")
        assert client.manager.book.zones["door"].cells == (18,)


async def test_a_change_of_a_zone_that_changed_is_refused(tmp_path: Path) -> None:
    """Also its removal, and undo of what another user has changed since."""
    async with managed(tmp_path) as (_, client, page):
        zones = client.manager.book.zones
        theirs = {"kind": "blocked", "cells": [18, 19]}
        await put_zone(page, 18, reason="mine")
        await page.wait_for_function("rceFleet.work.zones.length === 1")
        await page.evaluate("rceFleet.tools.use(18)")
        await client.ask("PUT", "/zones/zone1", theirs)
        for button in ("[type=submit]", "#zone-remove"):
            await page.locator("#message").evaluate("message => { message.textContent = ''; }")
            await page.locator(f"#zone-form {button}").click()
            await page.locator("#message.bad", has_text="zone zone1 is at revision").wait_for()
            assert zones["zone1"].cells == (18, 19)
        await page.locator("#message").evaluate("message => { message.textContent = ''; }")
        await page.locator("#undo:enabled").click()
        await page.locator("#message.bad", has_text="zone zone1 is at revision").wait_for()
        assert zones["zone1"].cells == (18, 19)


async def test_changes_of_a_zone_are_undone_one_by_one(tmp_path: Path) -> None:
    """Undo makes revisions, too: they are those that undo of earlier changes is for."""
    async with managed(tmp_path) as (_, client, page):
        zones = client.manager.book.zones
        for reason in ("first", "second"):
            await put_zone(page, 18, reason=reason)
            await page.wait_for_function("reason => rceFleet.work.zones[0]?.reason === reason", arg=reason)
        await page.evaluate("rceFleet.tools.use(18)")
        await page.locator("#zone-remove").click()
        await page.wait_for_function("rceFleet.work.zones.length === 0")
        for reason in ("second", "first"):
            await page.locator("#undo:enabled").click()
            await page.wait_for_function("reason => rceFleet.work.zones[0]?.reason === reason", arg=reason)
        await page.locator("#undo:enabled").click()
        await page.wait_for_function("rceFleet.work.zones.length === 0")
        assert "zone1" not in zones


async def test_a_paused_fleet_offers_no_resume_of_a_robot(tmp_path: Path) -> None:
    """It would change nothing, and its undo would pause the robot for good."""
    async with managed(tmp_path) as (made, client, page):
        client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", mode="paused")
        client.manager.dispatcher.update(time.time(), client.manager.facts)
        paused = {**changes(robot("Robot1", cell=9, mode="paused")), "mode": "paused"}
        made.feed.on_change(made.view.on_changes(paused))
        is_paused = "rceFleet.fleet.robots.get('Robot1')?.activity === 'paused'"
        await page.wait_for_function(is_paused)
        made.feed.on_change(made.view.on_changes({**changes(removed=["Robot1"]), "mode": "paused"}))
        await page.wait_for_function("!rceFleet.fleet.robots.has('Robot1')")
        made.feed.on_change(made.view.on_changes(paused))  # as it was: the manager does not tell it again
        await page.wait_for_function(is_paused)
        asked = "performance.getEntriesByType('resource').map(({ name }) => name)"
        assert await page.evaluate(rf"{asked}.some((name) => /robots\?since=[1-9]/.test(name))")
        await page.locator("tr[data-robot=Robot1]").click()
        await page.locator("#robot-card button", has_text="Pause").click()
        await page.locator("#robot-card button", has_text="Resume").click()
        await page.locator("#robot-card button", has_text="Pause").wait_for()
        assert client.manager.book.entry("Robot1").mode == "automatic"


async def test_undo_lets_no_robot_drive_that_stood_before(tmp_path: Path) -> None:
    """One that was taken out is paused again, and one that was resumed, too; the reason of before is kept."""
    async with managed(tmp_path) as (_, client, page):
        entry = partial(client.manager.book.entry, "Robot1")
        client.manager.facts.robots["Robot1"] = RobotFacts("Robot1")
        for action, mode in (("takeOut", "out_of_service"), ("resume", "automatic")):
            await client.ask("POST", "/robots/Robot1/pause", {"reason": "visitors"})
            await page.wait_for_function("rceFleet.fleet.robots.get('Robot1').ownReason === 'visitors'")
            await page.evaluate(f"void rceFleet.actions.{action}('Robot1')")
            await page.wait_for_function(
                "mode => rceFleet.fleet.robots.get('Robot1').ownMode === mode", arg=mode
            )
            revision = entry().revision
            await page.locator("#undo:enabled").click()
            await page.wait_for_function("rceFleet.fleet.robots.get('Robot1').ownReason === 'visitors'")
            assert (entry().mode, entry().reason, entry().revision) == ("paused", "visitors", revision + 1)


async def test_undo_keeps_a_priority_that_another_user_set(tmp_path: Path) -> None:
    """It is refused then, and sets the priority of before once it is the operator's again."""
    async with managed(tmp_path) as (_, client, page):
        task = (await client.ask("POST", "/tasks", DELIVERY))[1]["id"]
        path = f"/tasks/{task}"
        before = client.manager.book.find(task).order.priority
        await page.evaluate("id => void rceFleet.actions.raise(id, 90)", task)
        await page.locator("#undo:enabled").wait_for()
        await page.locator("#message", has_text="has priority 90").wait_for()
        await client.ask("PATCH", path, {"priority": 70})
        await page.locator("#undo:enabled").click()
        await page.locator("#message.bad", has_text="another user changed it").wait_for()
        assert client.manager.book.find(task).order.priority == 70
        await client.ask("PATCH", path, {"priority": 90})
        await page.locator("#undo:enabled").click()
        await page.locator("#undo:disabled").wait_for()
        await page.wait_for_function(
            "([id, old]) => rceFleet.work.find(id).priority === old", arg=[task, before]
        )


async def test_undo_of_a_mode_sets_the_one_before() -> None:
    """What stopped the fleet cannot be asked for by the page: it asks before the fleet drives again."""
    async with site() as made:
        page = await made.open()
        await page.evaluate("rceFleet.actions.setMode('automatic')")  # as it is already
        await page.locator("#undo:enabled").click()
        await page.locator("#undo:disabled").wait_for()
        made.feed.on_change(made.view.on_changes({**changes(), "mode": "stopped"}))
        await page.locator("#fleet-resume").click()
        await page.locator("#question", has_text="the fleet is stopped").wait_for()
        await page.locator("#question-yes").click()
        await page.wait_for_function("rceFleet.fleet.mode === 'automatic'")
        assert made.modes == ["automatic", "automatic", "automatic"]
        assert await page.locator("#undo:enabled").count() == 0


async def test_a_page_knows_how_long_robots_have_waited(tmp_path: Path) -> None:
    """Also one that is opened later."""
    async with managed(tmp_path) as (made, _, page):
        made.feed.on_change(made.view.on_changes(changes(robot("Robot1", state="waiting", cell=9))))
        await page.wait_for_function("rceFleet.fleet.robots.get('Robot1').waitingSince !== null")
        made.feed.waiting_since["Robot1"] -= 90
        later = await made.open()
        await later.locator("#attention-list li", has_text="has waited for 9").wait_for()


async def test_a_robot_that_is_driven_by_its_poses_is_marked(tmp_path: Path) -> None:
    async with managed(tmp_path) as (made, _, page):
        made.feed.on_change(made.view.on_changes(changes(robot("Robot1", state="driving", pose_only=True))))
        row = page.locator("tr[data-robot=Robot1]")
        await row.locator("td", has_text="driving, by poses").wait_for()
        await row.click()
        await page.locator("#robot-card", has_text="its move client answers nothing").wait_for()


async def test_the_cursor_tells_what_is_in_its_cell(tmp_path: Path) -> None:
    """In a live text; Enter on a robot's row moves the map to the robot."""
    async with managed(tmp_path) as (made, client, page):
        zone = {"kind": "slow", "value": 0.2, "cells": [1, 9]}
        await client.ask("PUT", "/zones/aisle", zone)
        await page.wait_for_function("rceFleet.work.zones.length === 1")
        await page.locator("#map").focus()
        for key in ("ArrowRight", "ArrowUp"):
            await page.keyboard.press(key)
        text = await page.locator("#cursor-text[aria-live=polite]").inner_text()
        assert text == "cell 9, row 1, column 1, Robot1, idle, zone aisle"
        told = [
            block(17, "ann", reason="spill", lifetime=600.0),
            block(18, "bob"),
            block(26, "Robot3", sensed=True),
        ]
        change = changes(blocked=[17, 18, 25], pending=[26], blocks=told)
        made.feed.on_change(made.view.on_changes(change, time.time()))
        await page.wait_for_function("rceFleet.fleet.blocks.size === 3")
        for key, pattern in (
            ("ArrowUp", r"cell 17, row 2, column 1, blocked by ann: spill, until (.+, )?\d\d:\d\d"),
            ("ArrowRight", r"cell 18, row 2, column 2, blocked by bob, since (.+, )?\d\d:\d\d"),
            ("ArrowUp", r"cell 26, .* will be .*, blocked: Robot3 saw something, (.+, )?\d\d:\d\d"),
            ("ArrowLeft", "cell 25, row 3, column 1, blocked"),
        ):
            await page.keyboard.press(key)
            text = await page.locator("#cursor-text").inner_text()
            assert re.fullmatch(pattern, text), text
        x, y = await page.evaluate("rceFleet.view.screenOf(17)")
        await page.locator("#map").hover(position={"x": x, "y": y})
        await page.wait_for_function("document.querySelector('#map').title.includes('by ann: spill')")
        await page.evaluate("rceFleet.view.camera.zoom(4)")
        await page.locator("tr[data-robot=Robot2]").focus()
        await page.keyboard.press("Enter")
        await page.wait_for_function("rceFleet.fleet.selected === 'Robot2'")
        x, y = await page.evaluate("rceFleet.view.screenOf(54)")
        box = await page.locator("#map").bounding_box()
        assert box is not None
        assert (x, y) == pytest.approx((box["width"] / 2, box["height"] / 2), abs=2.0)


async def test_who_did_what_is_found_and_dated(tmp_path: Path) -> None:
    """A station sends what it keeps again when the page connects again: it is listed once."""
    async with managed(tmp_path) as (_, _, page):
        did = {"type": "audit", "name": "block_cell", "detail": "", "done": True}
        now = time.time()
        told = [{**did, "time": now, "user": "anna", "subject": f"cell {cell}"} for cell in range(100)]
        told.insert(0, {**did, "time": 86400.0 * 365.0, "user": "bert", "subject": "cell 7"})
        for _ in range(2):
            await page.evaluate("all => all.forEach((one) => rceFleet.fleet.apply(one))", told)
        await page.wait_for_function("document.querySelectorAll('#audit li').length === 100")
        await page.locator("#audit-more").click()
        assert await page.locator("#audit li").count() == 101
        assert not await page.locator("#audit-more").is_visible()
        assert "197" in await page.locator("#audit li", has_text="bert").locator("time").inner_text()
        await page.locator("#audit-find").fill("BERT")
        assert await page.locator("#audit li").count() == 1
        link = page.locator("#audit-csv")
        assert (await link.get_attribute("href"), await link.is_visible()) == (
            "/api/v1/history?format=csv",
            True,
        )
