"""Drives one robot through a world: the parts of ``move_base`` and of the safety stage at their rates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import cos, hypot, pi, sin
from time import process_time
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks.navigation.world import HEIGHT, WIDTH, World, drawn, free_place, random_world
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.costmap.cost_grid import CostGrid
from rce_fleet.navigation.costmap.costs import FREE, INSCRIBED
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.observation import observe_scan
from rce_fleet.navigation.costmap.parameters import (
    CostmapParameters,
    InflationParameters,
    ObservationSource,
    ObstacleLayerParameters,
    StaticLayerParameters,
)
from rce_fleet.navigation.move_base.core import Ending
from rce_fleet.navigation.move_base.parameters import MoveBaseParameters
from rce_fleet.navigation.move_base.situation import Situation
from rce_fleet.navigation.move_base.stack import NavigationSettings, NavigationStack
from rce_fleet.navigation.planners.global_planner import make_plan
from rce_fleet.navigation.planners.local_parameters import LocalPlannerParameters
from rce_fleet.navigation.safety.limiter import VelocityLimiter
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.navigation.safety.seen import Scan

if TYPE_CHECKING:
    from rce_fleet.navigation.move_base.core import Decision

TICK = 0.02
CONTROL_EVERY, SAFETY_EVERY, SCAN_EVERY, GLOBAL_EVERY = 5, 2, 5, 25
"""In ticks: 10 Hz control and scans, 25 Hz safety, 2 Hz global costmap."""
GIVE_UP = 180.0
FINE = 0.025
"""Edge of a cell of the grid in which the shortest way is found, metres."""


def settings(sampling: str = "pursuit") -> NavigationSettings:
    """Return the parameters, the same for all runs."""
    local = CostmapParameters(
        global_frame="odom",
        rolling_window=True,
        width=4.0,
        height=4.0,
        robot_radius=0.177,
        obstacle_layer=ObstacleLayerParameters(observation_sources="scan"),
        inflation_layer=InflationParameters(inflation_radius=0.55, cost_scaling_factor=5.0),
        sources={"scan": ObservationSource("scan", data_type="LaserScan", clearing=True, inf_is_valid=True)},
    )
    return NavigationSettings(
        MoveBaseParameters(controller_frequency=10.0, controller_timeout=5.0, oscillation_timeout=20.0),
        replace(local, global_frame="map", rolling_window=False, static_layer=StaticLayerParameters()),
        local,
        local_planner=LocalPlannerParameters(
            max_vel_x=0.65, max_vel_theta=1.5, acc_lim_x=0.9, acc_lim_theta=4.0, sampling=sampling
        ),
    )


@dataclass
class RunResult:
    """What came of a run.

    Attributes:
        seed: Seed of the run.
        reached: Whether the goal was reached.
        text: Why not.
        driven: Length of the robot's way, metres.
        shortest: Length of the shortest way for its footprint among walls and boxes, metres; 0: none.
        contacts: Contacts by its own motion.
        pushed: Contacts that a walker caused.
        seconds: Time that it took.
        recoveries: How often a recovery behavior ran.
        steps: CPU time of each control step, seconds.
        jerk: Root mean square of the change of the commands' acceleration, m/s3.
        turning: Sum of the changes of the commanded turn rate for each metre, rad/s/m.
    """

    seed: int
    reached: bool = False
    text: str = ""
    driven: float = 0.0
    shortest: float = 0.0
    contacts: int = 0
    pushed: int = 0
    seconds: float = 0.0
    recoveries: int = 0
    steps: list[float] = field(default_factory=list)
    jerk: float = 0.0
    turning: float = 0.0


def shortest_way(world: World, goal: tuple[float, float]) -> float:
    """Return the length of the shortest way for the robot's footprint, metres; 0 if there is none."""
    solid = drawn([*world.walls, *world.boxes], FINE) > 0
    away = distance_transform_edt(~solid) * FINE - FINE / 2
    grid = CostGrid(round(HEIGHT / FINE), round(WIDTH / FINE), FINE)
    grid.values = np.where(away > world.model.radius, FREE, INSCRIBED).astype(np.uint8)
    plan = make_plan(grid, world.pose, Pose(*goal, 0.0))
    return float(np.hypot(*np.diff(plan.path[:, :2], axis=0).T).sum()) if plan.found else 0.0


