"""Measure the operator's page with many robots: ``python -m benchmarks.station [--robots 1000]``.

A station serves the page to headless Chromium, which draws without a graphics card. Robots drive on a
warehouse of 161 x 63 cells at one cell a second; each second every robot has a new plan and ten new poses.
The program prints the script's time for a frame beside its target, the frames a second, and what the socket
carries. The frames a second tell about the renderer of this machine: without a graphics card processors draw
each pixel, and share their time with the station, the robots and the browser itself.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import shutil
import sys
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from aiohttp.test_utils import TestServer

from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from playwright.async_api import CDPSession

ROWS, COLUMNS = 63, 161
SHELF = 10
PLAN = 40
TICK_S = 0.1
TICKS = 10
"""Ticks for a cell."""
TARGET_FPS = 60.0
TARGET_SCRIPT_MS = 16.7
"""A frame at 60 frames a second."""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ARGUMENTS = (
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--enable-unsafe-swiftshader",
)


def warehouse() -> frozenset[int]:
    """Return the cells of the shelves: blocks of 10 x 2 cells with aisles between."""
    return frozenset(
        row * COLUMNS + column
        for row in range(2, ROWS - 2)
        for column in range(6, COLUMNS - 6)
        if row % 3 and (column - 6) % (SHELF + 1) != SHELF
    )


class Traffic:
    """Robots that drive along aisles, each on a way of its own.

    Args:
        robots: Their number.
        seed: Of starts and turns.
    """

    def __init__(self, robots: int, seed: int = 0) -> None:
        self._random = random.Random(seed)
        self.walls = warehouse()
        free = [cell for cell in range(ROWS * COLUMNS) if cell not in self.walls]
        self.ways = {
            f"Robot{number}": self._way([start])
            for number, start in enumerate(self._random.sample(free, robots), start=1)
        }

    def _way(self, way: list[int]) -> list[int]:
        while len(way) < PLAN:
            ahead = way[-1] + (way[-1] - way[-2]) if len(way) > 1 else -1
            around = [cell for cell in self._around(way[-1]) if len(way) < 2 or cell != way[-2]]
            keep = ahead in around and self._random.random() < 0.9
            way.append(ahead if keep else self._random.choice(around or [way[-2]]))
        return way

    def _around(self, cell: int) -> Iterator[int]:
        row, column = divmod(cell, COLUMNS)
        for r, c in ((row, column - 1), (row, column + 1), (row - 1, column), (row + 1, column)):
            if 0 <= r < ROWS and 0 <= c < COLUMNS and r * COLUMNS + c not in self.walls:
                yield r * COLUMNS + c

    def advance(self, robot: str) -> None:
        """Let a robot enter its next cell."""
        self.ways[robot] = self._way(self.ways[robot][1:])

    def state(self, robot: str) -> dict[str, Any]:
        """Return a ``fleet/RobotState`` in its JSON form."""
        way = self.ways[robot]
        return {
            "id": robot,
            "state": "driving",
            "reason": "",
            "cell": way[0],
            "goal": way[-1],
            "plan": way,
            "granted": way[:4],
            "replans": 0,
        }

    def pose(self, robot: str, share: float) -> dict[str, Any]:
        """Return the message of a robot that has driven a share of the way to its next cell."""
        here, there = self.ways[robot][:2]
        (y0, x0), (y1, x1) = divmod(here, COLUMNS), divmod(there, COLUMNS)
        x, y = x0 + 0.5 + share * (x1 - x0), y0 + 0.5 + share * (y1 - y0)
        z, w = {(1, 0): (0.0, 1.0), (-1, 0): (1.0, 0.0), (0, 1): (0.7071, 0.7071)}.get(
            (x1 - x0, y1 - y0), (-0.7071, 0.7071)
        )
        turn = {"x": 0.0, "y": 0.0, "z": z, "w": w}
        return {"pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turn}}}


@asynccontextmanager
async def served(robots: int) -> AsyncIterator[tuple[str, Callable[[], Coroutine[Any, Any, None]]]]:
    """Serve a page; give its address, and what drives the robots until cancelled."""
    traffic = Traffic(robots)
    view = FleetView()
    feed = Feed(view)
    walls = sorted(traffic.walls)
    state = {
        "rows": ROWS,
        "columns": COLUMNS,
        "cell_size": 1.0,
        "origin_x": 0.0,
        "origin_y": 0.0,
        "walls": walls,
        "blocked": walls,
        "pending": [],
        "robots": [traffic.state(robot) for robot in traffic.ways],
    }
    feed.on_change(view.on_state(state))
    names = list(traffic.ways)

    async def drive() -> None:
        tick = 0
        while True:
            started = time.monotonic()
            group = names[tick % TICKS :: TICKS]
            for robot in group:
                traffic.advance(robot)
            changes = {"robots": [traffic.state(robot) for robot in group], "removed": []}
            feed.on_change(view.on_changes({**changes, "blocked": [], "pending": [], "freed": []}))
            for place, robot in enumerate(names):
                view.on_pose(robot, traffic.pose(robot, ((tick - place) % TICKS) / TICKS))
                feed.on_pose(robot)
            feed.send_poses(time.monotonic())
            tick += 1
            await asyncio.sleep(max(0.01, TICK_S - (time.monotonic() - started)))

    station = Station(view, FleetLink.__new__(FleetLink), feed.pages)
    async with TestServer(station.make_app()) as server:
        yield str(server.make_url("/")), drive


MEASURE = """seconds => new Promise(resolve => {
    const { meter } = rceFleet.view;
    Object.assign(meter, { frames: 0, drawn: 0, script_ms: 0, longest_ms: 0 });
    const start = performance.now();
    setTimeout(() => {
        const spent = (performance.now() - start) / 1000;
        resolve({
            renderer: rceFleet.view.renderer.name,
            fps: meter.frames / spent,
            script_ms: meter.script_ms / Math.max(1, meter.frames),
            longest_ms: meter.longest_ms,
            messages_ms: rceFleet.traffic.spent_ms / Math.max(1, rceFleet.traffic.messages),
            kilobytes_s: rceFleet.traffic.bytes / spent / 1000,
        });
    }, 1000 * seconds);
    Object.assign(rceFleet.traffic, { spent_ms: 0, messages: 0, bytes: 0 });
})"""


DRAW = """() => {
    const { view } = rceFleet;
    let [least, now] = [Infinity, performance.now()];
    for (let batch = 0; batch < 20; batch++) {
        const start = performance.now();
        for (let frame = 0; frame < 5; frame++) {
            view.touch("fleet");
            view.draw(now += 16.7);
        }
        least = Math.min(least, (performance.now() - start) / 5);
    }
    return least;
}"""
"""The script's time for a frame, milliseconds: the least of 20 times five frames, which other programs of the
machine did not interrupt."""


async def measure(robots: int, seconds: float, picture: str, renderer: str = "") -> dict[str, Any]:
    """Return the page's figures with some robots."""
    from playwright.async_api import async_playwright

    async with served(robots) as (url, drive), async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        driving = asyncio.create_task(drive())
        try:
            page = await browser.new_page(viewport={"width": 1600, "height": 1000})
            page.set_default_timeout(60_000)
            await page.goto(f"{url}?renderer={renderer}")
            await page.wait_for_function(f"rceFleet.view.scene.robotCount === {robots}")
            await asyncio.sleep(2.0)
            session = await page.context.new_cdp_session(page)
            await session.send("Performance.enable", {"timeDomain": "threadTicks"})
            before = await thread_seconds(session)
            figures: dict[str, Any] = await page.evaluate(MEASURE, seconds)
            spent = await thread_seconds(session) - before
            figures["frame_ms"] = await page.evaluate(DRAW)
            figures["thread_ms"] = 1000 * spent / max(1.0, figures["fps"] * seconds)
            if picture:
                await page.screenshot(path=picture)
            return figures
        finally:
            driving.cancel()
            await browser.close()


