"""Robots without a physics engine move as those in it, steer as a single one, and are judged exactly."""

from __future__ import annotations

from dataclasses import replace
from math import atan2, cos, hypot, inf, pi

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rce_fleet.coordination.move_client import GoalState
from rce_fleet.exceptions import PlaceTakenError
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.navigation import Navigator
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.battery import Battery
from rce_fleet.simulation.drive import DriveSpec
from rce_fleet.simulation.light.batteries import TURTLEBOT_BATTERY, LightBatteries
from rce_fleet.simulation.light.bodies import LightBodies, LightModel
from rce_fleet.simulation.light.contacts import ContactJudge, EdgeRaster
from rce_fleet.simulation.light.robots import HAND_S, TIME_STEP, LightRobots
from rce_fleet.simulation.light.steering import Steering, limits_of
from rce_fleet.simulation.models import RobotModel
from rce_fleet.simulation.noise import EstimateSpec
from rce_fleet.simulation.walls import Block, distances
from rce_fleet.simulation.world import World
from rce_fleet.simulation.world_spec import WorldSpec

NO_EDGES = np.empty((0, 4))
SLIPLESS = DriveSpec(speed=0.65, turn_rate=3.0, acceleration=1.0, deceleration=2.0, turn_acceleration=4.0)
EXACT = LightModel(drive=SLIPLESS, estimate=EstimateSpec(0.0, 0.0))
speeds = st.tuples(st.floats(-1, 1), st.floats(-4, 4))


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(speeds, speeds, st.integers(1, 20)), min_size=1, max_size=6))
def test_free_motion_is_that_of_the_physics_engine(
    drives: list[tuple[tuple[float, float], tuple[float, float], int]],
) -> None:
    world = World(GridMap(40, 40), WorldSpec(model=RobotModel(radius=0.177, drive=SLIPLESS)))
    starts = [Pose(10.0, 20.0, 0.3), Pose(30.0, 20.0, -2.0)]
    for number, start in enumerate(starts):
        world.place_robot(f"Robot{number}", start)
    bodies, dt = LightBodies(starts, EXACT), world.spec.time_step
    for first, second, steps in drives:
        for number, command in enumerate((first, second)):
            world.robots[f"Robot{number}"].drive(Twist(*command))
        for _ in range(steps):
            world.step()
            bodies.step(np.array([first, second]), dt)
    for number, robot in enumerate(world.robots.values()):
        assert bodies.poses[number] == pytest.approx(robot.place, abs=1e-6)
        assert bodies.distances[number] == pytest.approx(robot.distance, abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-3, 3)] * 2, st.floats(-pi, pi)), min_size=1, max_size=5),
    st.tuples(*[st.floats(-3, 3)] * 2),
)
def test_steering_is_that_of_a_single_robot(
    poses: list[tuple[float, float, float]], goal: tuple[float, float]
) -> None:
    limits = limits_of(EXACT)
    one, many = Navigator(limits), Steering(1, limits)
    one.follow([goal])
    many.follow(0, *goal)
    for pose in poses:
        bearing = atan2(goal[1] - pose[1], goal[0] - pose[0])
        assume(cos(bearing - pose[2]) > -1 + 1e-9)  # straight behind, left and right are the same
        wanted = one.update(Pose(*pose), TIME_STEP)
        many.update(np.array([pose]), TIME_STEP)
        assert many.commands[0] == pytest.approx((wanted.speed, wanted.turn_rate), abs=1e-9)
        assert bool(many.driving[0]) is bool(one.waypoints)


