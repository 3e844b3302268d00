"""A robot's battery: what drive, electronics and computer take out, and what a dock puts in."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import ClassVar

_JOULES_PER_WATT_HOUR = 3600.0


@dataclass(frozen=True, slots=True)
class BatterySpec:
    """Properties of a battery and of what it feeds. The default battery never gets empty.

    Attributes:
        capacity: Energy of a full battery, watt hours.
        charge: Share of it at the start, 0 .. 1.
        voltage_full: Volts of the full battery; between full and empty the voltage falls linearly.
        voltage_empty: Volts of the empty battery.
        idle: Watts of the electronics and sensors.
        computing: Watts of the computer at full load.
        computing_load: Load of the computer at the start, 0 .. 1.
        drive: Watts for each metre per second.
        turn: Watts for each radian per second.
        charging: Watts that a dock gives.
    """

    capacity: float = inf
    charge: float = 1.0
    voltage_full: float = 16.6
    voltage_empty: float = 13.2
    idle: float = 0.0
    computing: float = 0.0
    computing_load: float = 0.0
    drive: float = 0.0
    turn: float = 0.0
    charging: float = 0.0

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True}

    def __post_init__(self) -> None:
        if not self.capacity > 0:
            raise ValueError(f"capacity must be positive, not {self.capacity}")
        for name in ("charge", "computing_load"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be within 0 .. 1, not {getattr(self, name)}")
        powers = (self.idle, self.computing, self.drive, self.turn, self.charging)
        if not all(0 <= power < inf for power in powers):
            raise ValueError("powers must be finite and not negative")
        if not inf > self.voltage_full >= self.voltage_empty > 0:
            raise ValueError("voltages must be voltage_full >= voltage_empty > 0")


class Battery:
    """The battery of one robot.

    Args:
        spec: Its properties.

    Attributes:
        computing_load: Load of the robot's computer, 0 .. 1.
        charging: Whether it is charged now.
        power: Watts that flow out now; negative while it is charged.
    """

    def __init__(self, spec: BatterySpec) -> None:
        self.spec = spec
        self.computing_load = spec.computing_load
        self.charging = False
        self.power = 0.0
        self._limit = spec.capacity * _JOULES_PER_WATT_HOUR
        self._energy = spec.charge * self._limit if isfinite(self._limit) else inf

    @property
    def share(self) -> float:
        """What is left, as a share of the capacity."""
        return self._energy / self._limit if isfinite(self._limit) else 1.0

    @property
    def energy(self) -> float:
        """What is left, watt hours."""
        return self._energy / _JOULES_PER_WATT_HOUR

    @property
    def empty(self) -> bool:
        """Whether nothing is left."""
        return self._energy <= 0.0

    @property
    def full(self) -> bool:
        """Whether it holds its capacity."""
        return self._energy >= self._limit

    @property
    def voltage(self) -> float:
        """Volts now."""
        spec = self.spec
        return spec.voltage_empty + self.share * (spec.voltage_full - spec.voltage_empty)

    def step(self, dt: float, speed: float, turn_rate: float, *, docked: bool = False) -> None:
        """Advance by ``dt`` seconds of driving at these speeds; at a dock it is charged."""
        spec = self.spec
        self.power = spec.idle + self.computing_load * spec.computing
        self.power += spec.drive * abs(speed) + spec.turn * abs(turn_rate)
        self.charging = docked and spec.charging > 0
        if self.charging:
            self.power -= spec.charging
        self._energy = min(max(self._energy - self.power * dt, 0.0), self._limit)
