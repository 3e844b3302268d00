"""The batteries of many robots at once: the rules of :class:`rce_fleet.simulation.battery.Battery`."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.simulation.battery import BatterySpec

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.simulation.lidar import Floats

TURTLEBOT_BATTERY = BatterySpec(
    capacity=32.0, idle=4.5, computing=18.0, computing_load=0.3, drive=12.0, turn=2.0, charging=36.0
)
"""Battery of a TurtleBot 2."""
_JOULES_PER_WATT_HOUR = 3600.0
_STANDS = 0.01
"""A slower robot stands, metres per second."""


class LightBatteries:
    """Batteries, one row for each robot.

    Args:
        count: Number of robots.
        spec: What all batteries are like.

    Attributes:
        spec: The same.
        power: Watts that flow out now, shape (N,); negative while charging.
        charging: Whether each one is charged now, shape (N,).
    """

    def __init__(self, count: int, spec: BatterySpec) -> None:
        self.spec = spec
        self.power: Floats = np.zeros(count)
        self.charging: NDArray[np.bool_] = np.zeros(count, np.bool_)
        self._limit = spec.capacity * _JOULES_PER_WATT_HOUR
        self._energy: Floats = np.full(count, spec.charge * self._limit if isfinite(self._limit) else np.inf)

    @property
    def shares(self) -> Floats:
        """What is left, as shares of the capacity, shape (N,)."""
        return self._energy / self._limit if isfinite(self._limit) else np.ones_like(self._energy)

    @property
    def empty(self) -> NDArray[np.bool_]:
        """Whether nothing is left, shape (N,)."""
        return np.asarray(self._energy <= 0.0)

    def step(self, dt: float, speeds: Floats, docked: NDArray[np.bool_]) -> None:
        """Advance by ``dt`` seconds.

        Args:
            dt: Seconds.
            speeds: Of the wheels, shape (N, 2): metres and radians per second.
            docked: Whether each robot is at a dock, shape (N,); one that stands there is charged.
        """
        spec, moving = self.spec, np.abs(speeds)
        used = spec.idle + spec.computing_load * spec.computing
        self.charging = docked & (moving[:, 0] < _STANDS) & (spec.charging > 0)
        self.power = (
            used + spec.drive * moving[:, 0] + spec.turn * moving[:, 1] - spec.charging * self.charging
        )
        np.clip(self._energy - self.power * dt, 0.0, self._limit, out=self._energy)
