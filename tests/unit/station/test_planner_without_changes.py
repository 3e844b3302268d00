"""What the link asks of planners of earlier releases: no changes, no common topic of poses.

The client lives in the test.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

import pytest

from rce.aio.backoff import Backoff
from rce_fleet.station import fleet_link
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.planner_client import (
    GET_STATE,
    PlannerClient,
    PlannerListener,
    PlannerUnavailableError,
)
from rce_fleet.station.view import FleetView, Pose

GRID = {
    "rows": 2,
    "columns": 2,
    "cell_size": 1.0,
    "origin_x": 0.0,
    "origin_y": 0.0,
    "walls": [],
    "pending": [],
}


def state(*blocked: int, started: str = "1.0") -> dict[str, Any]:
    return {**GRID, "started": started, "blocked": list(blocked), "robots": []}


def with_robots(*names: str, started: str = "1.0") -> dict[str, Any]:
    return {**state(started=started), "robots": [{"id": name} for name in names]}


def repeated(sequence: int) -> dict[str, Any]:
    parts: dict[str, Any] = {"robots": [], "removed": [], "blocked": [], "pending": [], "freed": []}
    return {**parts, "started": "1.0", "sequence": sequence}


class Planner(PlannerClient):
    """A planner that answers when it is told to."""

    def __init__(self) -> None:
        super().__init__("away")
        self.asked: list[float] = []
        self.followed: list[str] = []
        self.answer: dict[str, Any] | None = None
        self._calls[GET_STATE] = self._get_state

    async def run(self, listener: PlannerListener, ready: Callable[[], Awaitable[None]]) -> None:
        await ready()
        listener.may_have_missed()
        await asyncio.Event().wait()

    async def _get_state(self, request: dict[str, Any]) -> dict[str, Any]:
        self.asked.append(asyncio.get_running_loop().time())
        if self.answer is None:
            raise PlannerUnavailableError("no such service")
        return self.answer

    def follow(self, robot: str) -> None:
        self.followed.append(robot)

    @property
    def receives_states(self) -> bool:
        return self._states_needed.is_set()


class Station:
    def __init__(self) -> None:
        self.planner = Planner()
        self.view = FleetView()
        self.events: list[str] = []
        self.away: list[bool] = []
        self.link = FleetLink(
            self.planner,
            self.view,
            on_change=lambda _: None,
            on_pose=lambda _: None,
            on_event=lambda text, _: self.events.append(text),
            on_planner=lambda since: self.away.append(since is not None),
        )


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(30):
        while not condition():
            await asyncio.sleep(0.005)


@asynccontextmanager
async def running(monkeypatch: pytest.MonkeyPatch, first: float, longest: float) -> AsyncIterator[Station]:
    monkeypatch.setattr(fleet_link, "ASK_AGAIN", Backoff(first=first, longest=longest))
    station = Station()

    async def ready() -> None: ...

    task = asyncio.create_task(station.link.run(ready))
    try:
        yield station
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_pauses_between_questions_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(monkeypatch, first=0.05, longest=60.0) as station:
        await until(lambda: len(station.planner.asked) == 5)
        asked = station.planner.asked
        pauses = [later - earlier for earlier, later in pairwise(asked)]
        assert all(pause >= least for pause, least in zip(pauses, (0.05, 0.1, 0.2, 0.4), strict=True))


async def test_whole_states_are_followed_and_it_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(monkeypatch, first=60.0, longest=60.0) as station:
        await until(lambda: station.planner.receives_states)
        for cell in (1, 2):
            station.link.take_state(state(cell))
            assert station.view.blocked() == [cell]
        assert len(station.planner.asked) == 1
        (event,) = station.events
        assert "publishes no changes" in event


async def test_a_change_is_a_reason_to_ask_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(monkeypatch, first=0.01, longest=60.0) as station:
        await until(lambda: len(station.planner.asked) == 3)
        station.planner.answer = {"sequence": 7, "state": state(3)}
        station.link.take_changes(repeated(7))
        await until(lambda: station.view.blocked() == [3])
        await until(lambda: not station.planner.receives_states)
        station.link.take_state(state(1))
        assert station.view.blocked() == [3], "changes are followed now"


async def test_a_planner_that_falls_silent_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_link, "SILENT_S", 0.2)
    async with running(monkeypatch, first=60.0, longest=60.0) as station:
        station.planner.answer = {"sequence": 7, "state": state(3)}
        await until(lambda: station.view.blocked() == [3])
        station.planner.answer = None
        await until(lambda: station.planner.receives_states)
        station.link.take_state(state(1, started="2.0"))
        assert station.view.blocked() == [1]


async def test_a_planner_that_does_not_answer_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until it sends something again."""
    monkeypatch.setattr(fleet_link, "SILENT_S", 0.2)
    async with running(monkeypatch, first=0.05, longest=0.05) as station:
        station.planner.answer = {"sequence": 7, "state": state(3)}
        await until(lambda: station.view.blocked() == [3])
        assert station.away == []
        station.planner.answer = None
        await until(lambda: station.away == [True])
        assert "does not answer" in station.events[-1]
        station.planner.answer = {"sequence": 7, "state": state(3)}
        await until(lambda: station.away == [True, False])


async def test_a_planner_that_was_never_heard_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_link, "SILENT_S", 0.2)
    async with running(monkeypatch, first=60.0, longest=60.0) as station:
        await until(lambda: station.away == [True])
        station.link.take_state(state(1))
        assert station.away == [True, False]


async def test_a_planner_that_is_quiet_but_answers_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_link, "SILENT_S", 0.1)
    async with running(monkeypatch, first=60.0, longest=60.0) as station:
        station.planner.answer = {"sequence": 7, "state": state(3)}
        await until(lambda: len(station.planner.asked) == 4)
        assert station.away == []


def poses(*names: str) -> dict[str, Any]:
    return {
        "robots": list(names),
        "x": [1.0] * len(names),
        "y": [2.0] * len(names),
        "yaw": [0.5] * len(names),
    }


async def test_poses_of_all_robots_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_link, "POSES_WAIT_S", 0.05)
    station = Station()
    station.link.take_state(with_robots("Robot1"))
    station.link.take_poses(poses("Robot1", "Stranger"))
    assert station.view.poses == {"Robot1": Pose(1.0, 2.0, 0.5)}
    await asyncio.sleep(0.06)
    station.link.take_state(with_robots("Robot1", "Robot2"))
    assert station.planner.followed == []


async def test_robots_are_followed_one_by_one_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planner that is started again has as much time as the first one."""
    monkeypatch.setattr(fleet_link, "POSES_WAIT_S", 0.05)
    station = Station()
    station.link.take_state(with_robots("Robot1"))
    station.link.take_poses(poses("Robot1"))
    await asyncio.sleep(0.06)
    station.link.take_state(with_robots("Robot1", started="2.0"))
    assert station.planner.followed == []
    await asyncio.sleep(0.06)
    station.link.take_state(with_robots("Robot1", "Robot2", started="2.0"))
    assert station.planner.followed == ["Robot1", "Robot2"]
