"""Notices odometry that jumps: a driver that was restarted, or a wheel encoder that lost its count."""

from __future__ import annotations

from math import hypot

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose

FASTEST = 5.0
"""No robot of this size drives faster, m/s."""
FASTEST_TURN = 15.0
"""No robot of this size turns faster, rad/s."""
SLACK_M = 0.5
"""Jumps up to this far are taken for wheels that slipped: the filter copes with them."""
SLACK_RAD = 0.8


class OdometryWatch:
    """Compares each pose of the odometry with the one before."""

    def __init__(self) -> None:
        self._last: tuple[Pose, float] | None = None

    def check(self, odometry: Pose, time: float) -> str:
        """Return what is wrong with a pose; empty if it can follow the one before.

        Args:
            odometry: The pose.
            time: When, seconds.
        """
        last, self._last = self._last, (odometry, time)
        if last is None:
            return ""
        before, then = last
        seconds = max(time - then, 0.0)
        way = hypot(odometry.x - before.x, odometry.y - before.y)
        turn = abs(wrap(odometry.yaw - before.yaw))
        if way > SLACK_M + FASTEST * seconds:
            return f"the odometry jumped {way:.2f} m within {seconds:.2f} s"
        if turn > SLACK_RAD + FASTEST_TURN * seconds:
            return f"the odometry jumped by {turn:.2f} rad within {seconds:.2f} s"
        return ""