def test_robots_reach_their_goals_and_say_so() -> None:
    robots = LightRobots({"Robot1": Pose(0, 0, pi), "Robot2": Pose(5, 5, 0)}, NO_EDGES, seed=1)
    robots.accept(0, "a", 1.0, 3.0, 1.0)
    robots.advance(2.0)
    assert not robots.take_ended()
    robots.accept(0, "b", 2.0, 2.0, 0.0)
    assert robots.take_ended() == [0]
    assert [(goal.id, goal.state) for goal in robots.goal_lists[0].take_ended()] == [
        ("a", GoalState.PREEMPTED)
    ]
    robots.advance(15.0)
    assert robots.take_ended() == [0]
    assert [(goal.id, goal.state) for goal in robots.goal_lists[0].take_ended()] == [
        ("b", GoalState.SUCCEEDED)
    ]
    x, y, _ = robots.bodies.poses[0]
    assert hypot(x - 2.0, y) < 0.15
    assert robots.bodies.poses[1] == pytest.approx((5, 5, 0))


def test_a_cancelled_robot_brakes_and_ends_its_goal() -> None:
    robots = LightRobots({"Robot1": Pose(0, 0, 0)}, NO_EDGES)
    robots.accept(0, "a", 1.0, 9.0, 0.0)
    robots.advance(3.0)
    robots.cancel(0, "", 0.0)
    assert not robots.take_ended()
    robots.advance(2.0)
    assert robots.take_ended() == [0]
    assert robots.goal_lists[0].take_ended()[0].state is GoalState.PREEMPTED
    robots.accept(0, "a", 1.0, 9.0, 0.0)
    before = robots.bodies.poses.copy()
    robots.advance(2.0)
    assert (robots.bodies.poses == before).all()


def test_an_emergency_stop_keeps_the_goal() -> None:
    robots = LightRobots({"Robot1": Pose(0, 0, 0), "Robot2": Pose(0, 5, 0)}, NO_EDGES)
    for row in range(2):
        robots.accept(row, "a", 1.0, 6.0, 5.0 * row)
    robots.advance(4.0)
    before = robots.bodies.poses[0, 0]
    robots.stop(0, stopped=True)
    robots.advance(1.0)
    at, wheels = robots.bodies.poses[0].copy(), robots.model.drive
    assert at[0] - before <= wheels.speed**2 / wheels.deceleration, "it brakes as hard as its wheels can"
    robots.advance(15.0)
    assert (robots.bodies.poses[0] == at).all()
    assert robots.take_ended() == [1]
    robots.stop(0, stopped=False)
    robots.advance(20.0)
    assert robots.take_ended() == [0]
    assert robots.goal_lists[0].take_ended()[0].state is GoalState.SUCCEEDED


def test_driving_by_hand_ends_without_velocities() -> None:
    robots = LightRobots({"Robot1": Pose(0, 0, 0)}, NO_EDGES)
    for _ in range(10):
        robots.drive(0, 0.4, 0.0)
        robots.advance(0.2)
    assert robots.bodies.speeds[0, 0] == pytest.approx(0.4)
    assert robots.bodies.poses[0, 0] > 0.5
    robots.advance(HAND_S + 1.0)
    assert (robots.bodies.speeds[0] == 0.0).all()
    robots.drive(0, inf, 0.3)
    robots.stop(0, stopped=True)
    robots.advance(0.2)
    assert (robots.bodies.speeds[0] == 0.0).all(), "an emergency stop comes first"


def test_a_reset_repeats_the_same_run() -> None:
    robots = LightRobots({"Robot1": Pose(0, 0, 0), "Robot2": Pose(0, 3, 0)}, NO_EDGES, seed=3)
    seen = []
    for _ in range(2):
        robots.accept(1, "a", 1.0, 4.0, 4.0)
        robots.advance(5.0)
        seen.append(robots.bodies.estimates.copy())
        robots.reset()
    assert (seen[0] == seen[1]).all()
    assert robots.time == 0.0


places = st.lists(st.tuples(*[st.floats(0, 4)] * 2), min_size=1, max_size=12)


