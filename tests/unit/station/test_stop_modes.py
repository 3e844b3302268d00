"""What the planner knows of emergency stops: the mode stopped, and after the release that of before."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, cast

import pytest

from rce.ros.types import Time
from rce_fleet.coordination.events import ModeSet, PoseSeen, Reply
from rce_fleet.coordination.modes import read_mode
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.nodes.state_publisher import state_fields
from rce_fleet.planning.grid import GridMap
from rce_fleet.station.commands import stop_modes as module
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.owed_modes import OwedModes
from rce_fleet.station.commands.stop_modes import StopModes
from rce_fleet.station.planner_client import PlannerError, PlannerUnavailableError
from rce_fleet.station.view import FleetView

from .test_emergency_stops import Robots

NAMES = ("Robot1", "Robot2", "Robot3")


class Planner:
    """A real planner whose service is called without sockets; it shows each change at once."""

    knows_modes = True

    def __init__(self, view: FleetView) -> None:
        self._view = view
        self.now = 0.0
        self.calls: list[tuple[str, str]] = []
        self.events: list[str] = []
        self.restart()

    def restart(self) -> None:
        """Begin anew, with all robots in their mode of the start."""
        self._planner = FleetPlanner(GridMap())
        self.is_away = False
        for number, name in enumerate(NAMES):
            self._planner.handle(PoseSeen(name, 0.5 + 2 * number, 0.5, 0.0), self.now)
        self._show()

    def _show(self) -> None:
        self._view.on_state(state_fields(Time(1, 0), self._planner))

    async def set_mode(self, robot: str, mode: str, *, reason: str, user: str) -> str:
        if self.is_away:
            raise PlannerUnavailableError("the planner does not answer")
        self.now += 1.0
        event = ModeSet(robot or None, read_mode(mode), reason, user)
        *_, reply = self._planner.handle(event, self.now)
        assert isinstance(reply, Reply)
        if not reply.ok:
            raise PlannerError(reply.message)
        self.calls.append((robot, mode))
        self._show()
        return reply.message

    def take_event(self, text: str, tone: str) -> None:
        self.events.append(f"{tone}: {text}")


class Site:
    """A station's control of three robots, and what keeps the planner's modes."""

    def __init__(self, file: Path | None = None) -> None:
        self.view = FleetView()
        self.planner = Planner(self.view)
        self.control = RobotControl(Robots(*NAMES), self.view.robot_ids, self._wake)
        self.owed = OwedModes(file)
        self.modes = StopModes(cast("Any", self.planner), self.view, self.control, self.owed)
        self.task: asyncio.Task[None] | None = None

    def _wake(self) -> None:
        self.modes.wake()

    def start(self) -> None:
        self.task = asyncio.create_task(self.modes.run())

    async def end(self) -> None:
        if self.task is not None:
            self.task.cancel()
            await asyncio.gather(self.task, return_exceptions=True)
        await self.control.close()

    async def stop(self, *robots: str, stopped: bool = True) -> None:
        await self.control.emergency_stop(robots or None, "anna", stopped=stopped)

    def shown(self) -> list[str]:
        return [self.view.mode_of(name) for name in NAMES]

    async def until(self, holds: Callable[[], bool]) -> None:
        async with asyncio.timeout(60):
            while not holds():
                await asyncio.sleep(0.01)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOOK_EVERY_S", 0.02)
    monkeypatch.setattr(module, "SHOWN_WAIT_S", 0.1)


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    made = Site()
    made.start()
    yield made
    await made.end()


async def test_a_stop_of_all_is_one_mode_of_the_fleet(site: Site) -> None:
    await site.stop()
    await site.until(lambda: site.view.mode == "stopped")
    assert site.shown() == ["stopped"] * 3
    await site.stop(stopped=False)
    await site.until(lambda: site.view.mode == "automatic")
    assert site.planner.calls == [("", "stopped"), ("", "automatic")]
    await site.until(lambda: not site.owed.robots)


async def test_a_robot_has_its_mode_of_before_again(site: Site) -> None:
    await site.planner.set_mode("Robot2", "paused", reason="tea", user="anna")
    await site.stop("Robot1", "Robot2")
    await site.until(lambda: site.shown() == ["stopped", "stopped", "automatic"])
    await site.stop("Robot1", "Robot2", stopped=False)
    await site.until(lambda: site.shown() == ["automatic", "paused", "automatic"])


async def test_single_robots_are_released_before_the_others(site: Site) -> None:
    """The others never drive meanwhile, and one that a person had paused stays so."""
    await site.planner.set_mode("Robot3", "paused", reason="tea", user="anna")
    await site.stop()
    await site.until(lambda: site.view.mode == "stopped")
    await site.stop("Robot1", stopped=False)
    await site.until(lambda: site.shown() == ["automatic", "stopped", "stopped"])
    released = site.planner.calls.index(("", "automatic"))
    assert {("Robot2", "stopped"), ("Robot3", "stopped")} <= set(site.planner.calls[:released])
    await site.stop(stopped=False)
    await site.until(lambda: site.shown() == ["automatic", "automatic", "paused"])
    await site.until(lambda: not site.owed.robots)


async def test_a_robot_that_is_set_free_too_early_is_stopped_again(site: Site) -> None:
    """Its wheels are still held by the stop."""
    await site.stop("Robot1")
    await site.until(lambda: site.shown()[0] == "stopped")
    await site.planner.set_mode("Robot1", "automatic", reason="", user="ben")
    await site.until(lambda: site.shown()[0] == "stopped")


async def test_a_mode_that_a_person_set_meanwhile_stays(site: Site) -> None:
    await site.stop("Robot1")
    await site.until(lambda: site.shown()[0] == "stopped")
    await site.planner.set_mode("Robot1", "out_of_service", reason="broken", user="ben")
    await site.stop("Robot1", stopped=False)
    await site.until(lambda: not site.owed.robots)
    assert site.shown()[0] == "out_of_service"


async def test_a_robot_that_was_paused_meanwhile_stays_so(site: Site) -> None:
    await site.stop("Robot1")
    await site.until(lambda: site.shown()[0] == "stopped")
    await site.planner.set_mode("Robot1", "paused", reason="tea", user="ben")
    await site.until(lambda: site.shown()[0] == "stopped")
    await site.stop("Robot1", stopped=False)
    await site.until(lambda: not site.owed.robots)
    assert site.shown()[0] == "paused"


async def test_a_fleet_that_was_paused_meanwhile_stays_so(site: Site) -> None:
    await site.stop()
    await site.until(lambda: site.view.mode == "stopped")
    await site.planner.set_mode("", "paused", reason="tea", user="ben")
    await site.until(lambda: site.view.mode == "stopped")
    await site.stop(stopped=False)
    await site.until(lambda: not site.owed.robots)
    assert site.view.mode == "paused"


async def test_a_stop_that_a_new_planner_hears_later_is_released(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It begins with automatic, and gets the modes of before from the manager some seconds later."""
    monkeypatch.setattr(module, "SHOWN_WAIT_S", 60.0)
    await site.stop()
    await site.until(lambda: site.view.mode == "stopped")
    site.planner.is_away = True
    await site.stop(stopped=False)
    site.modes._set_at.clear()  # long ago
    site.planner.restart()
    await asyncio.sleep(0.2)  # some looks
    await site.planner.set_mode("", "stopped", reason="", user="manager")
    await site.until(lambda: not site.owed.robots)
    assert site.view.mode == "automatic"


