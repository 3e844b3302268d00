"""The local planner: limits in every step, no contact, goals, blocked ways."""

from __future__ import annotations

from math import atan2, cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.planners.local_parameters import LocalPlannerParameters
from rce_fleet.navigation.planners.local_planner import ControlStep, Following, LocalPlanner
from rce_fleet.navigation.planners.path_follower import TrackedPath
from rce_fleet.navigation.planners.trajectories import free_steps, roll_out

DT = 0.1
LIMITS = LocalPlannerParameters(max_vel_x=0.6, max_vel_theta=1.5, acc_lim_x=1.0, acc_lim_theta=4.0)
DISC = Footprint(0.2)
NOTHING = np.empty((0, 2))


def path_to(*points: tuple[float, float], yaw: float = 0.0) -> np.ndarray:
    """Return a path of poses 5 cm apart along straight lines."""
    corners = np.array(points)
    lengths = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    at = np.linspace(0.0, lengths[-1], max(2, int(lengths[-1] / 0.05)))
    x, y = (np.interp(at, lengths, corners[:, axis]) for axis in (0, 1))
    yaws = np.append(np.arctan2(np.diff(y), np.diff(x)), yaw)
    return np.stack((x, y, yaws), axis=1)


def drive(
    planner: LocalPlanner, pose: Pose, obstacles: np.ndarray, steps: int = 400
) -> list[tuple[Pose, ControlStep]]:
    """Drive a robot that does what it is told, exactly; check the limits in every step."""
    limits, twist = planner.parameters, Twist()
    driven = []
    for _ in range(steps):
        step = planner.step(pose, twist, obstacles, DT)
        assert abs(step.twist.speed - twist.speed) <= limits.acc_lim_x * DT + 1e-9
        assert abs(step.twist.turn_rate - twist.turn_rate) <= limits.acc_lim_theta * DT + 1e-9
        assert 0.0 <= step.twist.speed <= limits.max_vel_x + 1e-9
        assert abs(step.twist.turn_rate) <= limits.max_vel_theta + 1e-9
        twist = step.twist
        for _ in range(10):
            middle = pose.yaw + twist.turn_rate * DT / 20
            pose = Pose(
                pose.x + twist.speed * DT / 10 * cos(middle),
                pose.y + twist.speed * DT / 10 * sin(middle),
                wrap(pose.yaw + twist.turn_rate * DT / 10),
            )
            if len(obstacles):
                assert np.hypot(*(obstacles - (pose.x, pose.y)).T).min() >= 0.2 - 1e-3
        driven.append((pose, step))
        if step.following is Following.REACHED:
            break
    return driven


@pytest.mark.parametrize("sampling", ["pursuit", "window"])
def test_the_robot_reaches_the_goal_with_its_heading(sampling: str) -> None:
    limits = LocalPlannerParameters(
        max_vel_x=0.6, max_vel_theta=1.5, acc_lim_x=1.0, acc_lim_theta=4.0, sampling=sampling
    )
    planner = LocalPlanner(limits, DISC)
    planner.follow(path_to((0, 0), (2, 0), (2, 1.5), yaw=pi))
    pose, step = drive(planner, Pose(0.0, 0.0, 2.0), NOTHING)[-1]
    assert step.following is Following.REACHED
    assert hypot(pose.x - 2.0, pose.y - 1.5) <= limits.xy_goal_tolerance
    assert abs(wrap(pose.yaw - pi)) <= limits.yaw_goal_tolerance


@pytest.mark.slow
@given(
    st.floats(-pi, pi),
    st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=3),
    st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), max_size=12),
)
@settings(max_examples=15, deadline=None)
def test_limits_hold_and_nothing_is_touched(
    yaw: float, corners: list[tuple[float, float]], obstacles: list[tuple[float, float]]
) -> None:
    """Whatever the path and the obstacles: the checks are in drive()."""
    points = np.array(obstacles).reshape(-1, 2)
    points = points[np.hypot(*points.T) > 0.3]
    planner = LocalPlanner(LIMITS, DISC)
    planner.follow(path_to((0.0, 0.0), *corners, (1.0, 1.0), yaw=0.3))
    drive(planner, Pose(0.0, 0.0, yaw), points, steps=120)


def test_a_wall_across_stops_the_robot() -> None:
    wall = np.stack((np.full(41, 1.0), np.linspace(-1, 1, 41)), axis=1)
    planner = LocalPlanner(LIMITS, DISC)
    planner.follow(path_to((0, 0), (3, 0)))
    pose, step = drive(planner, Pose(0.0, 0.0, 0.0), wall, steps=80)[-1]
    assert step.following is Following.BLOCKED
    assert step.twist == Twist()
    assert 0.5 < pose.x <= 0.8


def test_the_robot_goes_on_when_the_way_is_free() -> None:
    person = np.array(((0.9, 0.0), (0.9, 0.1), (0.9, -0.1)))
    planner = LocalPlanner(LIMITS, DISC)
    planner.follow(path_to((0, 0), (2, 0)))
    pose, step = drive(planner, Pose(0.0, 0.0, 0.0), person, steps=60)[-1]
    assert step.following is not Following.REACHED
    assert drive(planner, pose, NOTHING)[-1][1].following is Following.REACHED


