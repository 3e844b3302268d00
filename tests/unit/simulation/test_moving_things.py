"""Doors, walkers, timed boxes, contacts and new beginnings of the simulated world."""

from __future__ import annotations

from math import hypot, pi

import numpy as np
import pytest

from rce_fleet.exceptions import PlaceTakenError
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.box import BoxSpec
from rce_fleet.simulation.doors import DoorSpec
from rce_fleet.simulation.drive import DriveSpec
from rce_fleet.simulation.models import RobotModel
from rce_fleet.simulation.walkers import WalkerSpec
from rce_fleet.simulation.world import World
from rce_fleet.simulation.world_spec import WorldSpec


def test_a_door_opens_and_closes_in_time() -> None:
    world = World(GridMap())
    door = world.add_door("door", DoorSpec(3.0, 4.0, seconds=1.0, times=(1.0, 3.0), period=5.0))
    seen = []
    for _ in range(70):
        world.step(0.1)
        seen.append((round(world.time, 1), round(door.opening, 1)))
    openings = dict(seen)
    assert (openings[1.0], openings[1.5], openings[2.1]) == (0.0, 0.5, 1.0)
    assert (openings[3.5], openings[4.1], openings[6.5]) == (0.5, 0.0, 0.5)
    assert door.block.distance(3.0, 4.5) < 0.05, "it swings to the left"


def test_a_door_waits_for_a_robot_in_its_way() -> None:
    world = World(GridMap())
    door = world.add_door("door", DoorSpec(3.0, 4.0, seconds=1.0, open=True))
    robot = world.place_robot("R", Pose(3.6, 4.4, 0.0))
    door.wanted = False
    world.step(3.0)
    assert door.held
    assert 0.2 < door.opening < 0.9
    assert world.collisions.total == 0
    robot.drive(Twist(0.8))
    world.step(2.0)
    assert (door.held, door.opening) == (False, 0.0)


def test_a_sliding_door_clears_its_opening() -> None:
    world = World(GridMap())
    door = world.add_door("door", DoorSpec(3.0, 4.0, swing=0.0, width=1.0, seconds=1.0))
    assert door.block.distance(3.5, 4.0) == 0.0
    door.wanted = True
    world.step(1.5)
    assert door.block.distance(3.5, 4.0) == pytest.approx(0.5)


def test_a_door_is_seen_where_it_is() -> None:
    world = World(GridMap())
    world.place_robot("R", Pose(3.5, 3.0, pi / 2))
    door = world.add_door("door", DoorSpec(3.0, 4.0, seconds=1.0))
    assert world.scan("R")[180] == pytest.approx(0.975, abs=0.05)
    door.wanted = True
    world.step(1.5)
    assert world.scan("R")[180] == pytest.approx(5.0, abs=0.05)


@pytest.mark.parametrize(
    ("loop", "place"), [(True, (1.0, 2.0)), (False, (2.0, 1.0))], ids=["loop", "back and forth"]
)
def test_a_walker_walks_from_waypoint_to_waypoint(loop: bool, place: tuple[float, float]) -> None:
    spec = WalkerSpec(((1.0, 1.0), (3.0, 1.0), (3.0, 3.0), (1.0, 3.0)), speed=1.0, loop=loop)
    world = World(GridMap())
    walker = world.add_walker("P", spec)
    world.step(2.5)
    assert walker.position == pytest.approx((3.0, 1.5), abs=0.1)
    world.step(7.0 if not loop else 4.5)
    world.step(1.5 if not loop else 0.0)
    assert walker.position == pytest.approx(place, abs=0.2)


def test_a_polite_walker_waits_for_a_robot() -> None:
    world = World(GridMap())
    spec = WalkerSpec(((1.0, 1.0), (5.0, 1.0)), social_distance=0.5, loop=False)
    walker = world.add_walker("P", spec)
    robot = world.place_robot("R", Pose(3.0, 1.0, pi / 2))
    world.step(5.0)
    waits_for_robot = walker.waits
    assert waits_for_robot
    assert walker.position[0] == pytest.approx(3.0 - 0.22 - 0.2 - 0.5, abs=0.05)
    assert world.collisions.total == 0
    robot.drive(Twist(0.8))
    world.step(3.0)
    waits_for_robot = walker.waits
    assert not waits_for_robot
    assert walker.position[0] > 3.0


