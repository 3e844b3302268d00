"""Parameters of the local planner: names and defaults of ROS's dwa_local_planner where it has them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LocalPlannerParameters:
    """Limits of the robot and settings of the local planner: ``~DWAPlannerROS/...`` or the like.

    Attributes:
        max_vel_x: Highest forward speed, m/s.
        min_vel_x: Lowest forward speed, m/s; the local planner never drives backwards.
        max_vel_theta: Highest turn rate, rad/s.
        min_vel_theta: Lowest rate of a turn on the spot, rad/s.
        acc_lim_x: Highest change of the forward speed, m/s2.
        acc_lim_theta: Highest change of the turn rate, rad/s2.
        xy_goal_tolerance: How far from the goal the robot may stop, metres.
        yaw_goal_tolerance: How far off the goal's heading it may stop, radians.
        latch_xy_goal_tolerance: A robot that was within the tolerance only turns from then on.
        trans_stopped_vel: A robot slower than this stands, m/s.
        theta_stopped_vel: A robot that turns slower than this stands, rad/s.
        sim_time: How far ahead trajectories are looked at, seconds.
        sim_granularity: Length of a trajectory's steps, metres.
        stop_time_buffer: Time between a command and its effect, seconds.
        lookahead_time: How far ahead on the path the robot steers to, in seconds of its speed (from nav2's
            regulated pure pursuit, as the following).
        min_lookahead_dist: The least of this distance, metres.
        max_lookahead_dist: The most of it, metres.
        rotate_to_heading_min_angle: Turn on the spot if the path leads off by more than this, radians.
        clearance: Distance to keep from obstacles along the trajectory, metres, beyond the padded footprint.
        comfort_clearance: Trajectories nearer to obstacles than this cost more, metres.
        sampling: ``pursuit`` or ``window``: which trajectories are looked at.
    """

    max_vel_x: float = 0.55
    min_vel_x: float = 0.0
    max_vel_theta: float = 1.0
    min_vel_theta: float = 0.4
    acc_lim_x: float = 2.5
    acc_lim_theta: float = 3.2
    xy_goal_tolerance: float = 0.1
    yaw_goal_tolerance: float = 0.1
    latch_xy_goal_tolerance: bool = False
    trans_stopped_vel: float = 0.1
    theta_stopped_vel: float = 0.1
    sim_time: float = 1.7
    sim_granularity: float = 0.025
    stop_time_buffer: float = 0.2
    lookahead_time: float = 1.5
    min_lookahead_dist: float = 0.2
    max_lookahead_dist: float = 0.9
    rotate_to_heading_min_angle: float = 0.785
    clearance: float = 0.02
    comfort_clearance: float = 0.12
    sampling: str = "pursuit"

    def __post_init__(self) -> None:
        for name in (
            "max_vel_x",
            "max_vel_theta",
            "acc_lim_x",
            "acc_lim_theta",
            "sim_time",
            "sim_granularity",
            "xy_goal_tolerance",
            "yaw_goal_tolerance",
            "min_lookahead_dist",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, found {getattr(self, name)}")
        if self.sampling not in ("pursuit", "window"):
            raise ValueError(f"sampling: expected pursuit or window, found {self.sampling!r}")