def test_the_robot_leaves_an_obstacle_that_it_touches() -> None:
    planner = LocalPlanner(LIMITS, DISC)
    planner.follow(path_to((0, 0), (1, 0)))
    behind = np.array(((-0.195, 0.0),))
    assert planner.step(Pose(0.0, 0.0, 0.0), Twist(), behind, DT).twist.speed > 0


def test_a_gap_that_the_footprint_fits_is_driven() -> None:
    """50 cm between two posts, for a disc of 40 cm that keeps 2 cm."""
    posts = np.array([(1.0, side * (0.25 + i * 0.05)) for side in (-1, 1) for i in range(10)])
    planner = LocalPlanner(LIMITS, DISC)
    planner.follow(path_to((0, 0.3), (0.6, 0.0), (1.4, 0.0), (2, 0)))
    assert drive(planner, Pose(0.0, 0.3, 0.0), posts)[-1][1].following is Following.REACHED


def test_a_plank_turns_only_where_it_has_room() -> None:
    plank = Footprint(corners=((0.4, 0.1), (-0.4, 0.1), (-0.4, -0.1), (0.4, -0.1)))
    planner = LocalPlanner(LIMITS, plank)
    walls = np.array([(x, side * 0.2) for x in np.linspace(-1, 1, 41) for side in (-1, 1)])
    planner.follow(path_to((0, 0), (-1, 0)))
    step = planner.step(Pose(0.0, 0.0, 0.0), Twist(), walls, DT)
    assert step.following is Following.BLOCKED
    assert step.twist == Twist()


def test_a_stage_that_braked_is_followed() -> None:
    """Speeds begin at the measured ones if these are far below the last command."""
    planner = LocalPlanner(LIMITS, DISC)
    planner.follow(path_to((0, 0), (5, 0)))
    for _ in range(6):
        planner.step(Pose(0.0, 0.0, 0.0), Twist(0.5, 0.0), NOTHING, DT)
    assert planner.step(Pose(0.0, 0.0, 0.0), Twist(0.0, 0.0), NOTHING, DT).twist.speed <= 0.1 + 1e-9


def test_without_a_path_the_robot_brakes() -> None:
    planner = LocalPlanner(LIMITS, DISC)
    planner.follow(path_to((0, 0), (5, 0)))
    for _ in range(10):
        step = planner.step(Pose(0.0, 0.0, 0.0), Twist(0.6, 0.0), NOTHING, DT)
    planner.follow(np.empty((0, 3)))
    assert planner.step(Pose(0.0, 0.0, 0.0), step.twist, NOTHING, DT).twist.speed == pytest.approx(
        step.twist.speed - 0.1
    )


@pytest.mark.parametrize("name", ["max_vel_x", "acc_lim_x", "xy_goal_tolerance"])
def test_a_limit_that_is_not_positive_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected a number above 0"):
        LocalPlannerParameters(**{name: 0.0})  # type: ignore[arg-type] # by name


def test_progress_on_a_path_that_crosses_itself_does_not_jump() -> None:
    path = TrackedPath(path_to((0, 0), (2, 0), (2, 1), (1, 1), (1, -1)))
    for x in np.linspace(0, 1, 11):
        path.advance(float(x), 0.0, 0.5)
    assert path.progress == pytest.approx(1.0, abs=0.05)


@given(st.floats(-0.6, 0.6), st.floats(-1.5, 1.5), st.floats(-0.6, 0.6), st.floats(-1.5, 1.5))
def test_roll_outs_equal_small_steps(v0: float, w0: float, v: float, w: float) -> None:
    poses, driven = roll_out(
        Pose(1.0, 2.0, 0.5), Twist(v0, w0), np.array((v,)), np.array((w,)), (1.0, 4.0), (40, 0.025)
    )
    x, y, yaw, speed, turn, length = 1.0, 2.0, 0.5, v0, w0, 0.0
    for _ in range(1000):
        speed += float(np.clip(v - speed, -0.001, 0.001))
        turn += float(np.clip(w - turn, -0.004, 0.004))
        x, y, yaw = x + speed * 0.001 * cos(yaw), y + speed * 0.001 * sin(yaw), yaw + turn * 0.001
        length += abs(speed) * 0.001
    assert poses[0, -1] == pytest.approx([x, y, yaw], abs=0.01)
    assert driven[0, -1] == pytest.approx(length, abs=0.01)
    assert atan2(sin(yaw), cos(yaw)) == pytest.approx(wrap(float(poses[0, -1, 2])), abs=0.01)


def test_free_steps_end_at_the_first_nearer_pose() -> None:
    clear = np.array(((0.5, 0.3, 0.01, 0.5), (0.5, 0.5, 0.5, 0.5), (0.04, 0.03, 0.05, 0.5)))
    assert free_steps(clear, 0.05, 1.0).tolist() == [2, 4, 0]
    assert free_steps(clear[2:], 0.05, 0.03).tolist() == [4]
