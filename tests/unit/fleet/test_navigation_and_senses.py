"""Navigation, lidar, odometry and the simulated world."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, hypot, inf, pi, sin

import numpy as np
import numpy.typing as npt
import pymunk
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.coordination.move_client import GoalState
from rce_fleet.drivers.cell_watch import grid_of
from rce_fleet.exceptions import OccupiedError
from rce_fleet.geometry.angles import quaternion_z, wrap, yaw_of
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.navigation import DriveLimits, Navigator
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.boxes import BoxKeeper
from rce_fleet.simulation.lidar import LidarSpec, cast
from rce_fleet.simulation.models import RobotModel
from rce_fleet.simulation.move_base import SimulatedMoveBase
from rce_fleet.simulation.obstacles import blocked_cell, cells_ahead, clear_ahead, hit_points
from rce_fleet.simulation.world import World
from rce_fleet.simulation.world_spec import WorldSpec

NOTHING = np.empty((0, 2))


@given(st.floats(-100, 100))
def test_directions_survive_wrapping_and_quaternions(angle: float) -> None:
    assert -pi < wrap(angle) <= pi
    assert cos(wrap(angle)) == pytest.approx(cos(angle), abs=1e-9)
    z, w = quaternion_z(angle)
    assert sin(yaw_of(0.0, 0.0, z, w)) == pytest.approx(sin(angle), abs=1e-9)


# Navigation


def drive(
    navigator: Navigator, pose: Pose, seconds: float, clear: Callable[[Pose], float] = lambda _pose: inf
) -> list[Pose]:
    """Perfect wheels, 50 steps a second."""
    dt, poses = 0.02, [pose]
    for _ in range(int(seconds / dt)):
        twist = navigator.update(pose, dt, clear(pose))
        yaw = pose.yaw + twist.turn_rate * dt
        pose = Pose(pose.x + twist.speed * cos(yaw) * dt, pose.y + twist.speed * sin(yaw) * dt, wrap(yaw))
        poses.append(pose)
    return poses


@settings(max_examples=50, deadline=None)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-pi, pi))
def test_a_robot_gets_to_its_waypoint_and_stands(x: float, y: float, yaw: float) -> None:
    navigator = Navigator()
    navigator.follow([(x, y)])
    end = drive(navigator, Pose(0.0, 0.0, yaw), 14.0)[-1]
    assert navigator.done
    beside = 3 * DriveLimits().reach
    # A waypoint close by, already beside the robot or behind it, counts as reached.
    assert hypot(end.x - x, end.y - y) < (beside if hypot(x, y) < beside else 0.06)


def test_a_robot_keeps_within_its_limits_and_to_its_line() -> None:
    limits = DriveLimits()
    navigator = Navigator(limits)
    navigator.follow([(2.0, 0.0), (2.0, 2.0), (0.0, 2.0)])
    last, pose = Twist(), Pose(0.0, 0.0, pi / 2)
    for _ in range(1000):
        twist = navigator.update(pose, 0.02)
        assert 0 <= twist.speed <= limits.speed
        assert abs(twist.turn_rate) <= limits.turn_rate
        assert abs(twist.speed - last.speed) <= limits.acceleration * 0.02 + 1e-9
        assert abs(twist.turn_rate - last.turn_rate) <= limits.turn_acceleration * 0.02 + 1e-9
        yaw = pose.yaw + twist.turn_rate * 0.02
        pose, last = (
            Pose(pose.x + twist.speed * cos(yaw) * 0.02, pose.y + twist.speed * sin(yaw) * 0.02, yaw),
            twist,
        )
        beside = min(abs(pose.y), abs(pose.x - 2.0), abs(pose.y - 2.0))
        assert beside < 0.1
    assert navigator.done


def test_a_goal_farther_on_is_driven_to_without_stopping() -> None:
    navigator = Navigator()
    navigator.follow([(2.0, 0.0)])
    poses = drive(navigator, Pose(0.0, 0.0, 0.0), 1.5)
    navigator.follow([(4.0, 0.0)])
    speeds = [navigator.update(poses[-1], 0.02).speed for _ in range(5)]
    assert min(speeds) > 0.7


def test_a_robot_stops_before_an_obstacle() -> None:
    navigator = Navigator()
    navigator.follow([(4.0, 0.0)])
    end = drive(navigator, Pose(0.0, 0.0, 0.0), 8.0, clear=lambda pose: 2.0 - 0.22 - pose.x)[-1]
    assert 1.6 < end.x + 0.22 < 2.0


def test_a_stopped_robot_brakes_softly() -> None:
    navigator = Navigator()
    navigator.follow([(4.0, 0.0)])
    pose = drive(navigator, Pose(0.0, 0.0, 0.0), 2.0)[-1]
    navigator.stop()
    end = drive(navigator, pose, 2.0)[-1]
    assert navigator.done
    assert 0.2 < end.x - pose.x < 0.5


# Lidar


def oracle(world: World, spec: LidarSpec, seer: str) -> npt.NDArray[np.float64]:
    """The same scan, beam by beam with pymunk."""
    robot = world.robots[seer]
    pose = robot.pose
    mask = pymunk.ShapeFilter(categories=1)
    robot.shape.filter = mask
    seen = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ 1)
    ranges = np.full(spec.beams, spec.max_range)
    for beam, angle in enumerate(spec.angles() + pose.yaw):
        end = (pose.x + spec.max_range * cos(angle), pose.y + spec.max_range * sin(angle))
        hit = world.space.segment_query_first((pose.x, pose.y), end, 0.0, seen)
        if hit is not None:
            ranges[beam] = hit.alpha * spec.max_range
    robot.shape.filter = pymunk.ShapeFilter()
    return ranges


@pytest.mark.parametrize("seed", range(6))
def test_the_lidar_sees_what_pymunk_sees(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = [int(cell) for cell in rng.choice(64, 14, replace=False)]
    spec = WorldSpec(model=RobotModel(sensors={"lidar": LidarSpec(beams=180, noise=0.0)}))
    world = World(GridMap(blocked=frozenset(cells[:4])), spec, seed=seed)
    for number, cell in enumerate(cells[4:8]):
        world.add_robot(f"R{number}", cell, float(rng.uniform(-pi, pi)))
    for cell in cells[8:]:
        world.add_box(cell)
    world.space.reindex_static()
    ranges = np.minimum(world.scan("R0"), spec.model.lidar.max_range)
    expected = oracle(world, spec.model.lidar, "R0")
    # At a corner rounding decides whether a beam just hits or just misses.
    assert np.count_nonzero(np.abs(ranges - expected) > 1e-6) <= 2


@settings(max_examples=60)
@given(st.floats(-pi, pi), st.floats(-pi, pi), st.floats(0.3, 4))
def test_a_disc_is_seen_where_it_is(yaw: float, bearing: float, away: float) -> None:
    spec = LidarSpec(noise=0.0)
    circle = np.array([[1.0 + away * cos(bearing), 2.0 + away * sin(bearing), 0.2]])
    ranges = cast(spec, (1.0, 2.0), yaw, np.empty((0, 4)), circle)
    nearest = int(ranges.argmin())
    assert ranges[nearest] == pytest.approx(away - 0.2, abs=0.01)
    assert abs(wrap(spec.angles()[nearest] + yaw - bearing)) <= spec.increment


def test_edges_behind_and_far_away_are_not_seen() -> None:
    spec = LidarSpec(beams=8, max_range=2.0)
    segments = np.array([[1.0, -1.0, 1.0, 1.0], [-5.0, -1.0, -5.0, 1.0]])
    ranges = cast(spec, (0.0, 0.0), 0.0, segments, np.empty((0, 3)))
    assert ranges[4] == pytest.approx(1.0)
    assert ranges[[0, 1, 2, 6, 7]].tolist() == [2.0] * 5


# Obstacles


def test_the_cells_ahead_are_those_on_the_line() -> None:
    grid = GridMap()
    assert cells_ahead(grid, Pose(0.5, 0.5, 0.0), grid.centre(3)) == [1, 2, 3]
    assert cells_ahead(grid, Pose(3.5, 3.4, 0.0), grid.centre(3)) == [19, 11, 3]
    assert cells_ahead(grid, Pose(0.5, 0.5, 0.0), (0.52, 0.5)) == []


def test_a_box_ahead_is_found_and_a_robot_beside_the_cell_is_not() -> None:
    grid = GridMap()
    pose, goal = Pose(0.7, 0.5, 0.0), grid.centre(3)
    box = np.array([[1.2, y] for y in np.linspace(0.2, 0.8, 7)])
    assert blocked_cell(grid, box, pose, goal, sight=1.2, margin=0.15) == 1
    rim = np.array([[x, 0.95] for x in np.linspace(1.2, 1.8, 7)])
    assert blocked_cell(grid, rim, pose, goal, sight=1.2, margin=0.15) is None
    assert blocked_cell(grid, box + np.array((2.0, 0.0)), pose, goal, sight=1.2, margin=0.15) is None
    assert blocked_cell(grid, NOTHING, pose, goal, sight=1.2, margin=0.15) is None


def test_a_corner_of_a_turned_cell_is_inside_of_it() -> None:
    grid = GridMap(3, 3, yaw=0.6)
    corner = np.array([grid.point(1.83, column) for column in (1.81, 1.82, 1.83)])
    pose, goal = Pose(*grid.centre(3), grid.yaw), grid.centre(5)
    assert blocked_cell(grid, corner, pose, goal, sight=2.0, margin=0.15) == 4
    assert blocked_cell(grid, corner, pose, goal, sight=2.0, margin=0.2) is None


def test_the_way_ahead_is_measured_from_the_hull() -> None:
    points = np.array([[2.0, 0.1], [1.0, 0.5], [-1.0, 0.0]])
    assert clear_ahead(points, Pose(0.0, 0.0, 0.0), 0.22) == pytest.approx(1.78)
    assert clear_ahead(points, Pose(0.0, 0.0, pi / 2), 0.22) == inf


# move_base


class Bench:
    """A robot and its move_base in an empty world."""

    def __init__(self) -> None:
        self.world = World(GridMap())
        self.robot = self.world.add_robot("R", 0)
        self.base = SimulatedMoveBase(self.world.grid, self.robot.radius)
        self.ended: dict[str, GoalState] = {}

    def run(self, seconds: float) -> None:
        for _ in range(int(seconds / 0.05)):
            self.world.step(0.05)
            pose = self.robot.estimate
            points = hit_points(self.robot.model.lidar, self.world.scan("R"), pose)
            self.robot.drive(self.base.update(self.world.time, pose, points))
            self.ended.update({goal.id: goal.state for goal in self.base.take_ended()})


def test_a_goal_is_reached_and_forgotten_in_time() -> None:
    bench = Bench()
    bench.base.accept("a", 1.0, 2.5, 0.5)
    bench.base.accept("a", 1.0, 6.5, 0.5)
    bench.run(5.0)
    assert bench.ended == {"a": GoalState.SUCCEEDED}
    assert bench.robot.pose.x == pytest.approx(2.5, abs=0.08)
    assert [goal.id for goal in bench.base.goals] == ["a"]
    bench.run(6.0)
    assert bench.base.goals == []


def test_a_new_goal_replaces_the_old_one() -> None:
    bench = Bench()
    bench.base.accept("a", 1.0, 2.5, 0.5)
    bench.run(1.0)
    bench.base.accept("b", 2.0, 3.5, 0.5)
    bench.run(6.0)
    assert bench.ended == {"a": GoalState.PREEMPTED, "b": GoalState.SUCCEEDED}


@pytest.mark.parametrize(("goal_id", "stamp"), [("a", 0.0), ("", 0.0), ("", 1.0), ("other", 5.0)])
def test_a_cancelled_goal_ends_when_the_robot_stands(goal_id: str, stamp: float) -> None:
    bench = Bench()
    bench.base.accept("a", 1.0, 5.5, 0.5)
    bench.run(2.0)
    bench.base.cancel(goal_id, stamp)
    bench.run(0.1)
    assert bench.ended == {}, "it is still braking"
    bench.run(2.0)
    assert bench.ended == {"a": GoalState.PREEMPTED}
    assert bench.robot.twist.speed == pytest.approx(0.0, abs=1e-6)


def test_a_cancellation_of_something_else_changes_nothing() -> None:
    bench = Bench()
    bench.base.accept("a", 3.0, 1.5, 0.5)
    bench.base.cancel("b", 2.0)
    bench.run(4.0)
    assert bench.ended == {"a": GoalState.SUCCEEDED}


def test_a_goal_older_than_a_cancellation_is_recalled() -> None:
    bench = Bench()
    bench.base.cancel("", 5.0)
    bench.base.accept("late", 4.9, 1.5, 0.5)
    bench.base.accept("new", 5.1, 1.5, 0.5)
    bench.run(4.0)
    assert bench.ended == {"late": GoalState.RECALLED, "new": GoalState.SUCCEEDED}


def test_a_robot_that_finds_a_box_stops_and_says_where() -> None:
    bench = Bench()
    bench.world.add_box(4)
    bench.base.accept("a", 1.0, 5.5, 0.5)
    bench.run(8.0)
    assert bench.ended == {"a": GoalState.ABORTED}
    assert list(bench.base.blocked) == [4]
    assert bench.world.collisions.total == 0
    bench.base.accept("b", 2.0, 0.5, 0.5)
    assert not bench.base.blocked


# World


def test_time_advances_in_whole_steps() -> None:
    world = World(GridMap())
    robot = world.add_robot("R", 0)
    robot.drive(Twist(1.0, 0.0))
    world.step(0.03)
    assert robot.pose.x == pytest.approx(0.52)
    world.step(0.01)
    assert robot.pose.x == pytest.approx(0.54)
    assert world.time == pytest.approx(0.04)
    world.step()
    assert robot.distance == pytest.approx(0.06)


def test_contacts_are_counted_once_each() -> None:
    world = World(GridMap())
    a, b = world.add_robot("A", 0), world.add_robot("B", 2, pi)
    world.add_box(8)
    a.drive(Twist(0.5, 0.0))
    b.drive(Twist(0.5, 0.0))
    world.step(3.0)
    assert world.collisions.robot_robot == 1
    assert world.min_separation < 0.01
    world.remove_robot("B")
    a.drive(Twist(0.0, pi / 2))
    world.step(1.0)
    a.drive(Twist(0.5, 0.0))
    world.step(1.0)
    assert world.collisions.robot_box == 0
    a.drive(Twist(-0.8, 0.0))
    world.step(3.0)
    assert world.collisions.robot_wall == 1
    assert world.collisions.total == 2


def test_a_robot_that_drives_into_a_box_touches_it() -> None:
    world = World(GridMap())
    world.add_box(1)
    world.add_robot("R", 0).drive(Twist(0.5, 0.0))
    world.step(2.0)
    assert world.collisions.robot_box == 1


def test_box_in_a_robots_cell_is_refused() -> None:
    world = World(GridMap())
    world.add_robot("R", 27)
    with pytest.raises(OccupiedError, match="robot R is in the way"):
        world.add_box(27)
    with pytest.raises(OccupiedError):
        world.add_robot("S", 27)
    with pytest.raises(ValueError, match="R exists already"):
        world.add_robot("R", 3)
    with pytest.raises(ValueError, match="not on the map"):
        world.add_box(64)
    assert world.boxes == ()


def test_boxes_follow_blocked_cells() -> None:
    world = World(GridMap())
    robot = world.add_robot("R", 0)
    world.add_box(9)
    keeper = BoxKeeper(world)
    keeper.follow([0, 1])
    assert list(world.boxes) == [1, 9]
    assert keeper.update() == (0,)
    robot.drive(Twist(0.0, pi / 2))
    world.step(1.0)
    robot.drive(Twist(0.8, 0.0))
    world.step(1.3)
    assert keeper.update() == ()
    assert list(world.boxes) == [0, 1, 9]
    keeper.follow([9])
    assert list(world.boxes) == [9]
    keeper.follow([])
    assert not world.boxes, "a box that was found is taken away when its cell is freed"


def test_boxes_of_another_grid_are_where_its_cells_are() -> None:
    """After a change of the fleet's grid, numbers are those of other places."""
    world = World(GridMap())
    world.add_box(9)
    keeper = BoxKeeper(world)
    keeper.follow([20], GridMap())
    assert list(world.boxes) == [9, 20]
    turned = GridMap(rows=4, columns=4, cell_size=0.5, origin=(6.0, 2.0), yaw=pi / 2)
    keeper.follow([0, 5], turned)
    assert list(world.boxes) == [9], "cell 20 is not a cell of the new grid"
    placed = {name: box for name, box in world.all_boxes.items() if name != "cell_9"}
    assert [(box.pose.x, box.pose.y) for box in placed.values()] == [
        pytest.approx((5.75, 2.25)),
        pytest.approx((5.25, 2.75)),
    ]
    assert {box.width for box in placed.values()} == {0.3}
    assert keeper.update() == ()
    keeper.follow([5], turned)
    assert len(world.all_boxes) == 2
    keeper.follow([5], GridMap())
    assert list(world.boxes) == [5, 9]
    assert len(world.all_boxes) == 2


