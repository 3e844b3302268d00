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
ORIGIN_M = 0.1
"""Odometry nearer to its origin than this, metres, has begun anew if it was farther away before."""
PAUSE_S = 1.0
"""A driver that restarts is away for longer than this, seconds."""
PAUSE_SHARE = 3.0
"""A pause is also longer than this many of the usual intervals: some logs have few poses."""


def has_begun_anew(before: Pose, odometry: Pose) -> bool:
    """Return whether odometry is at its origin, where it was not before."""
    return hypot(odometry.x, odometry.y) < ORIGIN_M <= hypot(before.x, before.y)


class OdometryWatch:
    """Compares each pose of the odometry with the one before."""

    def __init__(self) -> None:
        self._last: tuple[Pose, float] | None = None
        self._interval = 0.0
        """Seconds between the last two poses."""

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
        is_pause = seconds > max(PAUSE_S, PAUSE_SHARE * self._interval)
        self._interval = seconds
        if is_pause and has_begun_anew(before, odometry) and (way > SLACK_M or turn > SLACK_RAD):
            return f"the odometry jumped to its origin, {way:.2f} m away, after a pause of {seconds:.2f} s"
        if way > SLACK_M + FASTEST * seconds:
            return f"the odometry jumped {way:.2f} m within {seconds:.2f} s"
        if turn > SLACK_RAD + FASTEST_TURN * seconds:
            return f"the odometry jumped by {turn:.2f} rad within {seconds:.2f} s"
        return ""