@settings(max_examples=30, deadline=None)
@given(places, st.lists(st.tuples(*[st.floats(0, 4)] * 4), max_size=8))
def test_touched_edges_are_those_within_the_radius(
    discs: list[tuple[float, float]], ends: list[tuple[float, float, float, float]]
) -> None:
    points, edges = np.array(discs), np.array(ends).reshape(-1, 4)
    radii = np.full(len(points), 0.3)
    found = set(zip(*(each.tolist() for each in EdgeRaster(edges, 1.0).touching(points, radii)), strict=True))
    for number, edge in enumerate(edges):
        apart = distances(points, edge[None, :])
        for disc in range(len(points)):
            if abs(apart[disc] - 0.3) > 1e-6:
                assert ((disc, number) in found) is bool(apart[disc] < 0.3)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        places.filter(lambda found: len(found) >= 6).map(lambda found: found[:6]), min_size=1, max_size=4
    )
)
def test_contacts_of_robots_are_those_of_all_pairs(moments: list[list[tuple[float, float]]]) -> None:
    radii = np.array([0.1, 0.2, 0.3, 0.2, 0.1, 0.25])
    judge = ContactJudge(NO_EDGES, np.empty(0, np.bool_), 1.0)
    before: set[tuple[int, int]] = set()
    count, nearest = 0, inf
    for moment in moments:
        points = np.array(moment)
        judge.update(points, radii)
        apart = {
            (a, b): hypot(*(points[a] - points[b])) - radii[a] - radii[b] for a in range(6) for b in range(a)
        }
        touching = {pair for pair, gap in apart.items() if gap < 0}
        count += len(touching - before)
        before, nearest = touching, min(nearest, *apart.values())
    assert judge.with_robots == count
    assert judge.min_separation == pytest.approx(nearest)


def test_contacts_with_walls_and_boxes_count_once_each() -> None:
    wall, box = Block.rectangle(2, -1, 3, 1), Block.rectangle(-3, -1, -2, 1)
    robots = LightRobots({"Robot1": Pose(0, 0, 0)}, np.array(wall.edges), EXACT)
    robots.set_boxes(np.array(box.edges))
    robots.accept(0, "a", 1.0, 2.5, 0.0)
    robots.advance(10.0)
    assert (robots.judge.with_walls, robots.judge.with_boxes) == (1, 0)
    robots.accept(0, "b", 2.0, -2.5, 0.0)
    robots.advance(15.0)
    assert (robots.judge.with_walls, robots.judge.with_boxes) == (2, 1)  # out through the wall's side


def test_light_robots_share_a_world_with_others() -> None:
    world = World(GridMap(10, 10))
    world.add_robot("Robot1", 55)
    with pytest.raises(PlaceTakenError, match="Robot1"):
        world.add_light_robots({"Robot2": Pose(*world.grid.centre(55), 0.0)})
    world.add_light_robots({"Robot2": Pose(*world.grid.centre(52), 0.0)})
    light = world.light
    assert light is not None
    assert np.isfinite(world.scan("Robot1")).any()
    light.accept(0, "a", 1.0, *world.grid.centre(58))
    world.step(15.0)
    assert light.row("Robot2") == 0
    assert (world.collisions.robot_robot, world.collisions.total) == (1, 1)
    assert world.min_separation < 0
    world.reset()
    assert world.collisions.total == 0
    assert light.pose(0) == Pose(*world.grid.centre(52), 0.0)


