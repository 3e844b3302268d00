"""move_base's decisions: planning, driving, recovery, endings, and the parameters that it is made from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rce_fleet.geometry.poses import Pose, Twist, transform_points
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.navigation.costmap.cost_grid import CostGrid
from rce_fleet.navigation.costmap.costs import LETHAL
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.layered import LayeredCostmap
from rce_fleet.navigation.costmap.parameters import (
    CostmapParameters,
    ObstacleLayerParameters,
    StaticLayerParameters,
)
from rce_fleet.navigation.move_base.core import Decision, Ending, MoveBase, State
from rce_fleet.navigation.move_base.parameters import MoveBaseParameters
from rce_fleet.navigation.move_base.recovery import BackUp, ClearCostmaps, Rotate, Wait
from rce_fleet.navigation.move_base.situation import Situation
from rce_fleet.navigation.move_base.stack import NavigationSettings, NavigationStack, RecoverySpec
from rce_fleet.navigation.planners.global_planner import Plan, make_plan
from rce_fleet.navigation.planners.local_parameters import LocalPlannerParameters
from rce_fleet.navigation.planners.local_planner import LocalPlanner
from rce_fleet.nodes.move_base_parameters import read_settings

DISC = Footprint(0.2)
LIMITS = LocalPlannerParameters(max_vel_x=0.6, acc_lim_x=1.0)
HERE = Pose(1.0, 1.0, 0.0)
GOAL = Pose(3.0, 1.0, 0.0)
NO_WAY = Plan(np.empty((0, 3)), "no way leads there")


class Robot:
    """Drives what a core decides, in an empty room, and makes the plans that it wants."""

    def __init__(self, parameters: MoveBaseParameters, recoveries: list[Any] | None = None) -> None:
        self.core = MoveBase(parameters, LocalPlanner(LIMITS, DISC), recoveries or [])
        self.costs = CostGrid(40, 80, 0.1)
        self.now = 100.0
        self.pose, self.twist = HERE, Twist()
        self.obstacles = np.empty((0, 2))
        self.problem = ""
        self.plan: Plan | None = None
        self.plans = 0

    def state(self) -> State:
        return self.core.state

    def step(self) -> Decision:
        situation = Situation(self.now, 0.1, self.pose, self.twist, self.obstacles, problem=self.problem)
        decision = self.core.step(situation, self.costs)
        self.twist = decision.twist
        self.pose = Pose(
            self.pose.x + self.twist.speed * 0.1 * np.cos(self.pose.yaw),
            self.pose.y + self.twist.speed * 0.1 * np.sin(self.pose.yaw),
            self.pose.yaw + self.twist.turn_rate * 0.1,
        )
        if decision.wants_plan:
            self.plans += 1
            made = make_plan(self.costs, self.pose, GOAL) if self.plan is None else self.plan
            self.core.take_plan(made, self.now)
        self.now += 0.1
        return decision

    def run(self, seconds: float) -> Decision:
        decision = Decision()
        for _ in range(round(seconds * 10)):
            decision = self.step()
            if decision.ending is not None:
                break
        return decision


def test_a_goal_is_planned_driven_and_reached() -> None:
    robot = Robot(MoveBaseParameters())
    assert robot.run(1.0) == Decision()
    robot.core.start(robot.now)
    assert robot.state() is State.PLANNING
    decision = robot.run(30.0)
    assert decision.ending is Ending.SUCCEEDED
    assert robot.state() is State.IDLE
    assert np.hypot(robot.pose.x - GOAL.x, robot.pose.y - GOAL.y) <= LIMITS.xy_goal_tolerance
    assert robot.plans == 1


def test_without_a_plan_the_goal_is_aborted_with_the_reason() -> None:
    robot = Robot(MoveBaseParameters(planner_timeout=2.0))
    robot.plan = NO_WAY
    robot.core.start(robot.now)
    began = robot.now
    decision = robot.run(30.0)
    assert decision.ending is Ending.ABORTED
    assert decision.text == "Failed to find a valid plan: no way leads there."
    assert 2.0 <= robot.now - began <= 3.0


def test_planning_retries_are_limited() -> None:
    robot = Robot(MoveBaseParameters(planner_timeout=100.0, max_planning_retries=2))
    robot.plan = NO_WAY
    robot.core.start(robot.now)
    assert robot.run(30.0).ending is Ending.ABORTED
    assert robot.plans == 3


def test_cancelling_stops_with_the_next_command() -> None:
    robot = Robot(MoveBaseParameters())
    robot.core.start(robot.now)
    robot.run(2.0)
    assert robot.twist.speed > 0
    robot.core.cancel()
    assert robot.state() is State.IDLE
    assert robot.step().twist == Twist()
    robot.core.cancel()  # without a goal: nothing


def test_a_new_goal_replaces_the_present_one() -> None:
    robot = Robot(MoveBaseParameters())
    robot.core.start(robot.now)
    robot.run(2.0)
    robot.core.start(robot.now)
    assert robot.state() is State.PLANNING
    assert robot.run(30.0).ending is Ending.SUCCEEDED
    assert robot.plans == 2


def test_a_plan_that_comes_too_late_is_ignored() -> None:
    robot = Robot(MoveBaseParameters())
    robot.core.take_plan(make_plan(robot.costs, HERE, GOAL), 1.0)
    assert robot.state() is State.IDLE


def test_a_problem_stops_the_robot_until_it_is_gone() -> None:
    """The times of waiting do not count as failures."""
    robot = Robot(MoveBaseParameters(controller_timeout=1.0, planner_timeout=1.0))
    robot.core.start(robot.now)
    robot.run(2.0)
    robot.problem = "transforms are late"
    decision = robot.step()
    assert decision.twist == Twist()
    assert decision.text == "transforms are late"
    assert robot.run(10.0).ending is None
    robot.problem = ""
    assert robot.run(30.0).ending is Ending.SUCCEEDED


def run_with_problems(robot: Robot, seconds: int) -> Decision:
    """Run with one late transform every second."""
    decision = Decision()
    for _ in range(seconds):
        robot.problem = "transforms are late"
        robot.step()
        robot.problem = ""
        decision = robot.run(0.9)
        if decision.ending is not None:
            break
    return decision


def test_short_problems_do_not_keep_a_blocked_robot() -> None:
    """The time before a problem counts, only that of the problem does not."""
    order: list[str] = []
    robot = Robot(MoveBaseParameters(controller_timeout=3.0), [Noted("a", order)])
    robot.obstacles = np.array([(1.25, y) for y in np.linspace(0, 2, 41)])
    robot.core.start(robot.now)
    run_with_problems(robot, 3)
    assert order == []
    decision = run_with_problems(robot, 10)
    assert order == ["a"]
    assert decision.ending is Ending.ABORTED


def test_short_problems_do_not_hide_oscillation() -> None:
    order: list[str] = []
    robot = Robot(MoveBaseParameters(oscillation_timeout=3.0), [Noted("a", order)])
    robot.core.start(robot.now)
    for step in range(50):
        robot.pose = HERE  # it slips
        robot.problem = "transforms are late" if step % 10 == 0 else ""
        robot.step()
    assert order == ["a"]


def test_time_without_a_goal_does_not_add_to_patience() -> None:
    """The first control step after a goal may have a problem, a long time after the one before it."""
    robot = Robot(MoveBaseParameters(planner_timeout=2.0))
    robot.plan = NO_WAY
    robot.step()
    robot.now += 1000.0
    robot.core.start(robot.now)
    robot.problem = "transforms are late"
    robot.step()
    robot.problem = ""
    assert robot.run(10.0).ending is Ending.ABORTED


def test_after_a_problem_the_robot_drives_straight_on() -> None:
    """It was far along its path, which it does not follow from the beginning again."""
    robot = Robot(MoveBaseParameters())
    robot.costs = CostGrid(40, 400, 0.1)
    robot.plan = make_plan(robot.costs, HERE, Pose(35.0, 1.0, 0.0))
    robot.core.start(robot.now)
    robot.run(40.0)
    assert robot.pose.x > 20.0
    robot.problem = "transforms are late"
    robot.run(0.5)
    robot.problem = ""
    for _ in range(20):
        assert abs(robot.step().twist.turn_rate) < 0.1
    assert robot.twist.speed > 0.4


def test_a_blocked_path_is_planned_anew() -> None:
    robot = Robot(MoveBaseParameters())
    robot.core.start(robot.now)
    robot.run(1.0)
    robot.costs.values[8:12, 20:22] = LETHAL
    robot.run(1.0)
    assert robot.plans >= 2
    assert robot.run(30.0).ending is Ending.SUCCEEDED


def test_plans_are_renewed_at_the_planner_frequency() -> None:
    robot = Robot(MoveBaseParameters(planner_frequency=1.0))
    robot.core.start(robot.now)
    robot.run(3.5)
    assert robot.plans == 4


@pytest.mark.parametrize("frequency", [0.5, 1.0, 2.0, 5.0, 10.0])
def test_planner_frequencies_are_held(frequency: float) -> None:
    robot = Robot(MoveBaseParameters(planner_frequency=frequency))
    robot.core.start(robot.now)
    robot.run(4.0)
    assert robot.plans == pytest.approx(4.0 * frequency, abs=1)


class Noted(Wait):
    """A recovery behavior that takes half a second, and notes that it began."""

    def __init__(self, name: str, order: list[str]) -> None:
        super().__init__(name, 0.5)
        self.order = order

    def start(self, situation: Situation) -> None:
        self.order.append(self.name)
        super().start(situation)


# Behaviors


def situation(now: float = 0.0, pose: Pose = HERE, obstacles: Any = None) -> Situation:
    points = np.empty((0, 2)) if obstacles is None else np.array(obstacles)
    return Situation(now, 0.1, pose, Twist(), points)


def test_a_rotation_turns_once_around() -> None:
    rotate = Rotate("rotate", LIMITS, DISC)
    rotate.start(situation())
    turned, rate, now = 0.0, 0.0, 0.0
    for _ in range(200):
        step = rotate.step(situation(now, Pose(1.0, 1.0, turned)))
        if step.done:
            break
        assert abs(step.twist.turn_rate - rate) <= LIMITS.acc_lim_theta * 0.1 + 1e-9
        assert step.twist.speed == 0
        rate = step.twist.turn_rate
        turned, now = turned + rate * 0.1, now + 0.1
    assert step.text == "turned around"
    assert turned == pytest.approx(2 * np.pi, abs=0.25)


def test_a_plank_does_not_rotate_without_room() -> None:
    plank = Footprint(corners=((0.4, 0.1), (-0.4, 0.1), (-0.4, -0.1), (0.4, -0.1)))
    rotate = Rotate("rotate", LIMITS, plank)
    rotate.start(situation())
    step = rotate.step(situation(obstacles=[(1.3, 1.2)]))
    assert step.done
    assert step.text == "had no room to turn around"


def test_backing_up_ends_after_its_distance_or_at_an_obstacle() -> None:
    back = BackUp("back_up", LIMITS, DISC, distance=0.3)
    back.start(situation())
    step = back.step(situation(0.1))
    assert step.twist.speed < 0
    assert back.step(situation(3.0, Pose(0.69, 1.0, 0.0))).text == "backed up 0.31 m"
    back.start(situation())
    step = back.step(situation(0.1, obstacles=[(0.77, 1.0)]))
    assert step.done
    assert step.twist == Twist()
    back.start(situation())
    assert back.step(situation(60.0)).done


def test_clearing_forgets_what_sensors_saw() -> None:
    parameters = CostmapParameters(obstacle_layer=ObstacleLayerParameters())
    costmaps = LayeredCostmap(parameters, DISC), LayeredCostmap(parameters, DISC)
    for one in costmaps:
        assert one.obstacles is not None
        one.obstacles._mark(one.grid, np.array(((1.5, 1.0), (8.0, 8.0))))
        one.update(HERE, 0.0)
        assert np.count_nonzero(one.grid.values == LETHAL) == 2
    ClearCostmaps("clear", costmaps, 3.0).start(situation())
    for one in costmaps:
        one.update(HERE, 0.1)
        assert np.count_nonzero(one.grid.values == LETHAL) == 1
    ClearCostmaps("clear", costmaps, 0.0).start(situation())
    for one in costmaps:
        one.update(HERE, 0.2)
        assert np.count_nonzero(one.grid.values == LETHAL) == 0


def test_the_default_behaviors_are_those_of_ros_and_two_more() -> None:
    stack = NavigationStack(NavigationSettings())
    assert [one.name for one in stack.core._recoveries] == [
        "conservative_reset",
        "rotate_recovery",
        "aggressive_reset",
        "rotate_recovery",
        "back_up",
        "wait",
    ]
    wrong = replace(NavigationSettings(), recoveries=(RecoverySpec("x", "y/Z"),))
    with pytest.raises(ValueError, match="recovery behavior x: expected one of"):
        NavigationStack(wrong)


def test_a_local_costmap_draws_the_map_where_it_is() -> None:
    """The local costmap is in the odometry's frame, which lies askew on the map and drifts."""
    local = CostmapParameters(
        global_frame="odom", rolling_window=True, width=4.0, height=4.0, static_layer=StaticLayerParameters()
    )
    stack = NavigationStack(replace(NavigationSettings(), local_costmap=local))
    picture = np.zeros((60, 60), np.int8)
    picture[20:24, 30:34] = 100
    drawn = OccupancyMap(picture, 0.1)
    stack.local_costmap.set_map(drawn)
    box = drawn.cell_to_world(np.argwhere(picture > 0))
    for odom_from_map in (Pose(0.0, 0.0, 0.0), Pose(0.5, -0.7, 0.4), Pose(0.6, -0.7, 0.5)):
        at = odom_from_map.compose(Pose(3.0, 2.0, 0.0))
        stack.control(Situation(1.0, 0.1, at, local_from_global=odom_from_map))
        grid = stack.local_costmap.grid
        inside = box[(np.abs(box - box.mean(axis=0)) < 0.11).all(axis=1)]
        assert (grid.costs_at(transform_points(odom_from_map.as_array(), inside)) == LETHAL).all()
        lethal = grid.centres_of(np.argwhere(grid.values == LETHAL))
        assert (drawn.values_at(transform_points(odom_from_map.inverse().as_array(), lethal)) == 100).all()


