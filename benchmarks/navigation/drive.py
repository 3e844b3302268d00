"""One run: a robot drives to one goal on the demo's floor, among boxes and walkers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import hypot, pi

import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks.floor import Floor
from benchmarks.navigation.robot import NavigatedRobot, settings
from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.cost_grid import CostGrid
from rce_fleet.navigation.costmap.costs import FREE, INSCRIBED
from rce_fleet.navigation.move_base.core import Ending
from rce_fleet.navigation.planners.global_planner import make_plan
from rce_fleet.simulation.map_walls import draw_map
from rce_fleet.simulation.walls import Point, Walls

BOXES, UNMAPPED, WALKERS = 10, 3, 3
GIVE_UP = 180.0
FINE = 0.025
"""Edge of a cell of the grid in which the shortest way is found, metres."""
FAR = 3.0
"""A goal is at least this far from the start, metres."""
RIGHT = 0.25
"""A robot that says it is at the goal must truly be this near, metres: its tolerance and localization."""


@dataclass
class RunResult:
    """What came of a run.

    Attributes:
        seed: Seed of the run.
        reached: Whether ``move_base`` said that the goal was reached, and the robot truly was there.
        text: How it ended.
        driven: Length of the robot's true way, metres.
        shortest: Length of the shortest way for its footprint among walls, door and boxes, metres; 0: none.
        contacts: Contacts by its own motion.
        pushed: Contacts that a walker caused.
        seconds: Simulated time that it took.
        recoveries: How often a recovery behavior ran.
        steps: CPU time of each control step, seconds.
        error: Root mean square error of the localized position, metres.
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
    error: float = 0.0
    jerk: float = 0.0
    turning: float = 0.0


def shortest_way(floor: Floor, start: Pose, goal: Point) -> float:
    """Return the length of the shortest way for the robot's footprint, metres; 0 if there is none."""
    world = floor.world
    solid = [box.block for box in world.all_boxes.values()] + [door.block for door in world.doors.values()]
    inside = [world.grid.centre(cell) for cell in world.grid.free]
    drawn = draw_map(world.walls + Walls(tuple(solid)), inside, resolution=FINE)
    away = distance_transform_edt(drawn.free) * FINE - FINE / 2
    grid = CostGrid(drawn.rows, drawn.columns, FINE, (drawn.origin.x, drawn.origin.y))
    grid.values = np.where(away > floor.robot.radius, FREE, INSCRIBED).astype(np.uint8)
    plan = make_plan(grid, start, Pose(*goal, 0.0))
    return float(np.hypot(*np.diff(plan.path[:, :2], axis=0).T).sum()) if plan.found else 0.0


def run(seed: int, *, sampling: str = "pursuit") -> RunResult:
    """Drive one robot to one goal on a floor of a seed."""
    floor = Floor(seed, boxes=BOXES, unmapped=UNMAPPED, apart=None, walkers=WALKERS)
    start = floor.robot.pose
    x, y = floor.free_place(0.15)
    while hypot(x - start.x, y - start.y) < FAR:
        x, y = floor.free_place(0.15)
    goal = Pose(x, y, float(floor.rng.uniform(-pi, pi)))
    result = RunResult(seed, shortest=shortest_way(floor, start, (x, y)))
    if not result.shortest:
        return result
    chosen = settings()
    chosen = replace(chosen, local_planner=replace(chosen.local_planner, sampling=sampling))
    driver = NavigatedRobot(floor, chosen, seed)
    decision = driver.run(goal, GIVE_UP)
    result.text = decision.text if decision is not None else f"not there after {GIVE_UP:.0f} s"
    truth, collisions = floor.robot.pose, floor.world.collisions
    away = hypot(truth.x - x, truth.y - y)
    arrived = decision is not None and decision.ending is Ending.SUCCEEDED
    result.reached = arrived and away <= RIGHT
    if arrived and not result.reached:
        result.text = f"the robot believes to be at the goal, and is {away:.2f} m away"
    result.driven, result.seconds = floor.robot.distance, floor.world.time
    result.contacts = collisions.own_motion
    result.pushed = collisions.total - collisions.own_motion
    result.recoveries, result.steps = driver.stack.core.recovered, driver.steps
    result.error = float(np.sqrt(np.mean(np.square(driver.errors))))
    _judge_smoothness(result, driver, chosen.move_base.controller_frequency)
    return result


def _judge_smoothness(result: RunResult, driver: NavigatedRobot, frequency: float) -> None:
    speeds = np.array([one.speed for one in driver.commands])
    turns = np.array([one.turn_rate for one in driver.commands])
    if len(speeds) > 2:
        result.jerk = float(np.sqrt(np.mean(np.diff(speeds, 2) ** 2)) * frequency**2)
    result.turning = float(np.abs(np.diff(turns)).sum() / max(result.driven, 0.1))
