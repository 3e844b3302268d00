"""Robots that are put into the world while a demo runs: each joins the fleet until it is taken out."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from typing import TYPE_CHECKING

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.geometry.poses import Pose

if TYPE_CHECKING:
    from rce_fleet.drivers.report import RobotTruth, WorldReport

LOOK_EVERY_S = 0.5
_NAME = re.compile(r"Robot([1-9][0-9]{0,4})")
"""Names that wiring knows: container, topics and bridge are named after the number."""


class Newcomers:
    """Follows which robots are in the world.

    Args:
        first: Robots that the demo has from its start.
        truth: Returns the newest report of the world; None before the first.
        join: Makes a robot, by its number, that stands at a pose one of the fleet until the block is left.
        say: Prints a line for the user.
    """

    def __init__(
        self,
        first: frozenset[str],
        truth: Callable[[], WorldReport | None],
        join: Callable[[int, Pose], AbstractAsyncContextManager[None]],
        say: Callable[[str], None],
    ) -> None:
        self._first = first
        self._truth = truth
        self._join = join
        self._say = say
        self._known: dict[str, asyncio.Task[None]] = {}

    async def run(self) -> None:
        """Look again and again, until cancelled: all newcomers leave the fleet then."""
        async with asyncio.TaskGroup() as tasks:
            while True:
                if (seen := self._truth()) is not None:
                    self._look({each.id: each for each in seen.robots}, tasks)
                await asyncio.sleep(LOOK_EVERY_S)

    def _look(self, there: dict[str, RobotTruth], tasks: asyncio.TaskGroup) -> None:
        for robot in self._known.keys() - there.keys():
            self._known.pop(robot).cancel()
        for robot, truth in there.items():
            if robot not in self._first and robot not in self._known:
                self._known[robot] = tasks.create_task(self._keep(truth), name=f"newcomer {robot}")

    async def _keep(self, robot: RobotTruth) -> None:
        """Let a robot be of the fleet until cancelled."""
        named = _NAME.fullmatch(robot.id)
        if named is None:
            self._say(f"{robot.id} stays outside the fleet: only robots with names such as Robot7 join it")
            return
        try:
            async with self._join(int(named[1]), Pose(robot.x, robot.y, robot.yaw)):
                self._say(f"{robot.id} joins the fleet")
                await asyncio.get_running_loop().create_future()
        except (DemoError, OSError) as error:
            self._say(f"{robot.id} stays outside the fleet: {error}")
