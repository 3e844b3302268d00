"""Settings of the planner."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FleetSettings:
    """Sizes in metres, times in seconds.

    Attributes:
        robot_radius: Radius of the robots' hulls.
        clearance: Margin added to a hull's radius, for errors of the pose.
        arrival_tolerance: A robot this near to a cell's centre has arrived. The hull must still be inside
            the cell.
        corridor: Maximum distance of a robot from its path.
        still_distance: A robot that stays within this distance stands still ...
        settle_time: ... after this time.
        pose_timeout: A robot that was told to stand still, did so and sends no poses stands still after this
            time: longer than a pose is on its way.
        ahead: Maximum number of granted cells beyond a robot's own.
        silence_timeout: A robot without messages for this time is silent.
        hold_timeout: The others wait this long for a robot that is stopping.
        repeat_after: A message without effect is sent again after this time.
        stall_timeout: A robot with cells to drive to that stands still this long is stopped and sent again.
        seed: Breaks ties in plans.
        effort: Work spent on one plan, see :func:`rce_fleet.planning.lacam.plan`.
        visits_per_step: With one event, so many entries of a plan are taken over, so that none takes long.
        robots_per_step: With one event, so many robots are granted further cells.
    """

    robot_radius: float = 0.22
    clearance: float = 0.03
    arrival_tolerance: float = 0.15
    corridor: float = 0.25
    still_distance: float = 0.05
    settle_time: float = 0.35
    pose_timeout: float = 1.0
    ahead: int = 4
    silence_timeout: float = 3.0
    hold_timeout: float = 6.0
    repeat_after: float = 1.0
    stall_timeout: float = 8.0
    seed: int = 0
    effort: int = 20_000
    visits_per_step: int = 4_000
    robots_per_step: int = 200
