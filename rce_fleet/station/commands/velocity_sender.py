"""Sends velocities to a robot that is driven by hand, each with the time of the station's clock."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

from rce.aio.tasks import TaskScope
from rce_fleet.station.commands.driving import RobotRoundTrip
from rce_fleet.station.commands.kinds import (
    DRIVE_CLOCK,
    DRIVE_ECHO,
    VELOCITY,
    clock_message,
    velocity_message,
)
from rce_fleet.station.commands.sources import CommandError

if TYPE_CHECKING:
    from rce_fleet.station.commands.control import RobotControl
    from rce_fleet.station.commands.sources import CommandSender

_log = logging.getLogger(__name__)

TRY_AGAIN_S = 1.0
"""Pause before the topics of the round trip are looked for again."""


class VelocitySender:
    """Sends velocities to one robot, and measures the round trip if the robot answers.

    Args:
        sender: Of velocities.

    Attributes:
        clock: Sends the time with each velocity; None: the robot does not offer it now.
        round_trip: From the station to the robot.
    """

    def __init__(self, sender: CommandSender) -> None:
        self._sender = sender
        self.clock: CommandSender | None = None
        self.round_trip = RobotRoundTrip()

    @property
    def is_connected(self) -> bool:
        """Whether the robot gets velocities now."""
        return self._sender.is_connected

    def send(self, speed: float, turn_rate: float) -> None:
        """Send a velocity, metres and radians per second; the time goes first."""
        if self.clock is not None and self.clock.is_connected:
            now = asyncio.get_running_loop().time()
            self.clock.send(clock_message(now))
            self.round_trip.sent(now)
        self._sender.send(velocity_message(speed, turn_rate))

    def take_echo(self, sent: float) -> None:
        """Handle the robot's answer to a velocity that was sent at a time of the station's clock."""
        self.round_trip.answered(sent, asyncio.get_running_loop().time())


@asynccontextmanager
async def velocity_sender(control: RobotControl, robot: str) -> AsyncIterator[VelocitySender]:
    """Give what sends velocities to a robot; the robot stands at the end.

    If the robot does not offer yet what the round trip needs, it is tried again while the block runs.

    Args:
        control: Reaches the robot.
        robot: Its ID.

    Raises:
        CommandError: The robot cannot be reached.
    """
    async with AsyncExitStack() as stack:
        sender = await control.open(robot, VELOCITY)
        stack.push_async_callback(sender.close)
        velocities = VelocitySender(sender)
        try:
            stack.push_async_exit(await _measure(control, robot, velocities))
        except CommandError as error:
            _log.info("the round trip to %s is not measured yet: %s", robot, error)
            tasks = await stack.enter_async_context(TaskScope())
            tasks.spawn(_measure_later(control, robot, velocities), name=f"round trip to {robot}")
        try:
            yield velocities
        finally:
            velocities.send(0.0, 0.0)


async def _measure(control: RobotControl, robot: str, velocities: VelocitySender) -> AsyncExitStack:
    """Begin to measure the round trip; return what ends it.

    Raises:
        CommandError: The robot does not offer one of the topics, or cannot be reached.
    """
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(control.listen(robot, DRIVE_ECHO, velocities.take_echo))
        clock = await control.open_unconnected(robot, DRIVE_CLOCK)
        stack.push_async_callback(clock.close)
        velocities.clock = clock
        return stack.pop_all()


async def _measure_later(control: RobotControl, robot: str, velocities: VelocitySender) -> None:
    """Try to measure the round trip until it works, and go on until cancelled."""
    while True:
        await asyncio.sleep(TRY_AGAIN_S)
        try:
            measuring = await _measure(control, robot, velocities)
        except CommandError as error:
            _log.debug("the round trip to %s is not measured yet: %s", robot, error)
            continue
        async with measuring:
            _log.info("the round trip to %s is measured now", robot)
            await asyncio.Event().wait()
