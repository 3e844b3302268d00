"""Parameters of ``move_base``: names and defaults of ROS 1's."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class MoveBaseParameters:
    """Private parameters of the node ``move_base``.

    Attributes:
        base_global_planner: The global planner; the part after the slash names its namespace and topics.
        base_local_planner: The same of the local planner.
        controller_frequency: Control steps in a second.
        controller_timeout: Seconds without a valid command after which recovery begins: ROS's
            ``controller_patience``.
        planner_frequency: Plans in a second while driving; 0: only for a new goal or a blocked path.
        planner_timeout: Seconds without a plan after which recovery begins: ROS's ``planner_patience``.
        max_planning_retries: Failed attempts after which recovery begins; -1: only after the patience.
        oscillation_timeout: Seconds in which the robot must have moved, else recovery begins; 0: not watched.
        oscillation_distance: How far it must have moved, metres.
        conservative_reset_dist: Obstacles farther away than half of this are forgotten first, metres.
        recovery_behavior_enabled: Recover; else a goal is aborted at once.
        clearing_rotation_allowed: Recovery may turn the robot on the spot.
        make_plan_add_unreachable_goal: Add the goal to a plan of that service that ends near it.
    """

    base_global_planner: str = "navfn/NavfnROS"
    base_local_planner: str = "base_local_planner/TrajectoryPlannerROS"
    controller_frequency: float = 20.0
    controller_timeout: float = field(default=15.0, metadata={"name": "controller_patience"})
    planner_frequency: float = 0.0
    planner_timeout: float = field(default=5.0, metadata={"name": "planner_patience"})
    max_planning_retries: int = -1
    oscillation_timeout: float = 0.0
    oscillation_distance: float = 0.5
    conservative_reset_dist: float = 3.0
    recovery_behavior_enabled: bool = True
    clearing_rotation_allowed: bool = True
    make_plan_add_unreachable_goal: bool = True

    def __post_init__(self) -> None:
        for name in ("controller_frequency", "oscillation_distance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, found {getattr(self, name)}")
        for name in ("controller_timeout", "planner_frequency", "planner_timeout", "oscillation_timeout"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected a number of at least 0, found {getattr(self, name)}")