# Parameters

LAUNCH_FILE: dict[str, Any] = {
    "base_local_planner": "dwa_local_planner/DWAPlannerROS",
    "controller_patience": 3.0,
    "DWAPlannerROS": {"max_vel_x": 0.3, "acc_lim_th": 2.0, "vx_samples": 6, "max_rot_vel": 0.9},
    "NavfnROS": {"default_tolerance": 0.3, "allow_unknown": False},
    "global_costmap": {
        "footprint": "[[-0.2,-0.2],[-0.2,0.2],[0.2,0.2],[0.2,-0.2]]",
        "plugins": [
            {"name": "static", "type": "costmap_2d::StaticLayer"},
            {"name": "seen", "type": "costmap_2d::VoxelLayer"},
            {"name": "inflated", "type": "costmap_2d::InflationLayer"},
        ],
        "static": {"map_topic": "/map2"},
        "seen": {
            "observation_sources": "laser bump",
            "obstacle_range": 4.0,
            "laser": {"data_type": "LaserScan", "clearing": True},
            "bump": {"data_type": "PointCloud2", "obstacle_range": 1.0},
        },
        "inflated": {"inflation_radius": 0.7},
    },
    "local_costmap": {
        "rolling_window": True,
        "static_map": False,
        "width": 3.0,
        "observation_sources": "scan",
        "scan": {"data_type": "LaserScan", "sensor_frame": "laser"},
        "inflation_radius": 0.4,
        "obstacle_range": 3.5,
    },
}