async def test_a_stop_of_a_person_after_the_release_stays(site: Site) -> None:
    await site.stop()
    await site.until(lambda: site.view.mode == "stopped")
    await site.stop(stopped=False)
    await site.until(lambda: not site.owed.robots)
    await site.planner.set_mode("", "stopped", reason="", user="ben")
    await asyncio.sleep(0.2)
    assert site.view.mode == "stopped"


async def test_a_stop_of_another_program_is_not_released(site: Site) -> None:
    await site.planner.set_mode("", "stopped", reason="", user="program")
    await site.stop()
    await asyncio.sleep(0.1)
    await site.stop(stopped=False)
    await asyncio.sleep(0.1)
    assert site.view.mode == "stopped"


async def test_the_planner_gets_to_know_of_it_when_it_is_back(site: Site) -> None:
    site.planner.is_away = True
    await site.stop()
    await asyncio.sleep(0.1)
    assert site.view.mode == "automatic"
    site.planner.is_away = False
    await site.until(lambda: site.view.mode == "stopped")


async def test_a_station_that_restarts_gives_modes_back(tmp_path: Path) -> None:
    """Of robots whose release was ordered, and whose planner was away until then."""
    file = tmp_path / "stop-modes.json"
    first = Site(file)
    first.start()
    await first.planner.set_mode("Robot1", "paused", reason="tea", user="anna")
    await first.stop("Robot1")
    await first.until(lambda: first.shown()[0] == "stopped")
    await first.end()
    second = Site(file)
    await second.planner.set_mode("Robot1", "stopped", reason="", user="anna")
    second.owed.load()
    second.start()
    await second.until(lambda: second.shown()[0] == "paused")
    await second.end()
