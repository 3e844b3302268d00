"""Models of robots: what a kind of robot is like, from its hull to its battery."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from rce_fleet.simulation.battery import BatterySpec
from rce_fleet.simulation.drive import DriveSpec
from rce_fleet.simulation.lidar import LidarSpec
from rce_fleet.simulation.noise import EstimateSpec
from rce_fleet.simulation.odometry import OdometrySpec

RADII = (0.001, 1000.0)
"""Smallest and largest radius of a hull, metres."""
MASSES = (0.001, 1e6)
"""Smallest and largest mass of a robot, kilograms."""


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A kind of robot. The default is a disc with a lidar that follows every command at once.

    Attributes:
        radius: Radius of the hull, metres.
        mass: Kilograms.
        drive: Its wheels.
        odometry: Errors of its odometry.
        battery: Its battery.
        sensors: Its range sensors by name; one of them is used.
        sensor: The sensor that makes ``/scan``.
        estimate: Errors of the pose that stands for localization.
    """

    radius: float = 0.22
    mass: float = 20.0
    drive: DriveSpec = field(default_factory=DriveSpec)
    odometry: OdometrySpec = field(default_factory=OdometrySpec)
    battery: BatterySpec = field(default_factory=BatterySpec)
    sensors: dict[str, LidarSpec] = field(default_factory=lambda: {"lidar": LidarSpec()})
    sensor: str = "lidar"
    estimate: EstimateSpec = field(default_factory=EstimateSpec)

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True}

    def __post_init__(self) -> None:
        # The physics engine ends the program for others.
        for name, limits in (("radius", RADII), ("mass", MASSES)):
            low, high = limits
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be within {low:g} .. {high:g}, not {getattr(self, name)}")
        if self.sensor not in self.sensors:
            known = ", ".join(sorted(self.sensors)) or "none"
            raise ValueError(f"the robot has no sensor {self.sensor!r}; its sensors: {known}")
        if self.lidar.offset >= self.radius:
            raise ValueError(f"the sensor {self.sensor!r} must be within the hull of {self.radius} m")

    @property
    def lidar(self) -> LidarSpec:
        """The sensor that makes ``/scan``."""
        return self.sensors[self.sensor]


DISC = RobotModel()
"""The model of robots whose scene names none."""