def test_parameters_of_a_launch_file_are_read() -> None:
    """The global costmap with layers, the local one as before hydro."""
    settings, problems = read_settings(LAUNCH_FILE)
    assert [problem.text for problem in problems] == [
        "parameter ~DWAPlannerROS/vx_samples has no effect: this node does not use it"
    ]
    assert settings.move_base.controller_timeout == 3.0
    assert settings.local_planner.max_vel_x == 0.3
    assert settings.local_planner.acc_lim_theta == 2.0
    assert settings.local_planner.max_vel_theta == 0.9
    assert settings.global_planner.default_tolerance == 0.3
    world, local = settings.global_costmap, settings.local_costmap
    assert world.static_layer is not None
    assert world.static_layer.map_topic == "/map2"
    assert world.inflation_layer is not None
    assert world.inflation_layer.inflation_radius == 0.7
    assert world.sources["laser"].obstacle_range == 4.0
    assert world.sources["bump"].obstacle_range == 1.0
    assert local.static_layer is None
    assert local.inflation_layer is not None
    assert local.inflation_layer.inflation_radius == 0.4
    assert local.sources["scan"].sensor_frame == "laser"
    assert local.sources["scan"].obstacle_range == 3.5
    assert NavigationStack(settings).global_costmap.footprint.inscribed_radius == pytest.approx(0.21)


