"""Which recovery behaviors move_base tries, and when it begins with the first one again."""

from __future__ import annotations

import numpy as np

from rce_fleet.navigation.costmap.costs import LETHAL
from rce_fleet.navigation.move_base.core import Ending
from rce_fleet.navigation.move_base.parameters import MoveBaseParameters
from rce_fleet.navigation.move_base.recovery import BackUp, Wait

from .test_move_base_core import DISC, HERE, LIMITS, NO_WAY, Noted, Robot


def test_recovery_behaviors_are_tried_in_order_then_it_gives_up() -> None:
    order: list[str] = []
    robot = Robot(MoveBaseParameters(planner_timeout=1.0), [Noted("a", order), Noted("b", order)])
    robot.plan = NO_WAY
    robot.core.start(robot.now)
    decision = robot.run(60.0)
    assert order == ["a", "b"]
    assert decision.ending is Ending.ABORTED
    assert "recovery behaviors did not help" in decision.text
    assert robot.core.recovered == 2


def test_a_robot_without_valid_commands_recovers() -> None:
    order: list[str] = []
    robot = Robot(MoveBaseParameters(controller_timeout=1.0), [Noted("a", order)])
    robot.obstacles = np.array([(1.25, y) for y in np.linspace(0, 2, 41)])
    robot.core.start(robot.now)
    robot.run(2.0)
    assert order == ["a"]
    robot.obstacles = np.empty((0, 2))
    assert robot.run(30.0).ending is Ending.SUCCEEDED


def test_an_oscillating_robot_recovers() -> None:
    order: list[str] = []
    robot = Robot(MoveBaseParameters(oscillation_timeout=3.0), [Noted("a", order)])
    robot.core.start(robot.now)
    for _ in range(40):
        robot.pose = HERE  # it slips
        robot.step()
    assert order == ["a"]


def test_recovery_can_be_turned_off() -> None:
    order: list[str] = []
    parameters = MoveBaseParameters(planner_timeout=1.0, recovery_behavior_enabled=False)
    robot = Robot(parameters, [Noted("a", order)])
    robot.plan = NO_WAY
    robot.core.start(robot.now)
    assert robot.run(10.0).ending is Ending.ABORTED
    assert order == []


def test_backing_up_does_not_begin_recovery_anew() -> None:
    robot = Robot(
        MoveBaseParameters(planner_timeout=1.0, oscillation_distance=0.2),
        [BackUp("back_up", LIMITS, DISC, distance=0.3), Wait("wait", 0.5)],
    )
    robot.plan = NO_WAY
    robot.core.start(robot.now)
    assert robot.run(60.0).ending is Ending.ABORTED
    assert robot.core.recovered == 2


def test_returning_to_an_obstacle_does_not_begin_recovery_anew() -> None:
    robot = Robot(
        MoveBaseParameters(controller_timeout=1.0, oscillation_distance=0.2),
        [BackUp("back_up", LIMITS, DISC, distance=0.5), Wait("wait", 0.5)],
    )
    robot.obstacles = np.array([(2.0, y) for y in np.linspace(0, 2, 41)])
    robot.core.start(robot.now)
    assert robot.run(120.0).ending is Ending.ABORTED
    assert robot.core.recovered == 2


def test_a_robot_that_drives_on_has_all_recoveries_again() -> None:
    order: list[str] = []
    robot = Robot(MoveBaseParameters(planner_timeout=1.0), [Noted("a", order), Noted("b", order)])
    robot.plan = NO_WAY
    robot.core.start(robot.now)
    robot.run(1.5)
    robot.plan = None
    robot.run(3.0)
    assert robot.pose.x > HERE.x + 0.5
    robot.plan = NO_WAY
    robot.costs.values[8:12, 28:30] = LETHAL
    robot.obstacles = np.array([(2.9, y) for y in np.linspace(0, 2, 41)])
    assert robot.run(120.0).ending is Ending.ABORTED
    assert order == ["a", "a", "b"]