def test_a_walker_turns_back_when_patience_ends() -> None:
    world = World(GridMap())
    spec = WalkerSpec(((1.0, 1.0), (5.0, 1.0)), social_distance=0.5, loop=False, patience=1.0)
    walker = world.add_walker("P", spec)
    world.place_robot("R", Pose(3.0, 1.0, pi / 2))
    world.step(1.5)  # it waits since 0.9 s
    assert walker.waits
    before = walker.position[0]
    world.step(1.0)
    assert walker.position[0] < before - 0.3
    assert world.collisions.total == 0


def test_a_contact_tells_whose_motion_caused_it() -> None:
    world = World(GridMap())
    world.add_walker("P", WalkerSpec(((1.0, 1.0), (5.0, 1.0))))
    robot = world.place_robot("R", Pose(3.0, 1.0, pi / 2))
    world.step(2.0)
    assert (world.collisions.robot_walker, world.collisions.own_motion) == (1, 0)
    robot.put(Pose(3.0, 4.0, pi / 2))
    robot.drive(Twist(0.8))
    world.step(8.0)
    assert (world.collisions.robot_wall, world.collisions.own_motion) == (1, 1)


def test_a_robot_at_a_wall_touches_it_once_and_leaves() -> None:
    world = World(GridMap())
    robot = world.add_robot("R", 0, -pi / 2)
    robot.drive(Twist(0.65, 0.3))
    world.step(5.0)
    assert world.collisions.robot_wall <= 2
    assert robot.pose.y > 0.22 - 0.01, "it is not pressed into the wall"
    robot.put(Pose(0.5, 0.3, -pi / 2))
    robot.drive(Twist(0.5))
    world.step(1.0)
    robot.drive(Twist(-0.5))
    world.step(1.0)
    assert robot.pose.y == pytest.approx(0.22 + 0.5, abs=0.05)
    assert world.touched("R") == []


def test_a_timed_box_comes_and_goes() -> None:
    world = World(GridMap())
    robot = world.place_robot("R", Pose(2.0, 2.0, 0.0))
    world.put_box("b", BoxSpec(Pose(4.0, 4.0, 0.3), first=1.0, last=2.0, period=4.0))
    world.put_box("there", BoxSpec(Pose(2.0, 2.0, 0.0), first=1.0))
    present = {}
    for _ in range(70):
        world.step(0.1)
        present[round(world.time, 1)] = tuple(sorted(world.all_boxes))
    assert (present[0.9], present[1.1], present[2.1], present[5.1]) == ((), ("b",), (), ("b",))
    robot.drive(Twist(1.0))
    world.step(1.0)
    assert "there" in world.all_boxes, "it comes when the robot has left"
    world.take_box("there")
    world.step(1.0)
    assert "there" not in world.all_boxes


def test_things_are_moved_by_hand() -> None:
    world = World(GridMap())
    robot = world.add_robot("R", 0)
    world.add_robot("S", 1)
    world.put_box("b", BoxSpec(Pose(4.0, 4.0, 0.0)))
    world.move_box("b", Pose(5.0, 5.0, 0.5))
    assert world.all_boxes["b"].pose == Pose(5.0, 5.0, 0.5)
    robot.drive(Twist(0.5))
    world.move_robot("R", Pose(6.0, 6.0, 1.0))
    world.step()
    assert (robot.pose, robot.odometry) == (Pose(6.0, 6.0, 1.0), Pose(0.0, 0.0, 0.0))
    with pytest.raises(PlaceTakenError, match="S is in the way"):
        world.move_robot("R", Pose(1.5, 0.6, 0.0))
    with pytest.raises(PlaceTakenError, match="R is in the way"):
        world.move_box("b", Pose(6.0, 6.0, 0.0))


def lively_world(seed: int) -> World:
    model = RobotModel(drive=DriveSpec(acceleration=1.0, slip=0.02, slip_noise=0.02))
    world = World(GridMap(), WorldSpec(model=model), seed=seed)
    world.add_walker("P", WalkerSpec(((1.0, 4.5), (5.0, 4.5)), social_distance=0.3))
    world.add_door("door", DoorSpec(3.0, 4.0, times=(0.5,)))
    world.put_box("b", BoxSpec(Pose(6.0, 3.0, 0.3), first=1.0))
    for number in range(4):
        world.add_robot(f"R{number}", 2 * number, pi / 2)
    return world


def run(world: World) -> list[float]:
    for robot, turn in zip(world.robots.values(), (0.0, 0.2, -0.2, 0.1), strict=True):
        robot.drive(Twist(0.6, turn))
    seen: list[float] = []
    for _ in range(20):
        world.step(0.2)
        for name, ranges in world.scans(world.robots).items():
            robot = world.robots[name]
            seen += [robot.pose.x, robot.pose.y, robot.pose.yaw, robot.odometry.x, *ranges.tolist()]
    return seen


