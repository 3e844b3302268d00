"""Emergency stops and initial poses: what reaches robots without the planner."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractAsyncContextManager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from rce.aio.tasks import cancel_and_wait
from rce_fleet.station.commands.desired_stops import DesiredStops, StopOrder
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
"""Pause before a robot is tried again that offers none, and that needs none now."""
LOOK_EVERY_S = 10.0
"""How often robots are looked for that the planner does not know."""
OPEN_S = 5.0
"""How long a stop waits for a connection that is being made; the robot gets it when it is made."""
AT_ONCE = 10
"""Connections that are prepared at the same time."""


@dataclass(frozen=True, slots=True)
class StopResult:
    """Which robots an emergency stop, or its release, has reached.

    Attributes:
        reached: Robots that are connected.
        missed: Why others were not reached; they get it as soon as they are.
        unkept: Why a restart of the station would forget it; empty: it would not.
    """

    reached: tuple[str, ...] = ()
    missed: dict[str, str] = field(default_factory=dict)
    unkept: str = ""

    @property
    def text(self) -> str:
        """What an operator should know."""
        said = f"{len(self.reached)} robots reached"
        if len(self.reached) == 1:
            said = f"{self.reached[0]} reached"
        if self.missed:
            said += f", {len(self.missed)} not reached"
        missed = [f"not {robot}: {why}" for robot, why in sorted(self.missed.items())[:20]]
        unkept = [f"a restart of the station forgets this: {self.unkept}"] if self.unkept else []
        return "; ".join([said, *missed, *unkept])


class RobotControl:
    """Sends robots what must reach them without the planner.

    Args:
        source: Gives senders for robots' topics.
        robots: Returns the robots that the planner knows, or knew last.
        on_change: Called after :attr:`stopped`, :attr:`undelivered`, :attr:`fleet_stopped_by` or
            :attr:`driven` changed.
        stops: Which robots shall be stopped; kept in memory only if None.

    Attributes:
        driven: Who drives each robot that is driven by hand.
    """

    def __init__(
        self,
        source: CommandSource,
        robots: Callable[[], Iterable[str]],
        on_change: Callable[[], None] = lambda: None,
        stops: DesiredStops | None = None,
    ) -> None:
        self._source = source
        self._robots = robots
        self._on_change = on_change
        self._desired = stops or DesiredStops()
        self._stops: dict[str, CommandSender] = {}
        self._opening: dict[str, asyncio.Task[CommandSender]] = {}
        self._offering: set[str] = set()
        """Robots that offered the topic when the source was asked last."""
        self._refused_at: dict[str, float] = {}
        self._delivered: dict[str, StopOrder] = {}
        """The newest order that each robot has got."""
        self._told: tuple[dict[str, str], list[str], str | None] | None = None
        self.driven: dict[str, str] = {}

    @property
    def stopped(self) -> dict[str, str]:
        """Who stopped each robot that is stopped."""
        orders = {robot: self._desired.order_for(robot) for robot in sorted(self._known())}
        return {robot: order.user for robot, order in orders.items() if order is not None and order.stopped}

    @property
    def undelivered(self) -> list[str]:
        """Robots that shall stand and have not got this yet: they may be driving."""
        return [robot for robot in self.stopped if not self._has_newest_order(robot)]

    @property
    def fleet_stopped_by(self) -> str | None:
        """Who stopped all robots, also those that appear later; None: they are not stopped as a whole."""
        return self._desired.fleet_stopped_by

    async def run(self) -> None:
        """Keep the connections of emergency stops until cancelled, so that a stop needs no preparation.

        A robot that appears, or comes back, gets the stop that was ordered for it.
        """
        self._tell()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._look_for_robots())
            group.create_task(self._prepare_stops())

    async def close(self) -> None:
        """Close all connections, side by side. Robots that are stopped stay stopped."""
        await cancel_and_wait(*self._opening.values())
        senders = [sender.close() for sender in self._stops.values()]
        self._stops.clear()
        for error in await asyncio.gather(*senders, return_exceptions=True):
            if error is not None:
                _log.warning("a connection for emergency stops was not closed: %s", error)

    async def emergency_stop(self, robots: Iterable[str] | None, user: str, *, stopped: bool) -> StopResult:
        """Stop robots at once, or release them.

        It is kept, in the file if there is one, and robots that are not reached now get it later.

        Args:
            robots: Their IDs; None for all, also those that appear later.
            user: Who asks.
            stopped: False: release them.
        """
        order = StopOrder(stopped=stopped, user=user, time=time.time())
        missed: dict[str, str] = {}
        reached: list[str] = []

        async def reach(robot: str) -> None:
            try:
                why = await self._reach(robot)
            except Exception as error:  # noqa: BLE001 - the others must be stopped all the same
                _log.exception("the emergency stop of %s failed", robot)
                why = str(error) or type(error).__name__
            if why:
                missed[robot] = why
            else:
                reached.append(robot)

        wanted = self._known() if robots is None else set(robots)
        if robots is None:
            self._desired.order_fleet(wanted, order)
        else:
            for robot in wanted:
                self._desired.order_robot(robot, order)
        async with asyncio.TaskGroup() as group:
            for robot in sorted(wanted):
                group.create_task(reach(robot))
            group.create_task(self._save())
            await asyncio.sleep(0)  # robots that are connected have their order then
            self._tell()
            if robots is None:
                await self._look()
                for robot in sorted(self._known() - wanted):
                    if not stopped:
                        self._desired.release_new(robot, order)
                    group.create_task(reach(robot))
        self._tell()
        return StopResult(tuple(sorted(reached)), missed, await self._save())

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

    def listen(
        self, robot: str, answer: RobotCommand, take: Callable[[float], None]
    ) -> AbstractAsyncContextManager[None]:
        """Receive a robot's answers; see :meth:`CommandSource.listen`."""
        return self._source.listen(robot, answer, take)

    async def open_unconnected(self, robot: str, command: RobotCommand) -> CommandSender:
        """Return a sender for a topic of a robot, which may not be connected yet; close it at the end.

        Raises:
            CommandError: The robot does not offer the topic, or cannot be reached.
        """
        return await self._source.open(robot, command)

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

    # Emergency stops

    def _known(self) -> set[str]:
        return {*self._robots(), *self._offering, *self._stops, *self._desired.robots}

    def _tell(self) -> None:
        """Call ``on_change`` if something changed since it was called last."""
        now = self.stopped, self.undelivered, self.fleet_stopped_by
        if now != self._told:
            self._told = now
            self._on_change()

    async def _look_for_robots(self) -> None:
        while True:
            await self._look()
            self._tell()
            await asyncio.sleep(LOOK_EVERY_S)

    async def _look(self) -> None:
        """Ask which robots offer the topic. If the answer fails, those of before are kept."""
        with suppress(CommandError, TimeoutError):
            async with asyncio.timeout(OPEN_S):
                before, self._offering = self._offering, await self._source.robots()
                for robot in self._offering - before:
                    self._refused_at.pop(robot, None)

    async def _prepare_stops(self) -> None:
        slots = asyncio.Semaphore(AT_ONCE)

        async def prepare(robot: str) -> None:
            async with slots:
                try:
                    is_new = robot not in self._stops
                    sender = await self._stop_sender(robot)
                    if not is_new:
                        async with asyncio.timeout(OPEN_S):
                            await sender.repair()
                except (CommandError, TimeoutError) as error:
                    self._refused_at[robot] = asyncio.get_running_loop().time()
                    _log.debug("no emergency stop for %s: %s", robot, error)
                except Exception as error:  # noqa: BLE001 - the others must be stopped all the same
                    _log.warning("the connection for emergency stops of %s failed: %r", robot, error)
                else:
                    if sender.is_connected:
                        self._send_again(robot, sender)

        while True:
            now = asyncio.get_running_loop().time()
            await asyncio.gather(*map(prepare, filter(partial(self._needs_work, now), self._known())))
            self._tell()
            await self._save()
            await asyncio.sleep(PREPARE_EVERY_S)

    def _needs_work(self, now: float, robot: str) -> bool:
        """Return whether a robot's connection must be made or repaired, or it has not got its order yet."""
        sender = self._stops.get(robot)
        if sender is not None:
            has_order = self._has_newest_order(robot) and not self._desired.is_done_when_told(robot)
            return not sender.is_connected or not has_order
        is_urgent = self._desired.order_for(robot) is not None
        return is_urgent or now - self._refused_at.get(robot, float("-inf")) >= TRY_AGAIN_S

    async def _reach(self, robot: str) -> str:
        """Send a robot its order; return why it does not get it now."""
        try:
            sender = await self._stop_sender(robot)
        except CommandError as error:
            return f"{error}; it gets this when it is there"
        sent = self._send(robot, sender)
        if not await sender.wait_connected():
            return "it is not connected; it gets this when it is"
        self._note_delivered(robot, sent)
        return ""

    def _send_again(self, robot: str, sender: CommandSender) -> None:
        try:
            self._note_delivered(robot, self._send(robot, sender))
        except Exception as error:  # noqa: BLE001 - the others must be stopped all the same
            _log.warning("the emergency stop of %s failed: %s", robot, error)

    def _has_newest_order(self, robot: str) -> bool:
        order = self._desired.order_for(robot)
        return order is None or order is self._delivered.get(robot)

    def _note_delivered(self, robot: str, order: StopOrder | None) -> None:
        if order is not None:
            self._delivered[robot] = order
            self._desired.was_told(robot, order)

    def _send(self, robot: str, sender: CommandSender) -> StopOrder | None:
        """Send and return the newest order: another one may have come while the connection was made."""
        order = self._desired.order_for(robot)
        if order is not None:
            sender.send(stop_message(stopped=order.stopped))
        return order

    async def _stop_sender(self, robot: str) -> CommandSender:
        """Return the sender for a robot's stops; one that takes long is made further, and sends what it must.

        Raises:
            CommandError: There is none now.
        """
        if robot in self._stops:
            return self._stops[robot]
        task = self._opening.get(robot)
        if task is None:
            task = self._opening[robot] = asyncio.create_task(self._open_stop(robot))
            task.add_done_callback(lambda done: self._opened(robot, done))
        await asyncio.wait([task], timeout=OPEN_S)
        if not task.done():
            raise CommandError("the engine or its ROS graph does not answer now")
        return task.result()

    async def _open_stop(self, robot: str) -> CommandSender:
        sender = self._stops[robot] = await self._source.open(robot, EMERGENCY_STOP)
        self._send(robot, sender)
        return sender

    def _opened(self, robot: str, task: asyncio.Task[CommandSender]) -> None:
        self._opening.pop(robot, None)
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.debug("no emergency stop for %s: %s", robot, error)

    async def _save(self) -> str:
        """Keep the orders; return why they are not kept."""
        if self._desired.is_saved:
            return ""
        try:
            await asyncio.to_thread(self._desired.save)
        except (OSError, ValueError) as error:
            _log.error("emergency stops are not kept for a restart of the station: %s", error)
            return str(error)
        return ""