class Driver:
    """One robot with its navigation in a world.

    Localization is off by a few centimetres, which change slowly: the frames of map and odometry move.
    """

    def __init__(self, world: World, chosen: NavigationSettings) -> None:
        self.world = world
        self.stack = NavigationStack(chosen)
        self.stack.global_costmap.set_map(world.map())
        footprint = Footprint(world.model.radius)
        self.limiter = VelocityLimiter(
            SafetyParameters(deceleration=world.model.acceleration, delay=0.1), footprint
        )
        self.commands: list[Twist] = []
        self.steps: list[float] = []

    def map_from_odom(self) -> Pose:
        """Return the error of localization now."""
        t = self.world.time
        return Pose(0.03 * sin(t / 7), 0.03 * cos(t / 5), 0.01 * sin(t / 11))

    def run(self, goal: Pose, give_up: float = GIVE_UP) -> Decision | None:
        """Drive to a goal; return how it ended."""
        world, stack = self.world, self.stack
        begin = world.time
        stack.core.start(world.time)
        tick = 0
        while world.time - begin < give_up:
            if tick % SCAN_EVERY == 0:
                self._sense()
            if tick % GLOBAL_EVERY == 0:
                at = self.map_from_odom()
                stack.update_global(at.compose(world.pose), world.time)
            if tick % CONTROL_EVERY == 0:
                decision = self._control(goal)
                if decision.ending is not None:
                    return decision
            if tick % SAFETY_EVERY == 0:
                self.limiter.take_pose(world.pose, world.time)
                world.drive(self.limiter.limit(world.time).twist)
            world.step(TICK)
            tick += 1
        return None

    def _control(self, goal: Pose) -> Decision:
        world, stack = self.world, self.stack
        at = self.map_from_odom()
        situation = Situation(
            now=world.time,
            dt=CONTROL_EVERY * TICK,
            pose=world.pose,
            measured=world.twist,
            local_from_global=at.inverse(),
        )
        began = process_time()
        decision = stack.control(situation)
        self.steps.append(process_time() - began)
        self.commands.append(decision.twist)
        self.limiter.take_command(decision.twist, world.time)
        if decision.wants_plan:
            plan = stack.plan(stack.snapshot(), at.compose(world.pose), goal)
            stack.core.take_plan(plan, world.time)
        return decision

    def _sense(self) -> None:
        world, stack = self.world, self.stack
        ranges, now, lidar = world.scan(), world.time, world.lidar
        limits = (0.05, lidar.max_range)
        for costmap, frame in (
            (stack.local_costmap, Pose(0.0, 0.0, 0.0)),
            (stack.global_costmap, self.map_from_odom()),
        ):
            assert costmap.obstacles is not None
            source = costmap.parameters.sources["scan"]
            sensor = frame.compose(world.pose)
            costmap.obstacles.take(
                "scan", observe_scan(ranges, -pi, lidar.increment, limits, sensor, source, now)
            )
        self.limiter.take_scan(Scan(now, world.pose, ranges, -pi, lidar.increment, 0.05))


def run(seed: int, *, sampling: str = "pursuit", walkers: int = 3) -> RunResult:
    """Drive one robot to one goal in a world of a seed."""
    world = random_world(seed, walkers=walkers)
    goal = free_place(world)
    while hypot(goal[0] - world.pose.x, goal[1] - world.pose.y) < 3.0:
        goal = free_place(world)
    result = RunResult(seed, shortest=shortest_way(world, goal))
    if not result.shortest:
        return result
    driver = Driver(world, settings(sampling))
    decision = driver.run(Pose(*goal, float(world.rng.uniform(-pi, pi))))
    result.reached = decision is not None and decision.ending is Ending.SUCCEEDED
    result.text = decision.text if decision is not None else f"not there after {GIVE_UP:.0f} s"
    result.driven, result.seconds = world.driven, world.time
    result.contacts, result.pushed = world.contacts, world.pushed
    result.recoveries, result.steps = driver.stack.core.recovered, driver.steps
    speeds = np.array([one.speed for one in driver.commands])
    turns = np.array([one.turn_rate for one in driver.commands])
    dt = CONTROL_EVERY * TICK
    result.jerk = float(np.sqrt(np.mean(np.diff(speeds, 2) ** 2)) / dt**2) if len(speeds) > 2 else 0.0
    result.turning = float(np.abs(np.diff(turns)).sum() / max(world.driven, 0.1))
    return result