def test_wrong_parameters_are_named() -> None:
    values = {
        "planer_frequency": 2.0,
        "controller_frequency": -1.0,
        "global_costmap": 3,
        "local_costmap": {"plugins": [{"name": "x", "type": "my::Layer"}]},
        "recovery_behaviors": [{"name": "dance", "type": "dance/Dance"}],
        "TrajectoryPlannerROS": {"max_vel_x": "fast"},
    }
    _, problems = read_settings(values)
    texts = "\n".join(problem.text for problem in problems)
    assert "planer_frequency; did you mean ~planner_frequency?" in texts
    assert "controller_frequency: expected a number above 0" in texts
    assert "~global_costmap must be a namespace" in texts
    assert "my::Layer" in texts
    assert "dance/Dance" in texts
    assert "~TrajectoryPlannerROS/max_vel_x is 'fast', must be a number" in texts


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("footprint", "[[0.2, 0.2], [0.2", "footprint: expected [[x, y], ...]"),
        ("footprint", "[[1, 0], [2, 0], [2, 1]]", "footprint: expected a polygon around the robot's centre"),
        ("robot_radius", -1.0, "robot_radius: expected metres above 0"),
        ("footprint_padding", -1.0, "robot_radius: expected metres above 0"),
        ("resolution", 1e-9, "expected at most 100000000 cells"),
        ("width", 1e9, "expected at most 100000000 cells"),
    ],
)
def test_wrong_costmaps_are_told_and_the_node_starts(name: str, value: object, words: str) -> None:
    settings, problems = read_settings({"local_costmap": {name: value}})
    assert [(words in one.text, f"~local_costmap/{name}" in one.text) for one in problems] == [(True, True)]
    usual, _ = read_settings({"local_costmap": {}})
    assert settings == usual
    NavigationStack(settings)


def test_time_that_jumps_back_does_not_stop_planning() -> None:
    robot = Robot(MoveBaseParameters())
    robot.core.start(robot.now)
    robot.run(1.0)
    robot.now = 5.0
    robot.costs.values[8:12, 20:22] = LETHAL
    robot.run(1.0)
    assert robot.plans >= 2
    assert robot.run(30.0).ending is Ending.SUCCEEDED


def test_time_that_jumps_back_restarts_a_recovery() -> None:
    """A behavior that waits would wait until the time before comes again."""
    robot = Robot(MoveBaseParameters(planner_timeout=0.5), [Wait("wait", 2.0)])
    robot.plan = NO_WAY
    robot.core.start(robot.now)
    robot.run(1.5)
    assert robot.state() is State.RECOVERING
    robot.now = 5.0
    assert robot.run(10.0).ending is Ending.ABORTED
