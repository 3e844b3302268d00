"""Runs a simulated world in real time."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rce_fleet.drivers.robot_driver import RobotDriver
    from rce_fleet.simulation.world import World

PERIOD = 0.05
"""Seconds between two updates of the robots."""
MAX_LAG = 0.5
"""Maximum delay behind the clock that is caught up, seconds."""


async def run_world(
    world: World,
    drivers: Iterable[RobotDriver],
    *,
    after_update: Callable[[], None] | None = None,
    pace: float = 1.0,
) -> None:
    """Run a world in real time until cancelled.

    On a machine that is too slow the world runs slower; delays above MAX_LAG are not caught up.

    Args:
        world: The world.
        drivers: The robots in it.
        after_update: Called after each update.
        pace: Simulated seconds per second.
    """
    loop = asyncio.get_running_loop()
    robots = list(drivers)
    due = loop.time()
    while True:
        world.step(PERIOD)
        for robot in robots:
            robot.update()
        if after_update is not None:
            after_update()
        due = max(due + PERIOD / pace, loop.time() - MAX_LAG)
        await asyncio.sleep(max(0.0, due - loop.time()))
