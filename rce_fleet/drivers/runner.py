"""Advances a world: in real time, at another speed, step by step, or not at all."""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING

from rce.ros.node.clock import CLOCK, TOPIC
from rce.ros.types import Time

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rce.ros.node import Node, Publisher
    from rce_fleet.drivers.robot_driver import RobotDriver
    from rce_fleet.simulation.world import World

MAX_LAG = 0.2
"""Maximum delay behind the clock that is caught up, seconds."""
SPEED_WINDOW = 5.0
"""Seconds over which the reached speed is measured."""
TOO_SLOW = 0.9
"""A world that reaches less than this share of the wanted speed is reported."""
_STAMP = struct.Struct("<II")
_NANOSECONDS = 1_000_000_000


class WorldRunner:
    """Advances a world and the robots in it.

    On a machine that is too slow the world runs slower; delays above MAX_LAG are not caught up.

    Args:
        world: The world.
        factor: Simulated seconds per second; 0: as many as the machine can.
        simulated_clock: Whether stamps are simulated time, which is published on ``/clock``; else they are
            the machine's time.

    Attributes:
        drivers: The robots in the world by id; they may be changed at any time.
        on_update: Functions that are called after each step.
        on_reset: Functions that are called when the world begins anew.
        on_slow: Called with the reached speed when it is below the wanted one.
    """

    def __init__(self, world: World, *, factor: float = 1.0, simulated_clock: bool = False) -> None:
        self.world = world
        self.factor = factor
        self.simulated_clock = simulated_clock
        self.drivers: dict[str, RobotDriver] = {}
        self.on_update: list[Callable[[], None]] = []
        self.on_reset: list[Callable[[], None]] = []
        self.on_slow: Callable[[float], None] | None = None
        self._clocks: dict[str, Publisher] = {}
        self._before = 0.0
        self._running = asyncio.Event()
        self._running.set()

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return not self._running.is_set()

    @property
    def time(self) -> float:
        """Simulated time, seconds; it goes on when the world is reset."""
        return self._before + self.world.time

    def stamp(self) -> Time:
        """Return the time for messages."""
        return Time.from_sec(self.time) if self.simulated_clock else Time.now()

    async def publish_clock(self, node: Node) -> None:
        """Publish ``/clock`` in the graph of a node, once for each graph, if stamps are simulated time."""
        if self.simulated_clock and node.master_uri not in self._clocks:
            self._clocks[node.master_uri] = await node.advertise(TOPIC, CLOCK.name)

    def drop_clock(self, master_uri: str) -> None:
        """Publish ``/clock`` in a graph no longer: its node stops."""
        self._clocks.pop(master_uri, None)

    # Commands

    def pause(self) -> None:
        """Let time stand still."""
        self._running.clear()

    def resume(self) -> None:
        """Let time go on."""
        self._running.set()

    def step(self, seconds: float) -> None:
        """Advance a paused world at once by ``seconds``, at least by one time step."""
        for _ in range(max(1, round(seconds / self.world.spec.time_step))):
            self.tick()

    def reset(self, *, time: bool) -> None:
        """Begin anew; ``time``: also with time, else it goes on."""
        self._before = 0.0 if time else self.time
        self.world.reset()
        for driver in self.drivers.values():
            driver.reset()
        for call in self.on_reset:
            call()

    def tick(self) -> None:
        """Advance by one time step."""
        self.world.step()
        if self._clocks:
            payload = _STAMP.pack(*divmod(round(self.time * _NANOSECONDS), _NANOSECONDS))
            for clock in self._clocks.values():
                clock.publish_serialized(payload)
        scans = self.world.scans([name for name, driver in self.drivers.items() if driver.wants_scan])
        for name, driver in self.drivers.items():
            driver.update(scans.get(name))
        for call in self.on_update:
            call()

    async def run(self) -> None:
        """Run until cancelled."""
        loop = asyncio.get_running_loop()
        period = self.world.spec.time_step
        due = loop.time()
        meter = _SpeedMeter(loop.time(), self.time)
        while True:
            if self.paused:
                await self._running.wait()
                due = loop.time()
                meter = _SpeedMeter(due, self.time)
            self.tick()
            if not self.factor:
                await asyncio.sleep(0)
                continue
            due = max(due + period / self.factor, loop.time() - MAX_LAG)
            await asyncio.sleep(max(0.0, due - loop.time()))
            speed = meter.measure(loop.time(), self.time)
            if speed is not None and speed < TOO_SLOW * self.factor and self.on_slow is not None:
                self.on_slow(speed)


class _SpeedMeter:
    """Measures simulated seconds per second."""

    def __init__(self, now: float, simulated: float) -> None:
        self._since, self._from = now, simulated

    def measure(self, now: float, simulated: float) -> float | None:
        """Return the speed at the end of each window, else None."""
        if simulated < self._from:  # time began anew
            self._since, self._from = now, simulated
        if now - self._since < SPEED_WINDOW:
            return None
        speed = (simulated - self._from) / (now - self._since)
        self._since, self._from = now, simulated
        return speed


async def run_world(
    world: World,
    drivers: Iterable[RobotDriver],
    *,
    after_update: Callable[[], None] | None = None,
    pace: float = 1.0,
) -> None:
    """Run a world until cancelled; a short form of :class:`WorldRunner`.

    Args:
        world: The world.
        drivers: The robots in it.
        after_update: Called after each step.
        pace: Simulated seconds per second.
    """
    runner = WorldRunner(world, factor=pace)
    runner.drivers = {driver.robot: driver for driver in drivers}
    if after_update is not None:
        runner.on_update.append(after_update)
    await runner.run()
