"""The masters of a demo with several: who leads, and killing the one that does."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import aiohttp
import psutil

from rce_fleet.demo.exceptions import DemoError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence
    from random import Random

    from rce_fleet.drivers.report import WorldReport

TASK_SETS = 2
"""A robot and a container task set of the demo's engine."""
CALM_S = (3.0, 9.0)
"""Shortest and longest time from a change of the lead to the next kill, seconds."""
CHANGE_TIMEOUT_S = 180.0
"""After this time without a leading master a run is a failure."""
_POLL_S = 0.1
_TIMEOUT = aiohttp.ClientTimeout(total=2.0)


@dataclass(frozen=True, slots=True)
class LeaderView:
    """The leading master.

    Attributes:
        url: Its HTTP server.
        term: The term in which it leads.
        task_sets: How many task sets are connected to it.
    """

    url: str
    term: int
    task_sets: int


@dataclass(frozen=True, slots=True)
class Change:
    """A change of the lead, after a kill.

    Attributes:
        seconds: From the kill until a master led and both task sets were connected to it.
        term: The new term.
        driven: How far all robots together drove meanwhile, metres.
    """

    seconds: float
    term: int
    driven: float


async def find_leader(session: aiohttp.ClientSession, urls: Sequence[str]) -> LeaderView | None:
    """Return the master that leads in the newest term; None while none does."""
    found = [view for view in await asyncio.gather(*(_ask(session, url) for url in urls)) if view]
    return max(found, key=lambda view: view.term, default=None)


async def kill_leader(urls: Sequence[str]) -> LeaderView:
    """Kill the leading master of this demo with SIGKILL; return how it was.

    Raises:
        DemoError: None leads now, or it has no process below this one.
    """
    async with aiohttp.ClientSession(timeout=_TIMEOUT) as session:
        leader = await find_leader(session, urls)
    if leader is None:
        raise DemoError("no master leads now, so none was killed")
    port = leader.url.rstrip("/").rpartition(":")[2]
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it ended meanwhile
            line = " ".join(process.cmdline())
            if "rce_master" in line and f'"http_port": {port}' in line:
                process.kill()
                return leader
    raise DemoError(f"the master at {leader.url} has no process: it ended just now")


class MasterKills:
    """Kills the leading master at random moments while robots drive, and measures how another one takes over.

    Args:
        urls: The masters.
        rng: Chooses the moments.
        truth: Returns the state of the simulated world.
        say: Prints a line for the user.

    Attributes:
        changes: What happened, in order.
        fault: What went wrong; empty if nothing.
    """

    def __init__(
        self,
        urls: Sequence[str],
        rng: Random,
        truth: Callable[[], WorldReport | None],
        say: Callable[[str], None],
    ) -> None:
        self.changes: list[Change] = []
        self.fault = ""
        self._urls = tuple(urls)
        self._rng = rng
        self._truth = truth
        self._say = say
        self._ending = asyncio.Event()

    async def beside(self, work: Awaitable[None]) -> None:
        """Kill masters while some work is done; a change of the lead is completed at its end."""
        kills = asyncio.create_task(self._run())
        try:
            await work
        except BaseException:
            kills.cancel()
            await asyncio.gather(kills, return_exceptions=True)
            raise
        self._ending.set()
        await kills

    @property
    def faults(self) -> list[str]:
        """What went wrong, in words."""
        found = [self.fault] if self.fault else []
        if not self.changes and not self.fault:
            found.append("the leading master was not killed: the run was too short, or no robot drove")
        return found

    def as_json(self) -> dict[str, Any]:
        """Return the part of the report."""
        changes = self.changes
        return {
            "count": len(self._urls),
            "kills": len(changes),
            "longest_change_s": round(max((change.seconds for change in changes), default=0.0), 2),
            "changes": [
                {
                    "seconds": round(change.seconds, 2),
                    "term": change.term,
                    "driven_m": round(change.driven, 3),
                }
                for change in changes
            ],
        }

    async def _run(self) -> None:
        async with aiohttp.ClientSession(timeout=_TIMEOUT) as session:
            while not self.fault and not await self._is_ending(self._rng.uniform(*CALM_S)):
                if not await self._see_robots_drive():
                    return
                try:
                    leader = await kill_leader(self._urls)
                except DemoError:
                    continue
                self._say(f"killed the leading master {leader.url}, term {leader.term}")
                await self._wait_for_next(session, leader)

    async def _wait_for_next(self, session: aiohttp.ClientSession, killed: LeaderView) -> None:
        began, before = time.monotonic(), self._places()
        while True:
            leader = await find_leader(session, self._urls)
            waited = time.monotonic() - began
            if leader is not None and leader.term > killed.term and leader.task_sets >= TASK_SETS:
                break
            if waited > CHANGE_TIMEOUT_S:
                self.fault = (
                    f"no master led {CHANGE_TIMEOUT_S:g} s after the one of term {killed.term} was killed"
                )
                return
            await asyncio.sleep(_POLL_S)
        after = self._places()
        driven = sum(after[robot] - before.get(robot, 0.0) for robot in after)
        self.changes.append(Change(waited, leader.term, driven))
        self._say(
            f"{leader.url} leads in term {leader.term} after {waited:.1f} s; the robots drove"
            f" {driven:.2f} m meanwhile"
        )

    async def _see_robots_drive(self) -> bool:
        """Wait until a robot drives, as a kill while all stand shows nothing; False: the run ends before."""
        before = sum(self._places().values())
        while sum(self._places().values()) <= before:
            if await self._is_ending(_POLL_S):
                return False
        return True

    def _places(self) -> Mapping[str, float]:
        """Return how far each robot has driven until now, metres."""
        truth = self._truth()
        return {} if truth is None else {robot.id: robot.distance_m for robot in truth.robots}

    async def _is_ending(self, seconds: float) -> bool:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._ending.wait()
        return self._ending.is_set()


async def _ask(session: aiohttp.ClientSession, url: str) -> LeaderView | None:
    with contextlib.suppress(aiohttp.ClientError, TimeoutError, OSError, KeyError, ValueError):
        async with session.get(f"{url}healthz") as reply:
            told = await reply.json()
        if told["role"] == "leader" and told["ready"]:
            return LeaderView(url, int(told["term"]), int(told["task_sets"]))
    return None
