"""Velocities of an operator, and the round trip to the robot that they measure."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from rce_fleet.station.commands import velocity_sender as velocity_sender_module
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.kinds import DRIVE_CLOCK, DRIVE_ECHO, VELOCITY, RobotCommand
from rce_fleet.station.commands.sources import CommandError, CommandSender, CommandSource, Take
from rce_fleet.station.commands.velocity_sender import velocity_sender


class Sender(CommandSender):
    """Sends on one topic of the robot."""

    is_connected = True

    def __init__(self, robot: Robot, topic: str) -> None:
        self._robot = robot
        self._topic = topic

    def send(self, message: dict[str, Any]) -> None:
        self._robot.got.append((self._topic, message))

    async def repair(self) -> None:
        raise NotImplementedError

    async def close(self) -> None:
        self._robot.used.remove(self._topic)


class Robot(CommandSource):
    """A robot that offers some topics.

    Attributes:
        offered: The topics; others can be added.
        got: Topic and content of each message.
        asked: How often the station asked for a topic.
        used: The topics that the station uses.
        takes: What takes the robot's answers.
    """

    def __init__(self, *offered: RobotCommand) -> None:
        self.offered = offered
        self.asked = 0
        self.got: list[tuple[str, dict[str, Any]]] = []
        self.used: list[str] = []
        self.takes: list[Take] = []

    async def open(self, robot: str, command: RobotCommand) -> CommandSender:
        self._use(command)
        return Sender(self, command.topic)

    @asynccontextmanager
    async def listen(self, robot: str, answer: RobotCommand, take: Take) -> AsyncIterator[None]:
        self._use(answer)
        self.takes.append(take)
        try:
            yield
        finally:
            self.used.remove(answer.topic)

    def _use(self, command: RobotCommand) -> None:
        self.asked += 1
        if command not in self.offered:
            raise CommandError(f"no {command.topic}")
        self.used.append(command.topic)


async def test_a_robot_answers_the_time_of_each_velocity() -> None:
    robot = Robot(VELOCITY, DRIVE_CLOCK, DRIVE_ECHO)
    now = asyncio.get_running_loop().time
    async with velocity_sender(RobotControl(robot, list), "Robot1") as sender:
        sender.send(0.2, 0.1)
        assert [topic for topic, _ in robot.got] == ["drive_clock", "raw_cmd_vel"]
        assert sender.round_trip.seconds(now()) is None
        robot.takes[0](robot.got[0][1]["data"])
        assert sender.round_trip.seconds(now()) is not None
    assert robot.got[-1][1]["linear"]["x"] == 0.0
    assert robot.used == []


@pytest.mark.parametrize("offered", [(VELOCITY,), (VELOCITY, DRIVE_ECHO)])
async def test_a_robot_that_answers_nothing_is_driven(offered: tuple[RobotCommand, ...]) -> None:
    """As one with a config of before, whose round trip is not known."""
    robot = Robot(*offered)
    async with velocity_sender(RobotControl(robot, list), "Robot1") as sender:
        sender.send(0.2, 0.1)
        assert [topic for topic, _ in robot.got] == ["raw_cmd_vel"]
        assert sender.round_trip.seconds(0.0) is None
    assert robot.used == []


async def test_a_topic_that_is_offered_later_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one whose interfaces the engine makes one after the other."""
    monkeypatch.setattr(velocity_sender_module, "TRY_AGAIN_S", 0.01)
    robot = Robot(VELOCITY)
    async with velocity_sender(RobotControl(robot, list), "Robot1") as sender:
        async with asyncio.timeout(60):
            for more in (DRIVE_ECHO, DRIVE_CLOCK):
                before = robot.asked
                while robot.asked < before + 4:
                    await asyncio.sleep(0.01)
                assert sender.clock is None
                robot.offered += (more,)
            while sender.clock is None:
                await asyncio.sleep(0.01)
        sender.send(0.2, 0.1)
        assert [topic for topic, _ in robot.got] == ["drive_clock", "raw_cmd_vel"]
        robot.takes[-1](robot.got[0][1]["data"])
        assert sender.round_trip.seconds(asyncio.get_running_loop().time()) is not None
    assert robot.used == []
