"""Signs of life of a robot, as its move client sees them. Pure.

Localization publishes no poses while a robot stands (ROS's ``amcl`` publishes one after each
``update_min_d`` metres), so poses do not show that a standing robot is there. Its ``move_base`` publishes the
states of its goals all the time, and while it drives feedback with its pose. The move client reports how long
ago it heard the robot, and for a while after a drive where the robot was last.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import NamedTuple

FRESH = 2.0
"""Seconds for which the pose of a drive's last feedback is reported: messages may be lost or overtake."""

RobotPose = tuple[float, float, float]
"""(x, y, yaw) in the map: metres and radians."""


class RobotSign(NamedTuple):
    """What a move client last heard of its robot."""

    age: float | None = None
    """Seconds since the robot gave a sign of life; None if it never did."""
    pose: RobotPose | None = None
    """Where the robot was when its last drive ended, if that was just now; else None."""


NO_SIGN = RobotSign()


@dataclass(slots=True)
class RobotSigns:
    """The signs of life that a move client heard.

    Times are seconds of one monotonic clock.
    """

    _heard_at: float = -inf
    _pose: RobotPose | None = None
    _posed_at: float = -inf

    def hear(self, now: float) -> None:
        """Note a sign of life."""
        self._heard_at = now

    def take_pose(self, x: float, y: float, yaw: float, now: float) -> None:
        """Note the pose of a robot under way; numbers that are not finite are ignored."""
        self.hear(now)
        if isfinite(x) and isfinite(y) and isfinite(yaw):
            self._pose, self._posed_at = (x, y, yaw), now

    def sign(self, now: float, *, is_driving: bool) -> RobotSign:
        """Return what to report at ``now``.

        No pose is returned during a drive: localization publishes newer ones then.
        """
        age = round(now - self._heard_at, 3) if self._heard_at > -inf else None
        is_news = not is_driving and now - self._posed_at <= FRESH
        return RobotSign(age, self._pose if is_news else None)
