"""``rce demo --headless``: one run of the scenario, and its report."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

import aiohttp

from rce_fleet.demo.config import DemoConfig, Mode, TaskSource
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.goal_tasks import GoalTasks
from rce_fleet.demo.judge import Judge, RobotScore
from rce_fleet.demo.manager_tasks import ManagerTasks
from rce_fleet.demo.masters import MasterKills
from rce_fleet.demo.modes import RunningDemo, start_demo
from rce_fleet.demo.scenario_run import ScenarioRun
from rce_fleet.demo.task_run import KILLS, TaskRun, kill_container
from rce_fleet.demo.task_stream import TaskStream
from rce_fleet.demo.traffic import MessageTotals
from rce_fleet.drivers.report import WorldReport, read_report
from rce_fleet.exceptions import FleetError
from rce_fleet.planning.scenario import Scenario
from rce_fleet.station.client import StationClient

if TYPE_CHECKING:
    from rce_fleet.demo.exploration import Explored

TAIL_LINES = 8
"""How many of each program's last lines are shown after a timeout."""


@dataclass(frozen=True, slots=True)
class RunReport:
    """The outcome of a headless run.

    Attributes:
        scenario: The scenario.
        seed: Seed that it was drawn from.
        run: The run; None if it did not begin.
        truth: The simulated world at the end; None if the world did not report it.
        totals: Messages that were received; None if they could not be read.
        problem: Why the run was stopped early; empty if it was not.
        mode: What carried the fleet's messages.
        scores: How well each robot localized; empty if the run did not begin.
        explored: What the first robot explored; None if there was a map, or it was not complete.
        tasks: The run, if tasks were streamed; then there is no ``run``.
        masters: The kills of leading masters; None if there was one master.
    """

    scenario: Scenario
    seed: int
    run: ScenarioRun | None
    truth: WorldReport | None
    totals: MessageTotals | None
    problem: str = ""
    mode: Mode = Mode.CLOUD
    scores: Mapping[str, RobotScore] = field(default_factory=dict)
    explored: Explored | None = None
    tasks: TaskRun | None = None
    masters: MasterKills | None = None

    @property
    def ok(self) -> bool:
        """Whether every robot reached its goal, or did tasks, without a collision."""
        return not self.faults

    @property
    def faults(self) -> list[str]:
        """What went wrong, in words."""
        faults = [self.problem] if self.problem else []
        if self.tasks is not None:
            faults += self.tasks.faults
        else:
            run = self.run
            missing = list(self.scenario.robots) if run is None else run.missing
            if missing:
                faults.append(f"not at their goals: {'; '.join(missing)}")
            if missing and run is not None and run.refusal:
                faults.append(f"the last request that failed: {run.refusal}")
        if self.masters is not None:
            faults += self.masters.faults
        if self.truth is None:
            faults.append("the simulated world wrote no report")
        elif self.truth.collisions.total:
            places = "; ".join(
                f"{contact.robots[0]} and {contact.robots[1] or 'another'} at {contact.time_s:.1f} s in cell"
                f" {contact.cell}"
                for contact in self.truth.contacts
            )
            faults.append(
                f"robots collided {self.truth.collisions.total} times{f': {places}' if places else ''}"
            )
        return faults

    @property
    def summary(self) -> str:
        """What a good run did, in words."""
        if self.tasks is not None:
            return self.tasks.summary
        factor = 0.0 if self.run is None else self.run.speed.factor
        return f"all robots reached their goals in {self._duration:.2f} s, real-time factor {factor:.2f}"

    @property
    def _duration(self) -> float:
        run = self.run or self.tasks
        return 0.0 if run is None else round(run.duration, 2)

    def as_json(self) -> dict[str, Any]:
        """Return the report as it is written to the file."""
        truth, run, totals = self.truth, self.run, self.totals
        driven = run or self.tasks
        blocked = [] if run is None else run.blocker.done
        return {
            "ok": self.ok,
            "mode": self.mode.value,
            **({} if self.explored is None else {"exploration": self.explored.as_json()}),
            "duration_s": self._duration,
            "real_time_factor": None if driven is None else round(driven.speed.factor, 3),
            **({} if self.tasks is None else self.tasks.as_json()),
            "collisions": None if truth is None else truth.collisions.total,
            "min_separation_m": None if truth is None else truth.min_separation_m,
            "robots": list(self._robots()),
            "engine": {
                "messages": None if totals is None else totals.messages,
                "dropped": None if totals is None else totals.dropped,
            },
            **({} if self.masters is None else {"masters": self.masters.as_json()}),
            "blocked_cell": blocked[0] if blocked else None,
            "blocked_cells": blocked,
            "seed": self.seed,
            "faults": self.faults,
        }

    def _robots(self) -> Iterator[dict[str, Any]]:
        """Return what the report says of each robot."""
        scenario, run, truth = self.scenario, self.run, self.truth
        distances = {} if truth is None else {robot.id: robot.distance_m for robot in truth.robots}
        for robot, start, goal in zip(scenario.robots, scenario.starts, scenario.goals, strict=True):
            goals = {
                "goal_cell": goal,
                "reached": run is not None and robot in run.reached,
                "replans": 0 if run is None else run.replans[robot],
            }
            yield {
                "id": robot,
                "start_cell": start,
                **(goals if self.tasks is None else {}),
                "distance_m": distances.get(robot, 0.0),
                **_localization(self.scores.get(robot, RobotScore())),
            }

    def write(self, path: Path) -> None:
        """Write the report to a file, as JSON."""
        path.write_text(json.dumps(self.as_json(), indent=2) + "\n", encoding="utf-8")


