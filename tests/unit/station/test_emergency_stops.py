"""Emergency stops of robots that are away, of robots that the planner does not know, and over restarts."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import pytest

from rce_fleet.station.commands import control as module
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.desired_stops import DesiredStops, stops_file
from rce_fleet.station.commands.kinds import EMERGENCY_STOP, INITIAL_POSE, RobotCommand
from rce_fleet.station.commands.sources import CommandError, CommandSender, CommandSource, Take


class Sender(CommandSender):
    """Sends to a robot that gets the last message when it connects."""

    def __init__(self) -> None:
        self.sent: list[bool] = []
        self.connected = True
        self.is_broken = False
        self.is_lost = False
        """Whether it can be neither repaired nor closed."""
        self.is_closed = False
        self.tries = 0

    def send(self, message: dict[str, Any]) -> None:
        self.tries += 1
        if self.is_broken:
            raise RuntimeError("broken")
        self.sent.append(message["data"])

    @property
    def is_connected(self) -> bool:
        return self.connected

    async def repair(self) -> None:
        if self.is_lost:
            raise RuntimeError("lost")

    async def close(self) -> None:
        if self.is_lost:
            raise RuntimeError("lost")
        self.is_closed = True


class Robots(CommandSource):
    """Robots that come and go; an engine that may not answer."""

    def __init__(self, *here: str) -> None:
        self.here = set(here)
        self.listed: set[str] = set()
        self.answers = asyncio.Event()
        self.answers.set()
        self.senders: dict[str, Sender] = {}

    async def open(self, robot: str, command: RobotCommand) -> CommandSender:
        assert command is EMERGENCY_STOP
        await self.answers.wait()
        if robot not in self.here:
            raise CommandError(f"no interface of {robot}")
        return self.senders.setdefault(robot, Sender())

    def listen(self, robot: str, answer: RobotCommand, take: Take) -> AbstractAsyncContextManager[None]:
        raise NotImplementedError

    async def robots(self) -> set[str]:
        return self.listed

    def last(self, robot: str) -> bool | None:
        sender = self.senders.get(robot)
        return sender.sent[-1] if sender is not None and sender.sent else None


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def running(control: RobotControl) -> AsyncIterator[None]:
    task = asyncio.create_task(control.run())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await control.close()


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PREPARE_EVERY_S", 0.02)
    monkeypatch.setattr(module, "LOOK_EVERY_S", 0.02)


@pytest.mark.parametrize("names", [None, ["Robot1"]])
async def test_a_robot_that_is_away_is_stopped_when_it_comes(names: list[str] | None) -> None:
    robots = Robots()
    control = RobotControl(robots, lambda: ["Robot1"])
    result = await control.emergency_stop(names, "op", stopped=True)
    assert (result.reached, "it gets this when it is there" in result.text) == ((), True)
    assert control.stopped == {"Robot1": "op"}
    robots.here.add("Robot1")
    async with running(control):
        await until(lambda: robots.last("Robot1") is True)


@pytest.mark.slow
async def test_a_stop_that_is_not_delivered_is_told_until_it_is() -> None:
    robots = Robots("Robot1", "Robot2")
    told: list[list[str]] = []
    control = RobotControl(
        robots, lambda: ["Robot1", "Robot2", "Robot3"], lambda: told.append(control.undelivered)
    )
    away = robots.senders["Robot2"] = Sender()
    away.connected = False
    result = await control.emergency_stop(None, "op", stopped=True)
    assert "Robot1 reached, 2 not reached" in result.text
    assert (told[-1], set(control.stopped)) == (["Robot2", "Robot3"], {"Robot1", "Robot2", "Robot3"})
    async with running(control):
        away.connected = True
        robots.here.add("Robot3")
        await until(lambda: told[-1] == [])
        assert (robots.last("Robot2"), robots.last("Robot3")) == (True, True)


async def test_robots_that_connect_at_once_are_not_told_as_missed() -> None:
    robots = Robots("Robot1")
    told: list[list[str]] = []
    control = RobotControl(robots, lambda: ["Robot1"], lambda: told.append(control.undelivered))
    await control.emergency_stop(None, "op", stopped=False)
    told.clear()
    await control.emergency_stop(None, "op", stopped=True)
    assert told == [[]]
    await control.close()


async def test_a_stop_that_cannot_be_sent_again_ends_nothing() -> None:
    robots = Robots("Robot1", "Robot2")
    control = RobotControl(robots, lambda: ["Robot1", "Robot2"])
    broken = robots.senders["Robot1"] = Sender()
    broken.is_broken = True
    await control.emergency_stop(None, "op", stopped=True)
    async with running(control):
        await until(lambda: broken.tries > 2)
        assert control.undelivered == ["Robot1"]
        broken.is_broken = False
        await until(lambda: control.undelivered == [])


@pytest.mark.slow
async def test_a_release_reaches_a_robot_that_comes_later() -> None:
    robots = Robots("Robot1")
    control = RobotControl(robots, lambda: ["Robot1"])
    await control.emergency_stop(None, "op", stopped=True)
    robots.senders["Robot1"].connected = False
    await control.emergency_stop(None, "op", stopped=False)
    assert control.stopped == {}
    robots.senders["Robot1"].connected = True
    async with running(control):
        await until(lambda: robots.last("Robot1") is False)


async def test_a_stop_of_all_counts_for_robots_that_appear_later() -> None:
    known: list[str] = []
    robots = Robots("Robot1", "Robot2")
    control = RobotControl(robots, lambda: known)
    result = await control.emergency_stop(None, "op", stopped=True)
    assert (result.reached, result.missed, control.fleet_stopped_by) == ((), {}, "op")
    known.append("Robot1")
    robots.listed = {"Robot2"}
    async with running(control):
        await until(lambda: (robots.last("Robot1"), robots.last("Robot2")) == (True, True))
        await control.emergency_stop(["Robot1"], "op", stopped=False)
        assert (robots.last("Robot1"), set(control.stopped)) == (False, {"Robot2"})
        known.clear()
        result = await control.emergency_stop(None, "op", stopped=False)
        assert (result.reached, control.fleet_stopped_by) == (("Robot1", "Robot2"), None)
        assert robots.last("Robot2") is False


async def test_robots_that_only_the_engine_knows_are_stopped() -> None:
    robots = Robots("Robot1")
    robots.listed = {"Robot1"}
    control = RobotControl(robots, list)
    result = await control.emergency_stop(None, "op", stopped=True)
    assert (result.reached, robots.last("Robot1")) == (("Robot1",), True)
    await control.close()


async def test_a_restarted_station_knows_and_sends_its_stops(tmp_path: Path) -> None:
    file = stops_file(tmp_path / "station", "here")
    robots = Robots("Robot1", "Robot2")
    before = RobotControl(robots, lambda: ["Robot1", "Robot2"], stops=DesiredStops(file))
    await before.emergency_stop(["Robot1"], "op", stopped=True)
    await before.emergency_stop(None, "other", stopped=True)
    await before.emergency_stop(["Robot2"], "op", stopped=False)
    await before.close()
    assert file.stat().st_mode & 0o77 == 0

    robots.senders.clear()
    stops = DesiredStops(file)
    stops.load()
    changes: list[dict[str, str]] = []
    control = RobotControl(robots, list, lambda: changes.append(control.stopped), stops)
    assert (control.stopped, control.fleet_stopped_by) == ({"Robot1": "other"}, "other")
    async with running(control):
        await until(lambda: robots.last("Robot1") is True and robots.last("Robot2") is False)
        assert changes[-1] == {"Robot1": "other"}
        await control.emergency_stop(None, "op", stopped=False)
    after = DesiredStops(file)
    after.load()
    assert (after.robots, after.fleet_stopped_by) == (set(), None)


async def test_a_file_that_cannot_be_written_delays_no_stop(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    robots = Robots("Robot1")
    control = RobotControl(robots, lambda: ["Robot1"], stops=DesiredStops(tmp_path / "file" / "stops"))
    result = await control.emergency_stop(None, "op", stopped=True)
    assert (result.reached, robots.last("Robot1")) == (("Robot1",), True)
    assert "a restart of the station forgets this" in result.text
    await control.close()


async def test_the_newest_order_counts_when_an_engine_answers_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "OPEN_S", 0.05)
    robots = Robots("Robot1", "Robot2")
    robots.answers.clear()
    control = RobotControl(robots, lambda: ["Robot1", "Robot2"])
    result = await control.emergency_stop(None, "op", stopped=True)
    assert set(result.missed) == {"Robot1", "Robot2"}
    await control.emergency_stop(["Robot2"], "op", stopped=False)
    robots.answers.set()
    await until(lambda: (robots.last("Robot1"), robots.last("Robot2")) == (True, False))
    await control.close()


async def test_a_robot_whose_stop_fails_keeps_no_other_from_its_stop() -> None:
    robots = Robots("Robot1", "Robot2")
    control = RobotControl(robots, lambda: ["Robot1", "Robot2"])
    broken = robots.senders["Robot1"] = Sender()
    broken.is_broken = True
    result = await control.emergency_stop(None, "op", stopped=True)
    assert (result.reached, result.missed, robots.last("Robot2")) == (("Robot2",), {"Robot1": "broken"}, True)
    await control.close()


def test_a_tag_names_its_robot() -> None:
    for robot in ("Robot1", "a_b", "emergency_stop"):
        assert EMERGENCY_STOP.robot_of(EMERGENCY_STOP.interface_tag(robot)) == robot
        assert EMERGENCY_STOP.robot_of(INITIAL_POSE.interface_tag(robot)) == ""
    assert EMERGENCY_STOP.robot_of("command__emergency_stop") == ""
    assert EMERGENCY_STOP.robot_of("command_emergency_stop") == ""


def test_fleets_do_not_share_their_stops(tmp_path: Path) -> None:
    assert stops_file(tmp_path, "a") != stops_file(tmp_path, "b")


async def test_a_lost_connection_leaves_the_others_alone() -> None:
    """They are still kept ready and told, and closed at the end."""
    robots = Robots("Robot1", "Robot2")
    control = RobotControl(robots, lambda: ["Robot1", "Robot2", "Robot3"])
    async with running(control):
        await until(lambda: set(robots.senders) == {"Robot1", "Robot2"})
        robots.senders["Robot1"].is_lost = True
        robots.senders["Robot1"].connected = False
        await control.emergency_stop(["Robot3"], "op", stopped=True)
        robots.here.add("Robot3")
        await until(lambda: robots.last("Robot3") is True)
    assert robots.senders["Robot2"].is_closed
    assert robots.senders["Robot3"].is_closed
