"""Goals at places that are not finite numbers, as a program with a faulty computation sends them."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest

from rce_fleet.coordination.move_client import GoalState
from rce_fleet.drivers.stand_in import status_of
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.light.robots import LightRobots


@pytest.mark.parametrize(("x", "y"), [(nan, 1.0), (1.0, nan), (inf, 1.0), (1.0, -inf)])
def test_light_robot_rejects_a_goal_that_is_not_finite(x: float, y: float) -> None:
    """It was reported as reached at once; the robot continues to the goal that it had."""
    robots = LightRobots({"Robot1": Pose(1.0, 1.0, 0.0)}, np.empty((0, 4)))
    robots.accept(0, "good", 1.0, 3.0, 1.0)
    robots.advance(0.2)
    robots.accept(0, "bad", 2.0, x, y)
    robots.advance(0.2)
    assert robots.take_ended() == [0]
    (ended,) = robots.goal_lists[0].take_ended()
    told: dict[str, Any] = status_of(ended)
    assert (ended.id, told["status"]) == ("bad", GoalState.REJECTED.value)
    assert "target_pose.pose.position" in told["text"]
    robots.advance(20.0)
    assert robots.take_ended() == [0]
    assert [(goal.id, goal.state) for goal in robots.goal_lists[0].take_ended()] == [
        ("good", GoalState.SUCCEEDED)
    ]
    assert robots.pose(0).x == pytest.approx(3.0, abs=0.2)
