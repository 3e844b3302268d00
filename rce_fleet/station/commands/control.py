"""Emergency stops and initial poses: what reaches robots without the planner."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce_fleet.station.commands.kinds import (
    EMERGENCY_STOP,
    INITIAL_POSE,
    pose_message,
    stop_message,
)
from rce_fleet.station.commands.sources import CommandError

if TYPE_CHECKING:
    from rce_fleet.station.commands.kinds import RobotCommand
    from rce_fleet.station.commands.sources import CommandSender, CommandSource

_log = logging.getLogger(__name__)

PREPARE_EVERY_S = 2.0
"""How often robots are looked for that have no connection for emergency stops yet."""
TRY_AGAIN_S = 30.0
"""Pause before a robot is tried again that offers none."""
AT_ONCE = 10
"""Connections that are prepared at the same time."""


@dataclass(frozen=True, slots=True)
class StopResult:
    """Which robots an emergency stop, or its release, has reached.

    Attributes:
        reached: Robots that are connected.
        missed: Why others were not reached; those that are offline get it as soon as they connect again.
    """

    reached: tuple[str, ...] = ()
    missed: dict[str, str] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """What an operator should know."""
        said = f"{len(self.reached)} robots reached"
        if len(self.reached) == 1:
            said = f"{self.reached[0]} reached"
        return "; ".join([said, *(f"not {robot}: {why}" for robot, why in sorted(self.missed.items())[:20])])


class RobotControl:
    """Sends robots what must reach them without the planner.

    Args:
        source: Gives senders for robots' topics.
        robots: Returns the robots that the planner knows, or knew last.
        on_change: Called after :attr:`stopped` changed.

    Attributes:
        stopped: Who stopped each robot that is stopped.
        driven: Who drives each robot that is driven by hand.
    """

    def __init__(
        self,
        source: CommandSource,
        robots: Callable[[], Iterable[str]],
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self._source = source
        self._robots = robots
        self._on_change = on_change
        self._stops: dict[str, CommandSender] = {}
        self._opening: dict[str, asyncio.Lock] = {}
        self._refused_at: dict[str, float] = {}
        self.stopped: dict[str, str] = {}
        self.driven: dict[str, str] = {}

    async def run(self) -> None:
        """Keep the connections of emergency stops until cancelled, so that a stop needs no preparation."""
        slots = asyncio.Semaphore(AT_ONCE)

        async def prepare(robot: str) -> None:
            async with slots:
                try:
                    sender = await self._stop_sender(robot)
                    await sender.repair()
                except CommandError as error:
                    self._refused_at[robot] = asyncio.get_running_loop().time()
                    _log.debug("no emergency stop for %s: %s", robot, error)

        while True:
            now = asyncio.get_running_loop().time()
            missing = [
                robot
                for robot in self._robots()
                if robot not in self._stops
                and now - self._refused_at.get(robot, float("-inf")) >= TRY_AGAIN_S
            ]
            away = [robot for robot, sender in self._stops.items() if not sender.is_connected]
            await asyncio.gather(*map(prepare, [*missing, *away]))
            await asyncio.sleep(PREPARE_EVERY_S)

    async def close(self) -> None:
        """Close all connections. Robots that are stopped stay stopped."""
        for sender in self._stops.values():
            await sender.close()
        self._stops.clear()

    async def emergency_stop(self, robots: Iterable[str] | None, user: str, *, stopped: bool) -> StopResult:
        """Stop robots at once, or release them.

        Args:
            robots: Their IDs; None for all that are known.
            user: Who asks.
            stopped: False: release them.
        """
        wanted = sorted({*self._robots(), *self._stops} if robots is None else robots)
        missed: dict[str, str] = {}
        reached: list[str] = []

        async def reach(robot: str) -> None:
            try:
                sender = await self._stop_sender(robot)
            except CommandError as error:
                missed[robot] = str(error)
                return
            sender.send(stop_message(stopped=stopped))
            if stopped:
                self.stopped[robot] = user
            else:
                self.stopped.pop(robot, None)
            if await sender.wait_connected():
                reached.append(robot)
            else:
                missed[robot] = "it is not connected; it gets this when it is"

        await asyncio.gather(*map(reach, wanted))
        self._on_change()
        return StopResult(tuple(sorted(reached)), missed)

    async def set_pose(self, robot: str, x: float, y: float, yaw: float) -> None:
        """Tell a robot's localization where it is; metres and radians in the map frame.

        Raises:
            CommandError: The robot cannot be reached.
        """
        sender = await self.open(robot, INITIAL_POSE)
        try:
            sender.send(pose_message(x, y, yaw))
            await asyncio.sleep(0.2)  # until it has left the machine
        finally:
            await sender.close()

    async def open(self, robot: str, command: RobotCommand) -> CommandSender:
        """Return a connected sender for a topic of a robot; close it at the end.

        Raises:
            CommandError: The robot cannot be reached.
        """
        sender = await self._source.open(robot, command)
        if not await sender.wait_connected():
            await sender.close()
            raise CommandError(f"nothing of {robot} receives {command.topic}; is the robot connected?")
        return sender

    def begin_driving(self, robot: str, user: str) -> bool:
        """Note that a user drives a robot by hand; return False if another one does."""
        if robot in self.driven:
            return False
        self.driven[robot] = user
        self._on_change()
        return True

    def end_driving(self, robot: str) -> None:
        """Note that a robot is not driven by hand any more."""
        self.driven.pop(robot, None)
        self._on_change()

    async def _stop_sender(self, robot: str) -> CommandSender:
        async with self._opening.setdefault(robot, asyncio.Lock()):
            if robot not in self._stops:
                self._stops[robot] = await self._source.open(robot, EMERGENCY_STOP)
            return self._stops[robot]
