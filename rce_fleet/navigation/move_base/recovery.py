"""What a robot does that has no plan or no command: forget obstacles, turn around, back up, wait.

Each behavior is limited in time and distance, holds the robot's accelerations, and checks its footprint on
the way exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, copysign, hypot, pi, sqrt
from typing import TYPE_CHECKING, Protocol

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.planners.trajectories import free_steps, roll_out

if TYPE_CHECKING:
    from rce_fleet.navigation.costmap.footprint import Footprint
    from rce_fleet.navigation.costmap.layered import LayeredCostmap
    from rce_fleet.navigation.move_base.situation import Situation
    from rce_fleet.navigation.planners.local_parameters import LocalPlannerParameters

STANDING = Twist()
_LOOK_AHEAD = 1.0
"""Seconds of a recovery's motion that must be free of obstacles."""


@dataclass(frozen=True, slots=True)
class RecoveryStep:
    """The result of a step of a behavior.

    Attributes:
        twist: The speeds to drive until the next step.
        done: Whether the behavior has ended.
        text: What it did, when it has ended.
    """

    twist: Twist = STANDING
    done: bool = False
    text: str = ""


class Recovery(Protocol):
    """A recovery behavior."""

    @property
    def name(self) -> str:
        """Its name in the parameters."""

    def start(self, situation: Situation) -> None:
        """Begin."""

    def step(self, situation: Situation) -> RecoveryStep:
        """Return what to do until the next step."""


class ClearCostmaps:
    """Forgets obstacles that sensors saw outside a square around the robot (ClearCostmapRecovery).

    Args:
        name: Its name in the parameters.
        costmaps: The global costmap and the local one.
        reset_distance: Edge of the square, metres; 0: forget everything.
    """

    def __init__(
        self, name: str, costmaps: tuple[LayeredCostmap, LayeredCostmap], reset_distance: float
    ) -> None:
        self.name = name
        self._costmaps = costmaps
        self._side = reset_distance

    def start(self, situation: Situation) -> None:
        """Clear both costmaps."""
        for costmap, pose in zip(self._costmaps, (situation.global_pose, situation.pose), strict=True):
            if self._side > 0:
                costmap.clear_outside(pose, self._side)
            else:
                costmap.clear()

    def step(self, _situation: Situation) -> RecoveryStep:
        """Return that it is done."""
        where = f"outside {self._side:.1f} m" if self._side > 0 else "everywhere"
        return RecoveryStep(done=True, text=f"forgot obstacles {where}")


class Rotate:
    """Turns once around on the spot, so that sensors see all sides (RotateRecovery).

    Args:
        name: Its name in the parameters.
        limits: Of the robot.
        footprint: The robot's outline.
        timeout: Seconds after which it ends in any case.
    """

    def __init__(
        self, name: str, limits: LocalPlannerParameters, footprint: Footprint, timeout: float = 30.0
    ) -> None:
        self.name = name
        self._limits = limits
        self._footprint = footprint
        self._timeout = timeout
        self._started = self._turned = self._last = self._rate = 0.0

    def start(self, situation: Situation) -> None:
        """Begin to turn."""
        self._started, self._last = situation.now, situation.pose.yaw
        self._turned = self._rate = 0.0

    def step(self, situation: Situation) -> RecoveryStep:
        """Turn, as long as there is room."""
        limits = self._limits
        self._turned += wrap(situation.pose.yaw - self._last)
        self._last = situation.pose.yaw
        rest = 2 * pi - abs(self._turned)
        if rest <= limits.yaw_goal_tolerance:
            return RecoveryStep(done=True, text="turned around")
        if situation.now - self._started > self._timeout:
            return RecoveryStep(done=True, text=f"did not turn around within {self._timeout:.0f} s")
        rate = min(max(sqrt(limits.acc_lim_theta * rest), limits.min_vel_theta), limits.max_vel_theta)
        self._rate = min(rate, self._rate + limits.acc_lim_theta * situation.dt)
        twist = Twist(0.0, self._rate)
        if not _is_free(situation, twist, limits, self._footprint):
            return RecoveryStep(done=True, text="had no room to turn around")
        return RecoveryStep(twist)


class BackUp:
    """Drives a short way backwards.

    Args:
        name: Its name in the parameters.
        limits: Of the robot.
        footprint: The robot's outline.
        distance: Metres.
        speed: m/s.
        timeout: Seconds after which it ends in any case.
    """

    def __init__(
        self,
        name: str,
        limits: LocalPlannerParameters,
        footprint: Footprint,
        *,
        distance: float = 0.3,
        speed: float = 0.1,
        timeout: float = 10.0,
    ) -> None:
        self.name = name
        self._limits = limits
        self._footprint = footprint
        self._distance = distance
        self._speed = speed
        self._timeout = timeout
        self._started = self._now = 0.0
        self._from: Pose | None = None

    def start(self, situation: Situation) -> None:
        """Begin to drive backwards."""
        self._started, self._from, self._now = situation.now, situation.pose, 0.0

    def step(self, situation: Situation) -> RecoveryStep:
        """Drive backwards, as long as there is room."""
        assert self._from is not None
        done = hypot(situation.pose.x - self._from.x, situation.pose.y - self._from.y)
        if done >= self._distance:
            return RecoveryStep(done=True, text=f"backed up {done:.2f} m")
        if situation.now - self._started > self._timeout:
            return RecoveryStep(done=True, text=f"backed up {done:.2f} m in {self._timeout:.0f} s")
        self._now = min(self._speed, self._now + self._limits.acc_lim_x * situation.dt)
        twist = Twist(-self._now, 0.0)
        if not _is_free(situation, twist, self._limits, self._footprint):
            return RecoveryStep(done=True, text=f"backed up {done:.2f} m, then had no room")
        return RecoveryStep(twist)


class Wait:
    """Stands still, until a person may have gone on.

    Args:
        name: Its name in the parameters.
        seconds: How long.
    """

    def __init__(self, name: str, seconds: float = 5.0) -> None:
        self.name = name
        self._seconds = seconds
        self._started = 0.0

    def start(self, situation: Situation) -> None:
        """Begin to wait."""
        self._started = situation.now

    def step(self, situation: Situation) -> RecoveryStep:
        """Stand still."""
        waited = situation.now - self._started
        return RecoveryStep(done=waited >= self._seconds, text=f"waited {waited:.1f} s")


def _is_free(
    situation: Situation, twist: Twist, limits: LocalPlannerParameters, footprint: Footprint
) -> bool:
    """Return whether a motion keeps clear of obstacles for a while."""
    count = max(2, ceil(_LOOK_AHEAD / 0.05))
    poses, _ = roll_out(
        situation.pose,
        Twist(copysign(abs(twist.speed), twist.speed), twist.turn_rate),
        np.array((twist.speed,)),
        np.array((twist.turn_rate,)),
        (limits.acc_lim_x, limits.acc_lim_theta),
        (count, 0.05),
    )
    here = footprint.clearance(np.array((situation.pose.as_array(),)), situation.obstacles)
    clear = footprint.clearance(poses[0], situation.obstacles)
    return bool(free_steps(clear[None, :], limits.clearance, float(here[0]))[0] == count)
