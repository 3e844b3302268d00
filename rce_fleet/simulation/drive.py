"""A differential drive: acceleration limits, a watchdog for commands, slip of the wheels."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf, isfinite, sqrt
from typing import TYPE_CHECKING, ClassVar

from rce_fleet.geometry.poses import Twist

if TYPE_CHECKING:
    import numpy as np

_DRAWN = 256
"""Random numbers that are drawn at once: one by one they cost ten times as much."""


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """What a robot's wheels can do. The default drive follows every command at once.

    Attributes:
        speed: Highest speed forward and backward, metres per second.
        turn_rate: Highest turn rate, radians per second.
        acceleration: Highest change of the speed while it grows, metres per second squared.
        deceleration: Highest change of the speed while it falls.
        turn_acceleration: Highest change of the turn rate, radians per second squared.
        command_timeout: Seconds without a command after which the robot stops.
        slip: Share of the wheels' motion that does not move the robot: its mean.
        slip_noise: Standard deviation of this share.
        slip_memory: Correlation time of this share, seconds.
        wheels_stall: Whether wheels stop when the robot is held by an obstacle. If not, they spin, and
            odometry counts on.
    """

    speed: float = inf
    turn_rate: float = inf
    acceleration: float = inf
    deceleration: float = inf
    turn_acceleration: float = inf
    command_timeout: float = inf
    slip: float = 0.0
    slip_noise: float = 0.0
    slip_memory: float = 1.0
    wheels_stall: bool = True

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True}

    def __post_init__(self) -> None:
        for name in ("speed", "turn_rate", "acceleration", "deceleration", "turn_acceleration"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, not {getattr(self, name)}")
        if not (0 <= self.slip < 1 and 0 <= self.slip_noise < inf and self.slip_memory > 0):
            raise ValueError(
                "slip must be within 0 .. 1, slip_noise finite and not negative, and slip_memory positive"
            )
        if not self.command_timeout > 0:
            raise ValueError(f"command_timeout must be positive, not {self.command_timeout}")


class Drive:
    """The wheels of one robot.

    Args:
        spec: What they can do.
        rng: Draws the slip.

    Attributes:
        wheels: Speeds of the wheels, as the motion that they would make without slip.
        slip: Share of this motion that is lost now.
    """

    def __init__(self, spec: DriveSpec, rng: np.random.Generator) -> None:
        self.spec = spec
        self.wheels = Twist()
        self.slip = spec.slip
        self._normals = Normals(rng)
        self._command = Twist()
        self._commanded_at = 0.0
        self._now = 0.0
        self._keep = (0.0, 1.0, 0.0)

    @property
    def ground(self) -> Twist:
        """The motion over the ground that the wheels make."""
        grip = 1.0 - self.slip
        return Twist(self.wheels.speed * grip, self.wheels.turn_rate * grip)

    def command(self, twist: Twist) -> None:
        """Set the wanted speeds; they hold until ``spec.command_timeout``. What is not finite counts as 0."""
        spec = self.spec
        self._command = Twist(_within(twist.speed, spec.speed), _within(twist.turn_rate, spec.turn_rate))
        self._commanded_at = self._now

    def step(self, dt: float, *, powered: bool = True) -> None:
        """Advance the wheels' speeds by ``dt`` seconds; without power they brake."""
        spec = self.spec
        wanted = self._command
        if not powered or self._now - self._commanded_at >= spec.command_timeout - 1e-9:
            wanted = Twist()
        self._now += dt
        speed, turn = self.wheels.speed, self.wheels.turn_rate
        slows = abs(wanted.speed) < abs(speed) or wanted.speed * speed < 0
        limit = (spec.deceleration if slows else spec.acceleration) * dt
        self.wheels = Twist(
            _towards(speed, wanted.speed, limit),
            _towards(turn, wanted.turn_rate, spec.turn_acceleration * dt),
        )
        if spec.slip_noise:
            if self._keep[0] != dt:
                keep = exp(-dt / spec.slip_memory)
                self._keep = (dt, keep, sqrt(1 - keep * keep) * spec.slip_noise)
            _, keep, spread = self._keep
            self.slip = spec.slip + keep * (self.slip - spec.slip) + spread * self._normals.next()
            self.slip = min(max(self.slip, -0.5), 1.0)

    def stop(self) -> None:
        """Stand still at once; for a robot that is put elsewhere."""
        self.wheels = self._command = Twist()


class Normals:
    """Standard normal numbers one by one, drawn in blocks.

    Args:
        rng: Draws them.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._block: list[float] = []

    def next(self) -> float:
        """Return the next number."""
        if not self._block:
            self._block = self._rng.standard_normal(_DRAWN).tolist()
        return self._block.pop()


def _within(value: float, limit: float) -> float:
    if not isfinite(value):
        return 0.0
    return max(-limit, min(limit, value))


def _towards(value: float, wanted: float, step: float) -> float:
    return value + max(-step, min(step, wanted - value))