async def run_headless(
    config: DemoConfig, timeout: float, say: Callable[[str], None], show: Callable[[str], None]
) -> RunReport:
    """Start the demo, run its scenario, and stop everything.

    Args:
        config: What to run.
        timeout: Seconds for start and run.
        say: Prints a line for the user.
        show: Called with every line that a program prints.
    """
    headless = _HeadlessRun(config, say)
    problem = ""
    try:
        async with asyncio.timeout(timeout) as limit, start_demo(config, show, say) as demo:
            await demo.group.run_while_alive(headless.perform(demo))
            limit.reschedule(None)  # stopping the programs has its own time limits
    except TimeoutError:
        problem = f"timeout: the run was not complete after {timeout:g} s"
        _show_tails(config, say)
    except (FleetError, OSError) as error:
        problem = str(error)
    # The world writes its last report when it stops, with all collisions until then.
    truth = read_report(config.report)
    return RunReport(
        config.scenario,
        config.seed,
        headless.run,
        truth,
        headless.totals,
        problem,
        config.mode,
        headless.scores,
        headless.explored,
        headless.tasks,
        headless.masters,
    )


def _localization(score: RobotScore) -> dict[str, Any]:
    """Return what the report says of a robot's localization and navigation."""
    rmse = score.rmse
    return {
        "localization_rmse_m": None if rmse is None else round(rmse, 4),
        "localization_max_m": None if rmse is None else round(score.max_error, 4),
        "recoveries": score.recoveries,
    }


def _show_tails(config: DemoConfig, say: Callable[[str], None]) -> None:
    """Print the last lines of all programs."""
    for log in sorted(config.folder.glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL_LINES:]:
            say(f"[{log.stem}] {line}")


class _HeadlessRun:
    """A run and its message totals, as far as they came before an error.

    Args:
        config: What to run.
        say: Prints a line for the user.
    """

    def __init__(self, config: DemoConfig, say: Callable[[str], None]) -> None:
        self.run: ScenarioRun | None = None
        self.tasks: TaskRun | None = None
        self.totals: MessageTotals | None = None
        self.scores: Mapping[str, RobotScore] = {}
        self.explored: Explored | None = None
        self.masters: MasterKills | None = None
        self._config = config
        self._say = say

    async def perform(self, demo: RunningDemo) -> None:
        self.explored = demo.explored
        judge = Judge(demo.mode.graphs())
        self.scores = judge.scores
        async with aiohttp.ClientSession() as session, judge:
            station = StationClient(session, demo.page)
            work = self._stream_tasks(station, demo) if self._config.duration else self._drive(station, demo)
            if self._config.replicas > 1:
                rng = Random(self._config.seed)  # noqa: S311 - for moments, not for secrets
                self.masters = MasterKills(self._config.master_urls, rng, demo.truth, self._say)
                work = self.masters.beside(work)
            try:
                await work
            finally:
                self.totals = await self._read_totals(demo)

    async def _drive(self, station: StationClient, demo: RunningDemo) -> None:
        """Send each robot to its goal."""
        self.run = ScenarioRun(
            station, self._config.scenario, demo.truth, self._say, self._config.blocked_cells
        )
        await self.run.run()

    async def _stream_tasks(self, station: StationClient, demo: RunningDemo) -> None:
        """Give the fleet tasks for some time."""
        config, world = self._config, self._config.world
        cells: Sequence[int] = [] if world is None else [*world.docks, *world.shelves]
        rng = Random(config.seed)  # noqa: S311 - for tasks, not for secrets
        robots = len(config.scenario.robots)
        if not cells or (config.lanes is not None and len(cells) < 2 * robots):  # few may be on lanes
            cells = config.goal_cells
        stream: TaskStream = (
            ManagerTasks(demo.page, cells, rng, robots)
            if config.tasks is TaskSource.MANAGER
            else GoalTasks(station, cells, rng)
        )
        async with stream:
            self.tasks = TaskRun(
                station,
                robots,
                stream,
                config.duration or 0.0,
                demo.truth,
                partial(kill_container, config.account.user),
                self._say,
                kills=KILLS if config.replicas == 1 else 0,
            )
            await self.tasks.run()

    async def _read_totals(self, demo: RunningDemo) -> MessageTotals | None:
        try:
            return await demo.mode.read_totals()
        except DemoError as error:
            self._say(str(error))
            return None
