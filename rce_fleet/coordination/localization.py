"""Whether a robot knows where it is, by its poses and their covariance. Pure.

The covariance is what localization says of itself: of the particles of ``amcl``. Between the limits for
"lost" and for "found" a robot stays what it is, so that it does not change from one pose to the next.
"""

from __future__ import annotations

from math import degrees, isnan
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce_fleet.coordination.events import PoseSeen
    from rce_fleet.coordination.robot import RobotRecord
    from rce_fleet.coordination.settings import FleetSettings

FOUND = 0.7
"""Below this share of the limits a lost robot is found. ``amcl`` that was just told where the robot is says
0.5 m and 0.26 radians, which must be below."""
ADVICE = "localize it, or drive it by hand until it knows where it is"
"""What a person can do, at the end of the reason."""


def is_lost(record: RobotRecord, pose: PoseSeen, settings: FleetSettings) -> str:
    """Return why a robot is lost after a pose; empty: it is not.

    Args:
        record: The robot; a lost one keeps its reason.
        pose: Its pose. Without standard deviations nothing changes.
        settings: The limits.
    """
    spread, yaw_spread = pose.spread, pose.yaw_spread
    if spread is None or yaw_spread is None:
        return record.lost
    if record.lost:
        found = spread < FOUND * settings.lost_spread and yaw_spread < FOUND * settings.lost_yaw
        return "" if found else record.lost
    if spread > settings.lost_spread or yaw_spread > settings.lost_yaw:
        return f"its pose is uncertain by {spread:.1f} m and {degrees(yaw_spread):.0f} degrees: {ADVICE}"
    return ""


def fault_of_place(record: RobotRecord | None, settings: FleetSettings) -> str:
    """Return why it is not known where a robot is, and so which cells its sensors see; empty: it is known.

    Args:
        record: The robot; None: the planner does not know it.
        settings: The limits.
    """
    if record is None or isnan(record.x):
        return "it has sent no pose"
    if record.lost:
        return record.lost
    if record.doubted or not record.is_steady(settings):
        return "its pose jumped farther than it can drive"
    return ""
