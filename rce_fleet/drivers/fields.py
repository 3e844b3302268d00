"""Fields of messages about simulated robots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from rce.ros.tf import Transform
from rce_fleet.geometry.angles import quaternion_z

if TYPE_CHECKING:
    from rce_fleet.geometry.poses import Pose, Twist
    from rce_fleet.simulation.battery import Battery, BatterySpec
    from rce_fleet.simulation.lidar import Floats, LidarSpec

_CHARGING, _DISCHARGING, _FULL = 1, 2, 4
_LITHIUM_ION = 2
OK, WARN, ERROR = 0, 1, 2
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""
_LOW = 0.2
"""Share of a battery under which it is low."""


def transform_of(pose: Pose) -> Transform:
    """Return the transform of a pose in its parent frame."""
    return Transform.make(pose.x, pose.y, yaw=pose.yaw)


def pose_fields(pose: Pose) -> dict[str, Any]:
    """Return the fields of a ``geometry_msgs/Pose``."""
    z, w = quaternion_z(pose.yaw)
    return {"position": {"x": pose.x, "y": pose.y}, "orientation": {"z": z, "w": w}}


def twist_fields(twist: Twist) -> dict[str, Any]:
    """Return the fields of a ``geometry_msgs/Twist``."""
    return {"linear": {"x": twist.speed}, "angular": {"z": twist.turn_rate}}


def scan_fields(spec: LidarSpec, ranges: Floats) -> dict[str, Any]:
    """Return the fields of a ``sensor_msgs/LaserScan`` without its header."""
    return {
        "angle_min": spec.angle_min,
        "angle_max": spec.angle_min + (spec.beams - 1) * spec.increment,
        "angle_increment": spec.increment,
        "scan_time": 1.0 / spec.rate,
        "range_min": spec.min_range,
        "range_max": spec.max_range,
        "ranges": ranges.tolist(),
    }


def battery_fields(battery: Battery) -> dict[str, Any]:
    """Return the fields of a ``sensor_msgs/BatteryState`` without its header."""
    return charge_fields(battery.spec, battery.share, battery.power, charging=battery.charging)


def charge_fields(spec: BatterySpec, share: float, power: float, *, charging: bool) -> dict[str, Any]:
    """Return the same of a battery that is one of many.

    Args:
        spec: What it is like.
        share: What is left of its capacity, 0 .. 1.
        power: Watts that flow out.
        charging: Whether it is charged.
    """
    capacity = spec.capacity / spec.voltage_full
    known = math.isfinite(capacity)
    voltage = spec.voltage_empty + share * (spec.voltage_full - spec.voltage_empty)
    is_full = share >= 1.0
    discharging = _FULL if is_full else _DISCHARGING
    return {
        "voltage": voltage,
        "current": -power / voltage,
        "charge": share * capacity if known else math.nan,
        "capacity": capacity if known else math.nan,
        "design_capacity": capacity if known else math.nan,
        "percentage": share,
        "power_supply_status": _CHARGING if charging and not is_full else discharging,
        "power_supply_health": 1,
        "power_supply_technology": _LITHIUM_ION,
        "present": True,
    }


def battery_diagnosis(battery: Battery) -> tuple[int, str]:
    """Return level and text of a battery's diagnosis."""
    if battery.empty:
        return ERROR, "empty: the motors are off; bring the robot to a dock"
    if battery.charging:
        return OK, f"charging, {battery.share:.0%}"
    return (WARN if battery.share < _LOW else OK), f"{battery.share:.0%} left"