def test_a_grid_is_told_by_its_layout() -> None:
    grid = GridMap(rows=3, columns=5, cell_size=0.7, origin=(-1.5, 2), blocked=frozenset({4}), yaw=0.3)
    assert GridMap.from_layout(grid.layout) == grid.with_blocked(())
    for text in ("", "cells", "[1]", '{"rows": 3}', grid.layout.replace("0.7", "-1")):
        with pytest.raises(ValueError, match="expected the layout of a grid"):
            GridMap.from_layout(text)
    assert grid_of([]) is None
    assert grid_of(["revision=3"]) is None
    assert grid_of([GridMap().layout]) == GridMap()


def test_the_same_seed_makes_the_same_run() -> None:
    def run(seed: int) -> tuple[Pose, list[float]]:
        world = World(GridMap(), seed=seed)
        robot = world.add_robot("R", 0)
        robot.drive(Twist(0.5, 0.1))
        world.step(2.0)
        return robot.odometry, world.scan("R").tolist()

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_odometry_is_a_little_wrong_and_the_estimate_stays_right() -> None:
    world = World(GridMap(), seed=3)
    robot = world.add_robot("R", 0)
    robot.drive(Twist(0.5, 0.05))
    for _ in range(50):
        world.step(0.1)
        assert hypot(robot.estimate.x - robot.pose.x, robot.estimate.y - robot.pose.y) < 0.06
    error = hypot(robot.odometry.x + 0.5 - robot.pose.x, robot.odometry.y + 0.5 - robot.pose.y)
    assert 1e-4 < error < 0.3
    assert robot.covariance == pytest.approx((1e-4, 1e-4, 1e-4))
