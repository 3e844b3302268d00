"""Sends velocities to a robot that is driven by hand, each with the time of the station's clock."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

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


class VelocitySender:
    """Sends velocities to one robot, and measures the round trip if the robot answers.

    Args:
        sender: Of velocities.

    Attributes:
        clock: Sends the time with each velocity; None: the robot does not offer it.
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
            await stack.enter_async_context(control.listen(robot, DRIVE_ECHO, velocities.take_echo))
            velocities.clock = await control.open_unconnected(robot, DRIVE_CLOCK)
            stack.push_async_callback(velocities.clock.close)
        except CommandError as error:
            _log.info("the round trip to %s is not measured: %s", robot, error)
        try:
            yield velocities
        finally:
            velocities.send(0.0, 0.0)