def test_the_same_seed_gives_the_same_truth_and_scans() -> None:
    first = run(lively_world(7))
    np.testing.assert_array_equal(first, run(lively_world(7)))
    assert not np.array_equal(first, run(lively_world(8)))


def test_a_reset_world_begins_anew() -> None:
    world = lively_world(7)
    first = run(world)
    world.reset()
    assert (world.time, world.collisions.total, world.robots["R1"].distance) == (0.0, 0, 0.0)
    assert hypot(world.robots["R1"].pose.x - 2.5, world.robots["R1"].pose.y - 0.5) == 0.0
    np.testing.assert_array_equal(run(world), first)


def test_a_timed_box_that_is_moved_stands_at_the_new_place() -> None:
    """It was told so, and stayed where it was until it had gone and come again."""
    world = World(GridMap())
    world.put_box("crate", BoxSpec(Pose(1.5, 1.5, 0.0), last=5.0))
    world.move_box("crate", Pose(4.5, 4.5, 0.0))
    assert (world.is_solid(1.5, 1.5, 0.1), world.is_solid(4.5, 4.5, 0.1)) == (False, True)
    world.place_robot("R", Pose(6.5, 6.5, 0.0))
    with pytest.raises(PlaceTakenError, match="R is in the way"):
        world.move_box("crate", Pose(6.5, 6.5, 0.0))
    assert world.is_solid(4.5, 4.5, 0.1)
    world.step(5.0)
    assert (world.all_boxes, world.has_box("crate")) == ({}, True)


def test_robots_are_not_moved_into_solid_things() -> None:
    """A robot inside of a wall or box could not drive out again."""
    world = World(GridMap(8, 8, blocked=frozenset({9})))
    world.add_robot("R", 0)
    world.add_light_robots({"L": Pose(2.5, 0.5, 0.0), "M": Pose(6.5, 6.5, 0.0)})
    world.add_box(20)
    for cell in (9, 20):
        with pytest.raises(PlaceTakenError, match="a wall, box or door"):
            world.move_robot("R", Pose(*world.grid.centre(cell), 0.0))
        with pytest.raises(PlaceTakenError, match="a wall, box or door"):
            world.move_light_robot("L", Pose(*world.grid.centre(cell), 0.0))
    with pytest.raises(PlaceTakenError, match="M is in the way"):
        world.move_light_robot("L", Pose(6.5, 6.5, 0.0))
    world.move_light_robot("L", Pose(2.6, 0.5, 0.0))
    world.step(1.0)
    assert world.collisions.total == 0


def test_doors_and_walkers_do_not_begin_in_a_robot() -> None:
    world = World(GridMap())
    world.add_robot("R", 0)
    with pytest.raises(PlaceTakenError, match="R is in the way"):
        world.add_door("door", DoorSpec(0.5, 0.5))
    with pytest.raises(PlaceTakenError, match="R is in the way"):
        world.add_walker("anna", WalkerSpec(((0.5, 0.5),)))
    assert (dict(world.doors), dict(world.walkers)) == ({}, {})


def test_light_robots_contacts_with_doors_and_walkers_count() -> None:
    world = World(GridMap())
    world.add_light_robots({"L": Pose(1.5, 1.5, 0.0)})
    light = world.light
    assert light is not None
    world.add_door("door", DoorSpec(3.5, 1.0, yaw=pi / 2, width=1.0))
    world.add_walker("anna", WalkerSpec(((5.5, 1.5),)))
    light.accept(0, "a", 1.0, 6.5, 1.5)
    world.step(15.0)
    seen = world.collisions
    assert (seen.robot_door, seen.robot_walker, seen.total) == (1, 1, 2)
    world.reset()
    assert world.collisions.total == 0


def test_a_walker_stops_for_a_light_robot() -> None:
    world = World(GridMap())
    world.add_light_robots({"L": Pose(3.5, 1.5, 0.0)})
    anna = world.add_walker("anna", WalkerSpec(((1.5, 1.5), (5.5, 1.5)), social_distance=0.4))
    world.step(5.0)
    assert anna.waits
    assert world.collisions.total == 0


@pytest.mark.parametrize("name", ["cell_a", "cell_", "cell_1b", "cell_03", "cell_٣"])
def test_a_boxs_name_may_be_like_that_of_a_cell(name: str) -> None:
    """A request with such a name ended the simulation."""
    world = World(GridMap())
    world.put_box(name, BoxSpec(Pose(1.5, 1.5, 0.0)))
    world.add_box(30)
    assert world.boxes == (30,)
