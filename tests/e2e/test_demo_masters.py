"""``rce demo --replicas 3``: the leading master is killed, robots drive on, the page tells who leads."""

from __future__ import annotations

import contextlib
import os
import pty
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.async_api import Page, ViewportSize, async_playwright
from support.browser import CHROMIUM
from support.demo import LIGHT, Demo, run_headless, running_demo
from support.engine import until
from support.ports import free_row

from rce_fleet.drivers.report import read_report

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.real_time("machines"),
    pytest.mark.needs("etcd", "pymunk"),
    pytest.mark.timeout(900),
]

ARTIFACTS = Path(__file__).parents[2] / "artifacts"
DESKTOP, PHONE = ViewportSize(width=1280, height=800), ViewportSize(width=390, height=844)
COUNT = 3
START_S = 300.0
WAIT_MS = 180_000
STANDSTILL_S = 30.0
"""Longest time that a robot with a task may stand, simulated: others are in its way now and then."""


def replicas() -> list[object]:
    """Return the options of a demo with three masters, beside those of every test."""
    ports = ("--http-port", free_row(COUNT), "--control-port", free_row(COUNT))
    return ["--replicas", COUNT, *ports, "--runtime", "process", "--full-stack", 0, "--robots", 3]


async def test_robots_drive_while_leading_masters_are_killed() -> None:
    """The masters are killed at random moments of a headless run; all that is measured is in its report."""
    words = ("--duration", 20, "--tasks", "goals", "--seed", 5)
    code, report, text = await run_headless(*replicas(), *words, timeout=700)
    assert code == 0, text
    assert report["ok"] is True
    masters = report["masters"]
    assert (masters["count"], masters["kills"]) == (COUNT, len(masters["changes"]))
    assert masters["kills"] >= 1
    terms = [change["term"] for change in masters["changes"]]
    assert terms == sorted(set(terms))
    # A kill comes while a robot drives, so also on a slow machine one drives until the next master leads.
    assert min(change["driven_m"] for change in masters["changes"]) > 0
    assert report["collisions"] == 0
    assert report["tasks_done"] >= 1
    assert report["tasks_lost"] == 0
    assert report["longest_standstill_s"] < STANDSTILL_S
    assert report["planner_kills"] == 0


@contextlib.contextmanager
def terminal() -> Iterator[tuple[int, int]]:
    """A pseudo terminal: the end of the person, and that of the program."""
    person, program = pty.openpty()
    try:
        yield person, program
    finally:
        os.close(person)
        os.close(program)


def driven(demo: Demo) -> float:
    """Return how far all robots have driven in the simulated world, metres."""
    (report,) = demo.folder.glob("rce-demo-*/world.json")
    truth = read_report(report)
    return 0.0 if truth is None else sum(robot.distance_m for robot in truth.robots)


async def term_of(page: Page, *, above: int) -> int:
    """Wait until the page shows a leading master in a newer term."""
    await page.wait_for_function(
        """above => {
            const found = rceFleet.fleet.masters;
            return found && found.term > above && found.masters.some(({ role }) => role === "leader");
        }""",
        arg=above,
    )
    return int(await page.evaluate("rceFleet.fleet.masters.term"))


@pytest.mark.needs("chromium")
async def test_key_and_button_kill_the_leading_master() -> None:
    with terminal() as (person, program):
        async with (
            running_demo(*replicas(), *LIGHT, "--seed", 4, stdin=program, start_timeout=START_S) as demo,
            async_playwright() as playwright,
        ):
            browser = await playwright.chromium.launch(
                executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--no-first-run"]
            )
            try:
                page = await browser.new_page(viewport=DESKTOP, color_scheme="light")
                page.set_default_timeout(WAIT_MS)
                await page.goto(demo.page)
                first = await term_of(page, above=0)
                before = driven(demo)

                await page.locator("#kill-leader").click()
                second = await term_of(page, above=first)
                assert "killed the leading master" in demo.output()
                shown = await page.locator("#masters").text_content() or ""
                assert f"term {second}" in shown
                assert "The last change took" in shown
                assert shown.count("leads") == 1
                await picture(page, "masters.png")

                os.write(person, b"k")
                third = await term_of(page, above=second)
                assert demo.output().count("killed the leading master") == 2
                await until(lambda: driven(demo) > before + 1.0, timeout=120, what="the robots drive")

                await page.set_viewport_size(PHONE)
                await page.locator("#masters").scroll_into_view_if_needed()
                width = await page.evaluate("document.documentElement.scrollWidth")
                assert width <= PHONE["width"]
                await picture(page, "masters-phone.png")
                assert third > second
            finally:
                await browser.close()


async def picture(page: Page, name: str) -> None:
    """Keep a picture to be looked at after the test."""
    ARTIFACTS.mkdir(exist_ok=True)
    await page.locator("#masters").scroll_into_view_if_needed()
    await page.screenshot(path=ARTIFACTS / name)
