"""Costmaps, planners and ``move_base``'s decisions as one object: a robot's navigation without its topics."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from rce_fleet.navigation.costmap.cost_grid import Area, CostGrid
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.layered import LayeredCostmap
from rce_fleet.navigation.costmap.parameters import CostmapParameters
from rce_fleet.navigation.move_base.core import Decision, MoveBase
from rce_fleet.navigation.move_base.parameters import MoveBaseParameters
from rce_fleet.navigation.move_base.recovery import BackUp, ClearCostmaps, Recovery, Rotate, Wait
from rce_fleet.navigation.planners.global_planner import GlobalPlannerParameters, Plan, make_plan
from rce_fleet.navigation.planners.local_parameters import LocalPlannerParameters
from rce_fleet.navigation.planners.local_planner import LocalPlanner

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.geometry.poses import Pose
    from rce_fleet.navigation.move_base.situation import Situation

CLEAR_TYPES = ("clear_costmap_recovery/ClearCostmapRecovery",)
ROTATE_TYPES = ("rotate_recovery/RotateRecovery",)
BACK_UP_TYPES = ("back_up_recovery/BackUpRecovery",)
WAIT_TYPES = ("wait_recovery/WaitRecovery",)
RECOVERY_TYPES = (*CLEAR_TYPES, *ROTATE_TYPES, *BACK_UP_TYPES, *WAIT_TYPES)


@dataclass(frozen=True, slots=True)
class RecoverySpec:
    """A recovery behavior as parameters name it.

    Attributes:
        name: Its name.
        type: One of ``RECOVERY_TYPES``.
        reset_distance: Of a behavior that clears: edge of the square that is kept, metres; 0: nothing is.
        distance: Of one that backs up: metres.
        seconds: Of one that waits.
    """

    name: str
    type: str
    reset_distance: float = 3.0
    distance: float = 0.3
    seconds: float = 5.0


def default_recoveries(parameters: MoveBaseParameters) -> tuple[RecoverySpec, ...]:
    """Return the behaviors of ROS's ``move_base``, and after them two of ours: back up, and wait."""
    turn = [RecoverySpec("rotate_recovery", ROTATE_TYPES[0])] if parameters.clearing_rotation_allowed else []
    return (
        RecoverySpec("conservative_reset", CLEAR_TYPES[0], reset_distance=parameters.conservative_reset_dist),
        *turn,
        RecoverySpec("aggressive_reset", CLEAR_TYPES[0], reset_distance=0.0),
        *turn,
        RecoverySpec("back_up", BACK_UP_TYPES[0]),
        RecoverySpec("wait", WAIT_TYPES[0]),
    )


@dataclass(frozen=True, slots=True)
class NavigationSettings:
    """All parameters of ``move_base``.

    Attributes:
        move_base: Its own.
        global_costmap: The costmap in which plans are made.
        local_costmap: The costmap around the robot.
        global_planner: Of the global planner.
        local_planner: Of the local planner.
        recoveries: Recovery behaviors; None: the default ones.
    """

    move_base: MoveBaseParameters = field(default_factory=MoveBaseParameters)
    global_costmap: CostmapParameters = field(default_factory=CostmapParameters)
    local_costmap: CostmapParameters = field(default_factory=CostmapParameters)
    global_planner: GlobalPlannerParameters = field(default_factory=GlobalPlannerParameters)
    local_planner: LocalPlannerParameters = field(default_factory=LocalPlannerParameters)
    recoveries: tuple[RecoverySpec, ...] | None = None


class NavigationStack:
    """A robot's navigation.

    Args:
        settings: Parameters of all parts.

    Attributes:
        global_costmap: The costmap in which plans are made.
        local_costmap: The costmap around the robot.
        core: Decides when to plan, to drive and to recover.

    Raises:
        ValueError: A footprint or a recovery behavior is not valid.
    """

    def __init__(self, settings: NavigationSettings) -> None:
        self.settings = settings
        self.global_costmap, self.local_costmap = (
            LayeredCostmap(
                one, Footprint.read(one.footprint, one.robot_radius, padding=one.footprint_padding)
            )
            for one in (settings.global_costmap, settings.local_costmap)
        )
        self.local_planner = LocalPlanner(settings.local_planner, self.local_costmap.footprint)
        specs = settings.recoveries
        if specs is None:
            specs = default_recoveries(settings.move_base)
        self.core = MoveBase(settings.move_base, self.local_planner, self._recoveries(specs))

    def control(self, situation: Situation) -> Decision:
        """Update the local costmap and return what to do until the next step.

        Args:
            situation: What is known; the obstacles are filled in from the local costmap.
        """
        if not situation.problem:
            if self.local_costmap.static is not None:
                self.local_costmap.static.place(situation.local_from_global.inverse())
            self.local_costmap.update(situation.pose, situation.now)
            limits = self.settings.local_planner
            reach = (
                limits.max_vel_x * limits.sim_time + self.local_costmap.footprint.circumscribed_radius + 0.2
            )
            near = self.local_costmap.obstacles_near(situation.pose.x, situation.pose.y, reach)
            situation = replace(situation, obstacles=near)
        return self.core.step(situation, self.global_costmap.grid)

    def update_global(self, pose: Pose, now: float) -> Area:
        """Update the global costmap; return the cells whose costs may have changed."""
        return self.global_costmap.update(pose, now)

    def snapshot(self) -> CostGrid:
        """Return a copy of the global costs, for a plan that is made in a thread."""
        grid = self.global_costmap.grid
        copy = CostGrid(1, 1, grid.resolution, grid.origin)
        copy.values = grid.values.copy()
        return copy

    def plan(self, costs: CostGrid, start: Pose, goal: Pose, *, tolerance: float | None = None) -> Plan:
        """Return a plan between two poses in the global costmap's frame."""
        return make_plan(costs, start, goal, self.settings.global_planner, tolerance=tolerance)

    def clear_costmaps(self) -> None:
        """Forget all obstacles that sensors saw."""
        self.global_costmap.clear()
        self.local_costmap.clear()

    def _recoveries(self, specs: Sequence[RecoverySpec]) -> list[Recovery]:
        limits, footprint = self.settings.local_planner, self.local_costmap.footprint
        costmaps = (self.global_costmap, self.local_costmap)
        made: list[Recovery] = []
        for spec in specs:
            if spec.type in CLEAR_TYPES:
                made.append(ClearCostmaps(spec.name, costmaps, spec.reset_distance))
            elif spec.type in ROTATE_TYPES:
                made.append(Rotate(spec.name, limits, footprint))
            elif spec.type in BACK_UP_TYPES:
                made.append(BackUp(spec.name, limits, footprint, distance=spec.distance))
            elif spec.type in WAIT_TYPES:
                made.append(Wait(spec.name, spec.seconds))
            else:
                known = ", ".join(RECOVERY_TYPES)
                raise ValueError(f"recovery behavior {spec.name}: expected one of {known}, found {spec.type}")
        return made
