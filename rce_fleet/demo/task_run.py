"""A run of some length: tasks are streamed, and the planner's container is killed in between."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import psutil

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.speed import WorldSpeed
from rce_fleet.demo.standstill import Standstill
from rce_fleet.exceptions import StationUnavailableError
from rce_fleet.wiring import FLEET_CONTAINER

if TYPE_CHECKING:
    from rce_fleet.demo.task_stream import TaskStream
    from rce_fleet.drivers.report import WorldReport
    from rce_fleet.station.api import FleetModel
    from rce_fleet.station.client import StationClient

POLL_S = 1.0
"""Seconds between two requests for the fleet's state; more with many robots."""
ROBOTS_PER_POLL_S = 200
"""A request of so many robots' state is sent in a second, at most."""
TELL_EVERY = 30.0
"""Seconds between two lines for the user."""
KILLS = 2
"""How often the planner's container is killed, unless the run says otherwise."""
STANDSTILL_LIMIT = 60.0
"""A robot with a task that stands longer than this is in a deadlock, seconds."""
LAST_TASKS = 60.0
"""Seconds after the stream's end in which open tasks may still be done."""


def poll_s(robots: int) -> float:
    """Return the seconds between two requests for the state of so many robots."""
    return max(POLL_S, robots / ROBOTS_PER_POLL_S)


def shortest_run(robots: int) -> float:
    """Return how long a run with so many robots must be, seconds, in which the planner is killed."""
    return (KILLS + 1) * poll_s(robots)


class TaskRun:
    """Streams tasks for some time.

    Args:
        station: The station's API.
        robots: Number of robots.
        tasks: The stream.
        duration: Seconds for which tasks are sent.
        truth: Returns the state of the simulated world.
        kill_planner: Kills the planner's container with SIGKILL.
        say: Prints a line for the user.
        kills: How often the planner's container is killed, spread evenly over the run.

    Attributes:
        tasks: The stream.
        standstill: How long robots stood.
        speed: How fast the simulated world runs.
        planner_kills: How often the planner was killed.
        replans: How often each robot got a new path.
    """

    def __init__(
        self,
        station: StationClient,
        robots: int,
        tasks: TaskStream,
        duration: float,
        truth: Callable[[], WorldReport | None],
        kill_planner: Callable[[], None],
        say: Callable[[str], None],
        *,
        kills: int = KILLS,
    ) -> None:
        self._kills = kills
        self.tasks = tasks
        self.standstill = Standstill()
        self.planner_kills = 0
        self._station = station
        self._robots = robots
        self._duration = duration
        self._truth = truth
        self._kill_planner = kill_planner
        self._say = say
        self._poll = poll_s(robots)
        self.speed = WorldSpeed()

    async def run(self) -> None:
        """Wait until all robots are there, stream tasks, and wait for the last ones."""
        while True:
            if self._all_placed(await self._read_fleet()):
                break
            await asyncio.sleep(self._poll)
        self._say(f"{self._robots} robots are ready; streaming tasks for {self._duration:g} s")
        began = told = time.monotonic()
        while (now := time.monotonic()) < began + self._duration:
            await self._step(more=True)
            if self.planner_kills < self._kills and now - began >= self._next_kill:
                self._kill()
            if now - told >= TELL_EVERY:
                told = now
                self._say(f"{now - began:.0f} s: {self.summary}")
            await asyncio.sleep(self._poll)
        self._say("no more tasks; waiting for the last ones")
        while self.tasks.open and time.monotonic() < began + self._duration + LAST_TASKS:
            await self._step(more=False)
            await asyncio.sleep(self._poll)
        await self.tasks.settle()

    @property
    def summary(self) -> str:
        """What happened so far, in words."""
        return (
            f"{self.tasks.done} tasks done ({self.tasks_per_hour:.0f} per hour), {self.tasks.open} open, "
            f"longest standstill {self.standstill.longest:.0f} s, "
            f"real-time factor {self.speed.factor:.2f}"
        )

    @property
    def tasks_per_hour(self) -> float:
        """Tasks done in an hour, by the time of the simulated world."""
        return 3600 * self.tasks.done / self.speed.simulated if self.speed.simulated else 0.0

    @property
    def faults(self) -> list[str]:
        """What went wrong, in words."""
        tasks, still, faults = self.tasks, self.standstill, []
        if not tasks.done:
            faults.append("no task was done")
        if tasks.lost:
            faults.append(f"{len(tasks.lost)} tasks were lost: {', '.join(tasks.lost[:10])}")
        if tasks.failed:
            faults.append(f"{len(tasks.failed)} tasks failed: {'; '.join(tasks.failed[:10])}")
        if still.longest > STANDSTILL_LIMIT:
            faults.append(f"{still.robot} stood still for {still.longest:.0f} s with a task")
        if self.planner_kills < self._kills:
            faults.append(f"the planner's container was killed {self.planner_kills} times, not {self._kills}")
        return faults

    def as_json(self) -> dict[str, Any]:
        """Return the keys of the report."""
        return {
            "tasks_accepted": self.tasks.accepted,
            "tasks_done": self.tasks.done,
            "tasks_open": self.tasks.open,
            "tasks_lost": len(self.tasks.lost),
            "tasks_failed": len(self.tasks.failed),
            "tasks_per_hour": round(self.tasks_per_hour, 1),
            "planner_kills": self.planner_kills,
            "longest_standstill_s": round(self.standstill.longest, 1),
        }

    @property
    def duration(self) -> float:
        """Seconds since the first task."""
        return self.speed.seconds

    @property
    def _next_kill(self) -> float:
        """When the planner is killed next, seconds after the first task."""
        return self._duration * (self.planner_kills + 1) / (self._kills + 1)

    def _kill(self) -> None:
        try:
            self._kill_planner()
        except DemoError as error:
            self._say(str(error))  # it is tried again
        else:
            self.planner_kills += 1
            self._say("killed the planner's container")

    async def _step(self, *, more: bool) -> None:
        fleet, truth, now = await self._read_fleet(), self._truth(), time.monotonic()
        if truth is not None:
            self.speed.look(truth, now)
            self.standstill.update(truth, self.tasks.busy)
        if fleet is not None:
            await self.tasks.update(fleet, more=more)

    async def _read_fleet(self) -> FleetModel | None:
        try:
            return await self._station.fleet()
        except StationUnavailableError:
            return None

    def _all_placed(self, fleet: FleetModel | None) -> bool:
        if fleet is None:
            return False
        return sum(robot.cell is not None and robot.state == "idle" for robot in fleet.robots) >= self._robots


def kill_container(user: str, tag: str = FLEET_CONTAINER, demo: int | None = None) -> None:
    """Kill all processes of a container of the demo's engine with SIGKILL.

    Args:
        user: User that the container belongs to.
        tag: Tag of the container.
        demo: Process of the demo; this one if None.

    Raises:
        DemoError: The engine has no such container now.
    """
    for process in psutil.Process(demo).children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it ended meanwhile
            line = " ".join(process.cmdline()).strip()  # forks show theirs as one word
            if not line.endswith(f"rce_container.environment {user}/{tag}"):
                continue
            for each in (process, *process.children(recursive=True)):
                with contextlib.suppress(psutil.NoSuchProcess):
                    each.kill()
            return
    raise DemoError(f"the container {tag} has no process: it is not running")