def test_a_removed_robot_meets_and_obeys_nothing() -> None:
    """The contacts of the others are counted as before, under their own names."""
    starts = {f"Robot{number}": Pose(2.0 * number, 0, 0) for number in range(1, 5)}
    robots = LightRobots(starts, NO_EDGES, EXACT)
    robots.put(3, Pose(6.3, 0, 0))  # Robot4 and Robot3 touch
    robots.accept(1, "a", 1.0, 9.0, 0.0)
    robots.advance(0.2)
    assert (robots.judge.with_robots, robots.row("Robot2")) == (1, 1)
    robots.remove(1)
    assert (robots.row("Robot2"), len(robots.discs)) == (None, 3)
    assert robots.present_names == {0: "Robot1", 2: "Robot3", 3: "Robot4"}
    before = robots.bodies.poses[1].tolist()
    robots.accept(1, "b", 2.0, 9.0, 0.0)
    robots.advance(1.0)
    robots.drive(1, 0.5, 0.0)
    robots.advance(1.0)
    assert robots.bodies.poses[1].tolist() == before
    robots.accept(0, "a", 1.0, 5.85, 0.0)  # through the place of Robot2, and to Robot3
    robots.advance(12.0)
    assert robots.judge.with_robots == 2
    assert [(contact.robot, contact.other) for contact in robots.contacts[1:]] == [("Robot1", "Robot3")]
    robots.reset()
    robots.accept(1, "c", 3.0, 9.0, 0.0)
    robots.advance(2.0)
    assert (robots.row("Robot2"), robots.bodies.poses[1, 0]) == (None, 4.0)


def test_a_removed_robot_leaves_its_place_free() -> None:
    world = World(GridMap(10, 10))
    place = Pose(*world.grid.centre(52), 0.0)
    light = world.add_light_robots({"Robot1": place})
    with pytest.raises(PlaceTakenError):
        world.place_robot("Robot2", place)
    light.remove(0)
    world.place_robot("Robot2", place)
    world.step(1.0)
    assert world.collisions.total == 0


def test_a_robot_keeps_to_the_limit_of_its_speed() -> None:
    robots = LightRobots({"Slow": Pose(1, 1, 0), "Fast": Pose(1, 3, 0)}, NO_EDGES, EXACT)
    robots.limit_speed(0, 0.2)
    for row, y in enumerate((1.0, 3.0)):
        robots.accept(row, "goal", 0.0, 9.0, y)
    robots.advance(3.0)
    assert robots.twist(0).speed == pytest.approx(0.2, abs=0.01)
    assert robots.twist(1).speed == pytest.approx(0.65, abs=0.01)
    robots.reset()
    robots.accept(0, "again", 0.0, 9.0, 1.0)
    robots.advance(3.0)
    assert robots.twist(0).speed == pytest.approx(0.2, abs=0.01), "programs send a limit only once"
    robots.limit_speed(0, inf)
    robots.advance(2.0)
    assert robots.twist(0).speed == pytest.approx(0.65, abs=0.01)


def test_batteries_are_those_of_single_robots() -> None:
    """One drives, one turns, one stands at a dock until it is full, and one runs empty."""
    spec = replace(TURTLEBOT_BATTERY, capacity=0.09, charge=0.6)
    speeds = np.array([(0.5, 0.0), (0.0, 2.0), (0.0, 0.0), (0.65, 3.0)])
    docked = np.array([False, False, True, True])
    many, single = LightBatteries(4, spec), [Battery(spec) for _ in range(4)]
    for _ in range(12):
        many.step(1.0, speeds, docked)
        for battery, (speed, turn), dock in zip(single, speeds.tolist(), docked.tolist(), strict=True):
            battery.step(1.0, speed, turn, docked=dock and not speed)
    assert many.shares == pytest.approx([battery.share for battery in single])
    assert many.charging.tolist() == [False, False, True, False]
    assert many.shares[2] == 1.0
    assert many.empty.tolist() == [battery.empty for battery in single]
    assert many.empty.tolist() == [False, False, False, True]


def test_a_robot_with_an_empty_battery_stands() -> None:
    model = LightModel(drive=SLIPLESS, battery=replace(TURTLEBOT_BATTERY, capacity=0.02))
    robots = LightRobots({"Robot1": Pose(1.0, 1.0, 0.0)}, NO_EDGES, model)
    robots.accept(0, "goal", 0.0, 40.0, 1.0)
    robots.advance(30.0)
    x = robots.pose(0).x
    robots.advance(10.0)
    assert robots.batteries.empty[0]
    assert (robots.twist(0).speed, robots.pose(0).x) == (0.0, x)
