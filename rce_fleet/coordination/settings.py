"""Settings of the planner."""

from __future__ import annotations

from dataclasses import dataclass

COMPILED_EFFORT = 1_000_000
"""Work spent on one plan at most where the planner's loops are compiled: about a second."""

PLAN_TIMEOUT = 60.0
"""Seconds after which the plan of a small fleet is given up. Plain loops need a second for 200 robots."""


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
        settle_time: ... after this time, which must be longer than a pose is later than a report.
        pose_timeout: A robot that was told to stand still, did so and sends no poses stands still after this
            time: longer than a pose is on its way.
        ahead: Maximum number of granted cells beyond a robot's own.
        silence_timeout: A robot without messages for this time is silent.
        expect_timeout: After a start no cells are granted for this time at most, until all robots that are
            known to exist have sent a pose.
        hold_timeout: The others wait this long for a robot that is stopping.
        repeat_after: A message without effect is sent again after this time.
        stall_timeout: A robot with cells to drive to that stands still this long is stopped and sent again.
        seed: Breaks ties in plans.
        effort: Work spent on one plan at most, see :class:`rce_fleet.planning.planner.PlanningProblem`. The
            planner's process spends :data:`COMPILED_EFFORT` where its loops are compiled.
        plan_timeout: A plan of the planner's process that takes longer is given up, and the process is ended;
            as much is added for each 500 robots.
        planner: Name of the planner: ``dijkstra``, or one that makes plans for all robots.
        resolve_deadlocks: Whether ``lacam`` plans for all when robots of the planner ``dijkstra`` wait for
            each other; otherwise their state only says so.
        quarter_turn: Time in which a robot turns by 90 degrees, over the time in which it drives through a
            cell; ``lacam`` plans for the time of turning. 0: not counted.
        stop: Time that a robot loses by stopping and starting, likewise.
        improve_seconds: Time in which the planner's process looks for better paths after paths have changed,
            see :mod:`rce_fleet.coordination.improving`; with ``lacam`` only. 0: never.
        learn_congestion: Whether moves for which robots waited of late cost more in new paths and plans, see
            :mod:`rce_fleet.coordination.congestion`.
        repairs: At most so many robots get new paths at once, between the others', and fewer on maps of more
            than 33 000 cells; if more need one, or there is none, the planner's process looks for them, see
            :mod:`rce_fleet.coordination.rerouting`. 0: one plan is always made for all.
        repair_effort: Places and times that are tried at most for the paths of one tick.
        manual_clearance: Margin around robots that are driven by hand, instead of ``clearance``.
        pose_only_after: A robot whose move client has sent nothing for this time since its first message is
            driven by its poses only.
        pose_only_settle: Such a robot stands still after this time without a new place.
        top_speed: No robot drives faster, metres per second.
        jump_distance: A pose farther from the one before than this and the way at top speed cannot be true.
        lost_spread: A robot is lost when the standard deviation of its place is larger than this, metres.
        lost_yaw: The same for its heading, radians.
        obstacle_reach: Cells that a robot reports, blocked or free, and that are farther from it than this
            are ignored, metres; a cell's size is added.
        sensed_lifetime: A cell that sensors found blocked is freed so long after a robot saw it blocked last;
            0: never.
        jump_settle_time: A robot whose pose jumped keeps its cells for this time of steady poses.
        patience: A robot that has stood so long, with a path to its goal and no cell to drive to, is the
            first in the next plan for all; see :mod:`rce_fleet.coordination.starvation`.
        visits_per_step: With one event, so many entries of a plan are taken over, so that none takes long.
        robots_per_step: With one event, so many robots are granted further cells.
    """

    robot_radius: float = 0.22
    clearance: float = 0.03
    arrival_tolerance: float = 0.15
    corridor: float = 0.25
    still_distance: float = 0.05
    settle_time: float = 0.45
    pose_timeout: float = 1.0
    ahead: int = 4
    silence_timeout: float = 3.0
    expect_timeout: float = 6.0
    hold_timeout: float = 6.0
    repeat_after: float = 1.0
    stall_timeout: float = 8.0
    seed: int = 0
    effort: int = 20_000
    plan_timeout: float = PLAN_TIMEOUT
    planner: str = "lacam"
    resolve_deadlocks: bool = False
    quarter_turn: float = 0.0
    stop: float = 0.0
    improve_seconds: float = 0.0
    learn_congestion: bool = False
    repairs: int = 3
    repair_effort: int = 12_000
    manual_clearance: float = 0.3
    pose_only_after: float = 10.0
    pose_only_settle: float = 3.0
    top_speed: float = 3.0
    jump_distance: float = 2.0
    jump_settle_time: float = 3.0
    lost_spread: float = 1.0
    lost_yaw: float = 1.0
    obstacle_reach: float = 10.0
    sensed_lifetime: float = 0.0
    patience: float = 30.0
    visits_per_step: int = 4_000
    robots_per_step: int = 200