async def thread_seconds(session: CDPSession) -> float:
    """Return the processor time that the page's main thread has used, seconds."""
    answer = await session.send("Performance.getMetrics")
    return next(float(metric["value"]) for metric in answer["metrics"] if metric["name"] == "TaskDuration")


def main() -> None:
    """Print the figures beside their target."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, nargs="*", default=[3, 100, 1000])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--renderer", default="", help="canvas: without WebGL")
    parser.add_argument("--pictures", default="", help="folder for a picture of each page")
    options = parser.parse_args()
    if CHROMIUM is None:
        sys.exit("this benchmark needs chromium")
    for robots in options.robots:
        picture = f"{options.pictures}/station-{robots}.png" if options.pictures else ""
        figures = asyncio.run(measure(robots, options.seconds, picture, options.renderer))
        print(
            f"{robots:5} robots: script {figures['frame_ms']:.2f} ms a frame (target {TARGET_SCRIPT_MS:g}),"
            f" {figures['messages_ms']:.2f} ms a message, {figures['kilobytes_s']:.0f} kB/s;"
            f" {figures['renderer']}: {figures['fps']:.1f} frames/s (target {TARGET_FPS:g} with a graphics"
            f" card), main thread {figures['thread_ms']:.2f} ms of processor a frame"
        )


if __name__ == "__main__":
    main()
