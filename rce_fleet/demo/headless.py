"""``rce demo --headless``: one mission, and a report of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import aiohttp

from rce_fleet.demo.counters import Counters
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.mission import Mission
from rce_fleet.demo.play import Play
from rce_fleet.demo.result import Result
from rce_fleet.demo.stage import Stage, set_stage
from rce_fleet.demo.station import StationApi
from rce_fleet.drivers.report import read_report

TAIL = 8
"""How many of the last lines of each program are shown when the time is over."""


async def run_headless(
    play: Play, timeout: float, say: Callable[[str], None], show: Callable[[str], None]
) -> Result:
    """Set the stage, run a mission, and end everything again.

    Args:
        play: What is to be played.
        timeout: Seconds for all of it.
        say: Gets lines for people.
        show: Gets every line that a program prints.
    """
    run = _Run(play, say)
    problem = ""
    try:
        async with asyncio.timeout(timeout) as limit, set_stage(play, show) as stage:
            await stage.children.while_alive(run.perform(stage))
            limit.reschedule(None)  # what was started is ended in peace
    except TimeoutError:
        problem = f"the time of {timeout:g} s is over"
        _tell_tails(play, say)
    except (DemoError, OSError) as error:
        problem = str(error)
    # The world's last word comes at its end: what was touched until then counts.
    truth = read_report(play.report)
    return Result(play.scenario, play.seed, run.mission, truth, run.counters, problem, play.mode)


def _tell_tails(play: Play, say: Callable[[str], None]) -> None:
    """Say what all programs printed last."""
    for log in sorted(play.folder.glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL:]:
            say(f"[{log.stem}] {line}")


class _Run:
    """What is known of a run, however it ends."""

    def __init__(self, play: Play, say: Callable[[str], None]) -> None:
        self.mission: Mission | None = None
        self.counters: Counters | None = None
        self._play = play
        self._say = say

    async def perform(self, stage: Stage) -> None:
        async with aiohttp.ClientSession() as session:
            station = StationApi(session, stage.page)
            self.mission = Mission(
                station, self._play.scenario, stage.truth, self._say, self._play.blocked_cells
            )
            try:
                await self.mission.run()
            finally:
                self.counters = await self._count(stage)

    async def _count(self, stage: Stage) -> Counters | None:
        try:
            return await stage.setting.count()
        except DemoError as error:
            self._say(str(error))
            return None
