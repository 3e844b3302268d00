"""What ``move_base`` knows at a control step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose, Twist

if TYPE_CHECKING:
    from numpy.typing import NDArray

IDENTITY = Pose(0.0, 0.0, 0.0)
STANDING = Twist()


@dataclass(frozen=True)
class Situation:
    """What is known at a control step.

    Attributes:
        now: Time, seconds.
        dt: Time until the next step, seconds.
        pose: Pose of the robot in the local costmap's frame.
        measured: Its speeds by odometry.
        obstacles: Points of obstacles around it, shape (M, 2), metres in the local costmap's frame.
        local_from_global: Pose of the global costmap's frame in the local one's.
        problem: Why the robot must stand still (no map, transforms or scans missing or late); else empty.
    """

    now: float
    dt: float
    pose: Pose = IDENTITY
    measured: Twist = STANDING
    obstacles: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    local_from_global: Pose = IDENTITY
    problem: str = ""

    @property
    def global_pose(self) -> Pose:
        """Pose of the robot in the global costmap's frame."""
        return self.pose.relative_to(self.local_from_global)
