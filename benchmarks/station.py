"""Measure the operator's page with many robots: ``python -m benchmarks.station [--quick] [--robots 1000]``.

A station serves the page to headless Chromium, with a graphics card if there is one. Robots drive on a
warehouse of 161 x 63 cells at one cell a second; each second every robot has a new plan and ten new poses.
A fleet manager in the same process has a task for each robot, and batteries that get empty. The program
prints the script's time for a frame beside its target, the frames a second, and what socket and requests
carry. The frames a second tell about the renderer of this machine: without a graphics card processors draw
each pixel, and share their time with the station, the robots and the browser itself.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from aiohttp.test_utils import TestServer

from benchmarks.figures import Results, show
from rce_fleet.journal.journal import Journal
from rce_fleet.manager.fleet_routes import ROUTES as FLEET_ROUTES
from rce_fleet.manager.manager import FleetManager
from rce_fleet.manager.requests import FleetRequest, Router
from rce_fleet.manager.task_routes import ROUTES as TASK_ROUTES
from rce_fleet.planning.grid import GridMap
from rce_fleet.station.feed import Feed
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.task import TaskState

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from playwright.async_api import CDPSession

    from rce_fleet.manager.planner_link import PlannerLink

ROWS, COLUMNS = 63, 161
SHELF = 10
PLAN = 40
TICK_S = 0.1
TICKS = 10
"""Ticks for a cell."""
DRAIN = 0.0005
"""Share of a full battery that a robot needs in a second."""
TARGET_FPS = 60.0
TARGET_SCRIPT_MS = 16.7
"""A frame at 60 frames a second."""
SIZES = (3, 100, 1000)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ARGUMENTS = (
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--enable-unsafe-swiftshader",
)
GPU_ARGUMENTS = ("--enable-gpu", "--ignore-gpu-blocklist")
GPU_DEVICES = ("/dev/dri/renderD128", "/dev/nvidia0")
SOFTWARE = ("swiftshader", "llvmpipe", "software", "basic render")
"""Words in the names of renderers that draw without a graphics card."""


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


class ManagedLink(FleetLink):
    """A link to a fleet manager of this process, and to no planner.

    Args:
        traffic: The robots, each of which does a task.
        folder: For the manager's journal.
    """

    can_ask_manager = expects_manager = True

    def __init__(self, traffic: Traffic, folder: Path) -> None:
        journal, log = Journal(folder / "journal.sqlite"), logging.getLogger("manager")
        self.manager = FleetManager(journal, cast("PlannerLink", None), TaskRules(), log)
        facts, book = self.manager.facts, self.manager.book
        facts.grid = book.grid = GridMap(ROWS, COLUMNS, blocked=traffic.walls)
        facts.is_live = True
        for number, (robot, way) in enumerate(traffic.ways.items()):
            battery = number / len(traffic.ways)
            facts.robots[robot] = RobotFacts(robot, "driving", cell=way[0], goal=way[-1], battery=battery)
            task = book.create(Order((Stop(Action.GO, (way[-1],)),)), self.manager.clock())
            book.put_record(replace(task, state=TaskState.RUNNING, robot=robot))
        self._router = Router(self.manager, [*TASK_ROUTES, *FLEET_ROUTES])

    def forget_requests(self) -> None:
        """Keep none: no planner is connected."""

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        """Have the manager answer a request."""
        answer = await self._router.answer(FleetRequest(**request))
        return {"status": answer.status, "body": answer.body, "revision": answer.revision}

    def advance(self, traffic: Traffic, robots: list[str], seconds: float) -> None:
        """Tell the manager where robots are, and that their batteries got emptier."""
        for name in robots:
            robot = self.manager.facts.robots[name]
            robot.cell, robot.goal = traffic.ways[name][0], traffic.ways[name][-1]
            robot.battery = ((robot.battery or 0.0) - DRAIN * seconds) % 1.0


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
            link.advance(traffic, group, TICKS * TICK_S)
            changes = {"robots": [traffic.state(robot) for robot in group], "removed": []}
            feed.on_change(view.on_changes({**changes, "blocked": [], "pending": [], "freed": []}))
            for place, robot in enumerate(names):
                view.on_pose(robot, traffic.pose(robot, ((tick - place) % TICKS) / TICKS))
                feed.on_pose(robot)
            feed.send_poses(time.monotonic())
            tick += 1
            await asyncio.sleep(max(0.01, TICK_S - (time.monotonic() - started)))

    with tempfile.TemporaryDirectory() as folder:
        link = ManagedLink(traffic, Path(folder))
        station = Station(view, link, feed.pages)
        await station.fleet_api.manager.look()
        try:
            async with TestServer(station.make_app()) as server:
                yield str(server.make_url("/")), drive
        finally:
            await link.manager.close()


MEASURE = """seconds => new Promise(resolve => {
    const { meter } = rceFleet.view;
    Object.assign(meter, { frames: 0, drawn: 0, script_ms: 0, longest_ms: 0 });
    performance.clearResourceTimings();
    const isRequest = ({ name }) => name.includes("/api/v1/");
    const requests = () => performance.getEntriesByType("resource").filter(isRequest);
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
            requests_kilobytes_s: requests().reduce((sum, one) => sum + one.decodedBodySize, 0) / spent / 1e3,
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


RENDERER = """() => {
    const gl = document.createElement("canvas").getContext("webgl2");
    const info = gl?.getExtension("WEBGL_debug_renderer_info");
    return gl ? gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : "";
}"""
"""What draws: the name of a graphics card, or of a program; empty without WebGL."""


def browser_arguments() -> list[str]:
    """Return Chromium's arguments, with a graphics card if the machine has one."""
    has_gpu = any(Path(device).exists() for device in GPU_DEVICES)
    return [*ARGUMENTS, *(GPU_ARGUMENTS if has_gpu else ())]


def is_graphics_card(renderer: str) -> bool:
    """Return whether the name of a renderer is that of a graphics card."""
    return bool(renderer) and not any(word in renderer.lower() for word in SOFTWARE)


async def measure(robots: int, seconds: float, picture: str, renderer: str = "") -> dict[str, Any]:
    """Return the page's figures with some robots."""
    from playwright.async_api import async_playwright

    async with served(robots) as (url, drive), async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=browser_arguments())
        driving = asyncio.create_task(drive())
        try:
            page = await browser.new_page(viewport={"width": 1600, "height": 1000})
            page.set_default_timeout(60_000)
            await page.goto(f"{url}?renderer={renderer}")
            await page.wait_for_function(f"rceFleet.view.scene.robotCount === {robots}")
            await page.wait_for_function("rceFleet.work.trouble === null")
            await asyncio.sleep(2.0)
            session = await page.context.new_cdp_session(page)
            await session.send("Performance.enable", {"timeDomain": "threadTicks"})
            before = await thread_seconds(session)
            found: dict[str, Any] = await page.evaluate(MEASURE, seconds)
            spent = await thread_seconds(session) - before
            script_ms = await page.evaluate(DRAW)
            drawn_by = await page.evaluate(RENDERER) if found["renderer"] != "canvas" else ""
            if picture:
                await page.screenshot(path=picture)
        finally:
            driving.cancel()
            await browser.close()
    row: dict[str, Any] = {
        "robots": robots,
        "script ms per frame": round(script_ms, 2),
        "target, script ms": TARGET_SCRIPT_MS,
        "main thread ms per frame": round(1000 * spent / max(1.0, found["fps"] * seconds), 2),
        "ms per message": round(found["messages_ms"], 2),
        "socket kB/s": round(found["kilobytes_s"]),
        "requests kB/s": round(found["requests_kilobytes_s"]),
        "renderer": found["renderer"],
        "frames/s": round(found["fps"], 1),
    }
    if is_graphics_card(drawn_by):
        row |= {"frames/s, graphics card": row["frames/s"], "target, frames/s": TARGET_FPS}
    return row


async def thread_seconds(session: CDPSession) -> float:
    """Return the processor time that the page's main thread has used, seconds."""
    answer = await session.send("Performance.getMetrics")
    return next(float(metric["value"]) for metric in answer["metrics"] if metric["name"] == "TaskDuration")


def main() -> None:
    """Print the figures beside their targets, and save them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.station", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="3 and 100 robots, a shorter time")
    parser.add_argument("--robots", type=int, nargs="*", default=[])
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--renderer", default="", help="canvas: without WebGL")
    parser.add_argument("--pictures", default="", help="folder for a picture of each page")
    options = parser.parse_args()
    if CHROMIUM is None:
        sys.exit("this benchmark needs chromium")
    is_partial = bool(options.robots or options.seconds or options.renderer)
    seconds = options.seconds or (2.0 if options.quick else 5.0)
    results = Results("station", quick=options.quick or is_partial)
    rows = []
    for robots in options.robots or (SIZES[:-1] if options.quick else SIZES):
        picture = f"{options.pictures}/station-{robots}.png" if options.pictures else ""
        rows.append(asyncio.run(measure(robots, seconds, picture, options.renderer)))
    show("The operator's page", rows)
    results.keep("page", rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
