"""Keeps a simulated world in step with the clock."""

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
"""A world that is farther behind the clock than this, in seconds, lets the time go."""


async def run_world(
    world: World,
    drivers: Iterable[RobotDriver],
    *,
    after_update: Callable[[], None] | None = None,
    pace: float = 1.0,
) -> None:
    """Run a world in real time until cancelled.

    A machine that is too slow makes the world slower, not jerky: lost time is not caught up.

    Args:
        world: The world.
        drivers: The robots in it.
        after_update: Called after each update, for those who look at the world.
        pace: Simulated seconds in one second.
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
