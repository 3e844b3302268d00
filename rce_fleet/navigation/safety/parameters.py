"""Parameters of the safety stage."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SafetyParameters:
    """Private parameters of the node ``velocity_limiter``.

    Attributes:
        robot_base_frame: Frame of the robot's centre.
        odom_frame: Frame in which the robot's motion is known.
        footprint: Corners ``[[x, y], ...]``; empty: a disc of ``robot_radius``.
        robot_radius: Metres.
        footprint_padding: Metres by which the footprint is made larger.
        deceleration: What the robot's brakes reach, m/s2.
        angular_deceleration: The same of a turn, rad/s2.
        delay: Time until a command has its effect, seconds; the age of the scan is added to it.
        margin: Distance to an obstacle at which the robot stands, metres.
        max_speed: Highest speed that passes, m/s.
        max_turn_rate: Highest turn rate that passes, rad/s.
        unseen_speed: Highest speed in a direction of which no scan tells, m/s.
        missing_is_free: Whether a beam that is NaN or shorter than ``range_min`` tells that nothing is there,
            for lidars whose drivers do not send ``inf``; a covered lidar is not noticed then.
        walking_speed: How fast something that moves may come nearer, m/s; 0: motion is not watched.
        scan_timeout: A scan older than this stops the robot, seconds.
        command_timeout: A command older than this stops it, seconds.
        transform_timeout: An odometry pose older than this stops it, seconds.
        memory: How long points are remembered that the sensor cannot see any more, seconds.
        frequency: Commands in a second that go to the wheels.
    """

    robot_base_frame: str = "base_link"
    odom_frame: str = "odom"
    footprint: str | tuple[tuple[float, float], ...] = ()
    robot_radius: float = 0.177
    footprint_padding: float = 0.0
    deceleration: float = 1.0
    angular_deceleration: float = 3.0
    delay: float = 0.1
    margin: float = 0.02
    max_speed: float = 0.65
    max_turn_rate: float = 3.14
    unseen_speed: float = 0.1
    missing_is_free: bool = False
    walking_speed: float = 1.0
    scan_timeout: float = 0.5
    command_timeout: float = 0.5
    transform_timeout: float = 0.5
    memory: float = 5.0
    frequency: float = 20.0

    def __post_init__(self) -> None:
        for name in (
            "deceleration",
            "angular_deceleration",
            "max_speed",
            "max_turn_rate",
            "scan_timeout",
            "command_timeout",
            "transform_timeout",
            "frequency",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, found {getattr(self, name)}")
        for name in ("delay", "margin", "unseen_speed", "walking_speed", "memory"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected a number of at least 0, found {getattr(self, name)}")
