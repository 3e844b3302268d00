"""``rce demo --headless``: one mission, and a report of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import aiohttp

from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.counters import Counters
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.mission import Mission
from rce_fleet.demo.result import Result
from rce_fleet.demo.running import RunningDemo, start_demo
from rce_fleet.demo.station import StationApi
from rce_fleet.drivers.report import read_report

TAIL = 8
"""How many of the last lines of each program are shown when the time is over."""


async def run_headless(
    config: DemoConfig, timeout: float, say: Callable[[str], None], show: Callable[[str], None]
) -> Result:
    """Start the demo, run a mission, and end everything again.

    Args:
        config: What to run.
        timeout: Seconds for all of it.
        say: Gets lines for people.
        show: Gets every line that a program prints.
    """
    run = _Run(config, say)
    problem = ""
    try:
        async with asyncio.timeout(timeout) as limit, start_demo(config, show) as demo:
            await demo.children.while_alive(run.perform(demo))
            limit.reschedule(None)  # what was started is ended in peace
    except TimeoutError:
        problem = f"the time of {timeout:g} s is over"
        _tell_tails(config, say)
    except (DemoError, OSError) as error:
        problem = str(error)
    # The world's last word comes at its end: what was touched until then counts.
    truth = read_report(config.report)
    return Result(config.scenario, config.seed, run.mission, truth, run.counters, problem, config.mode)


def _tell_tails(config: DemoConfig, say: Callable[[str], None]) -> None:
    """Say what all programs printed last."""
    for log in sorted(config.folder.glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL:]:
            say(f"[{log.stem}] {line}")


class _Run:
    """What is known of a run, however it ends."""

    def __init__(self, config: DemoConfig, say: Callable[[str], None]) -> None:
        self.mission: Mission | None = None
        self.counters: Counters | None = None
        self._config = config
        self._say = say

    async def perform(self, demo: RunningDemo) -> None:
        async with aiohttp.ClientSession() as session:
            station = StationApi(session, demo.page)
            self.mission = Mission(
                station, self._config.scenario, demo.truth, self._say, self._config.blocked_cells
            )
            try:
                await self.mission.run()
            finally:
                self.counters = await self._count(demo)

    async def _count(self, demo: RunningDemo) -> Counters | None:
        try:
            return await demo.programs.count()
        except DemoError as error:
            self._say(str(error))
            return None
