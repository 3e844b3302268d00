"""The simulated world: walls, boxes, doors, walkers and robots in a pymunk space.

Time advances in fixed steps and all noise is seeded, so the same commands give the same run. A world belongs
to one thread. The caller decides how fast time advances.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf
from typing import TYPE_CHECKING

import numpy as np
import pymunk

from rce_fleet.exceptions import OccupiedError, PlaceTakenError
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.box import BoxSpec, box_of_cell, cell_of_box
from rce_fleet.simulation.contacts import Collisions, ContactWatch, Kind, separation
from rce_fleet.simulation.doors import Door, DoorSpec
from rce_fleet.simulation.lidar import Floats
from rce_fleet.simulation.light.robots import LightRobots
from rce_fleet.simulation.robot import SimulatedRobot
from rce_fleet.simulation.sensing import scan_all
from rce_fleet.simulation.solids import Solids
from rce_fleet.simulation.walkers import Walker, WalkerSpec
from rce_fleet.simulation.walls import Block, Walls, grid_walls
from rce_fleet.simulation.world_spec import WorldSpec

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.simulation.light.bodies import LightModel
    from rce_fleet.simulation.models import RobotModel

_OVERLAP = 0.002
"""How far things that touch may overlap, metres: so much that a contact that lasts is one contact."""
_STANDS = 0.01
"""A slower robot stands, metres per second."""


class World:
    """A floor with cells, walls and what moves on it.

    Args:
        grid: The cells; the fleet's map of the floor.
        spec: Properties of the world.
        seed: Seed of all noise.
        walls: What never moves; None: the blocked cells, and a wall around the floor.

    Attributes:
        time: Simulated time, seconds.
        min_separation: Smallest distance between the hulls of two robots so far, metres; ``inf`` while
            there are fewer than two.
        light: Robots that advance with the world, but not in the physics engine; None without any.
    """

    def __init__(
        self, grid: GridMap, spec: WorldSpec | None = None, *, seed: int = 0, walls: Walls | None = None
    ) -> None:
        self.grid = grid
        self.spec = spec or WorldSpec()
        self.walls = grid_walls(grid) if walls is None else walls
        self.time = 0.0
        self.min_separation = inf
        self._seed = seed
        self._steps = 0
        self._space = pymunk.Space()
        self._space.collision_slop = _OVERLAP
        self._robots: dict[str, SimulatedRobot] = {}
        self._boxes: dict[str, BoxSpec] = {}
        self._timed: dict[str, BoxSpec] = {}
        self._doors: dict[str, Door] = {}
        self._walkers: dict[str, Walker] = {}
        self._solids = Solids(self._space, self.walls)
        self._contacts = ContactWatch(self._space, self._robots)
        self._places = np.empty((0, 3))
        self.light: LightRobots | None = None

    # What there is

    @property
    def robots(self) -> Mapping[str, SimulatedRobot]:
        """The robots by id. Read only."""
        return self._robots

    @property
    def boxes(self) -> tuple[int, ...]:
        """Cells with a box, ascending."""
        return tuple(sorted(cell for cell in map(cell_of_box, self._boxes) if cell is not None))

    @property
    def all_boxes(self) -> Mapping[str, BoxSpec]:
        """The boxes that are there now, by name; that of cell 3 is ``cell_3``. Read only."""
        return self._boxes

    def has_box(self, name: str) -> bool:
        """Return whether there is a box of this name, now or at other times."""
        return name in self._boxes or name in self._timed

    @property
    def doors(self) -> Mapping[str, Door]:
        """The doors by name. Read only."""
        return self._doors

    @property
    def walkers(self) -> Mapping[str, Walker]:
        """The walkers by name. Read only."""
        return self._walkers

    @property
    def collisions(self) -> Collisions:
        """Collisions so far."""
        seen, light = self._contacts.collisions, self.light
        if light is None:
            return seen
        return replace(
            seen,
            robot_robot=seen.robot_robot + light.judge.with_robots,
            robot_box=seen.robot_box + light.judge.with_boxes,
            robot_wall=seen.robot_wall + light.judge.with_walls,
            robot_door=seen.robot_door + light.judge.with_doors,
            robot_walker=seen.robot_walker + light.judge.with_walkers,
        )

    @property
    def edges(self) -> Floats:
        """All edges of what is not glass, shape (N, 4): x, y of both ends, metres."""
        return self._solids.edges(glass=False)

    @property
    def space(self) -> pymunk.Space:
        """The physics engine's space, for queries."""
        return self._space

    def touched(self, robot: str) -> list[float]:
        """Return the directions in which something touches a robot, radians in its frame."""
        return self._contacts.bearings(robot)

    def is_solid(self, x: float, y: float, radius: float) -> bool:
        """Return whether a wall, box or door is within ``radius`` of a point, metres."""
        solid = {Kind.WALL, Kind.BOX, Kind.DOOR}
        found = self._space.point_query((x, y), radius, pymunk.ShapeFilter())
        return any(hit.shape.collision_type in solid for hit in found)

    # Robots

    def add_robot(
        self, robot: str, cell: int, yaw: float = 0.0, model: RobotModel | None = None
    ) -> SimulatedRobot:
        """Put a robot at the middle of a cell; as :meth:`place_robot`.

        Raises:
            ValueError: A robot of this id exists.
            OccupiedError: Another robot is there.
        """
        x, y = self.grid.centre(cell)
        try:
            return self.place_robot(robot, Pose(x, y, yaw), model)
        except PlaceTakenError as error:
            raise OccupiedError(cell, error.things) from error

    def place_robot(self, robot: str, pose: Pose, model: RobotModel | None = None) -> SimulatedRobot:
        """Put a robot on the floor.

        Args:
            robot: Its id.
            pose: Where.
            model: What kind of robot; None for that of ``spec``.

        Raises:
            ValueError: A robot of this id exists.
            PlaceTakenError: Another robot or a walker is there.
        """
        if robot in self._robots:
            raise ValueError(f"robot {robot} exists already")
        made = SimulatedRobot(robot, pose, model or self.spec.model, self._seed)
        self._check_free(pose, made.radius)
        self._space.add(made.body, made.shape)
        self._robots[robot] = made
        self._note_places()
        return made

    def move_robot(self, robot: str, pose: Pose, *, as_start: bool = False) -> None:
        """Put a robot elsewhere, as a hand would: it stands there, and its odometry does not notice.

        Args:
            robot: Its id.
            pose: Where.
            as_start: Whether it also stands there after the next :meth:`reset`.

        Raises:
            PlaceTakenError: Something else is there.
        """
        moved = self._robots[robot]
        self._check_free(pose, moved.radius, but=(robot,))
        self._check_not_solid(pose, moved.radius)
        moved.put(pose)
        if as_start:
            moved.start = pose
        self._space.reindex_shapes_for_body(moved.body)
        self._note_places()

    def move_light_robot(self, robot: str, pose: Pose, *, as_start: bool = False) -> None:
        """Put a light robot elsewhere; as :meth:`move_robot`.

        Raises:
            KeyError: There is none of this id.
            PlaceTakenError: Something else is there.
        """
        light = self.light
        row = None if light is None else light.row(robot)
        if light is None or row is None:
            raise KeyError(robot)
        self._check_free(pose, light.model.radius, but=(robot,))
        self._check_not_solid(pose, light.model.radius)
        light.put(row, pose, as_start=as_start)

    def remove_robot(self, robot: str) -> None:
        """Remove a robot."""
        gone = self._robots[robot]
        self._space.remove(gone.shape, gone.body)
        del self._robots[robot]
        self._note_places()

    # Boxes, doors, walkers

    def add_box(self, cell: int) -> None:
        """Put a box into the middle of a cell; do nothing if it has one.

        Raises:
            OccupiedError: A robot is in the way.
        """
        if cell in self.boxes:
            return
        if cell not in self.grid:
            raise ValueError(f"cell {cell} is not on the map")
        x, y = self.grid.centre(cell)
        size = self.spec.box_size
        try:
            self.put_box(box_of_cell(cell), BoxSpec(Pose(x, y, self.grid.yaw), size, size))
        except PlaceTakenError as error:
            raise OccupiedError(cell, error.things) from error

    def remove_box(self, cell: int) -> None:
        """Remove the box from a cell; do nothing if it has none."""
        self.take_box(box_of_cell(cell))

    def put_box(self, name: str, box: BoxSpec) -> None:
        """Put a box somewhere, in place of the one of this name; if it is timed, now or when it is due.

        Raises:
            PlaceTakenError: A robot or a walker is in the way, and the box is not timed.
        """
        if box.timed:
            self.take_box(name)
            self._timed[name] = box
            self._update_timed()
            return
        self._check_room(box)
        self._timed.pop(name, None)
        self._boxes[name] = box
        self._solids.put(name, box.block, Kind.BOX)
        self._show_boxes()

    def move_box(self, name: str, pose: Pose) -> None:
        """Put a box elsewhere.

        Raises:
            KeyError: There is none of this name.
            PlaceTakenError: A robot or a walker is in the way.
        """
        moved = replace(self._boxes[name], pose=pose)
        self._check_room(moved)
        self.put_box(name, moved)

    def take_box(self, name: str) -> None:
        """Remove a box; do nothing if there is none of this name."""
        self._timed.pop(name, None)
        if self._boxes.pop(name, None) is not None:
            self._solids.take(name)
            self._show_boxes()

    def add_light_robots(self, starts: Mapping[str, Pose], model: LightModel | None = None) -> LightRobots:
        """Put light robots on the floor, all at once.

        Args:
            starts: Where each of them stands, by its id.
            model: What they are like; None for the usual.

        Raises:
            ValueError: There are light robots already, or a robot of such an id.
            PlaceTakenError: Something is where one of them is to stand.
        """
        if self.light is not None or not self._robots.keys().isdisjoint(starts):
            raise ValueError("light robots are added once, with ids that no other robot has")
        edges = np.concatenate([self.walls.edges(glass=glass) for glass in (False, True)])
        made = LightRobots(starts, edges, model, seed=self._seed)
        for pose in starts.values():
            self._check_not_solid(pose, made.model.radius)
            self._check_free(pose, made.model.radius)
        made.docks = np.array([(dock.x, dock.y, dock.reach) for dock in self.spec.docks]).reshape(-1, 3)
        self.light = made
        self._show_boxes()
        return made

    def add_door(self, door: str, spec: DoorSpec) -> Door:
        """Add a door.

        Raises:
            PlaceTakenError: A robot or a walker is where its leaf is at the start.
        """
        made = Door(door, spec)
        in_the_way = self._near(made.block, 0.0)
        if in_the_way:
            raise PlaceTakenError(spec.x, spec.y, in_the_way)
        self._doors[door] = made
        self._solids.put(door, made.block, Kind.DOOR)
        return made

    def put_walker(self, walker: str, spec: WalkerSpec) -> Walker:
        """Add a walker while others are about.

        Raises:
            PlaceTakenError: A robot or another walker is at the first waypoint.
        """
        self._check_free(Pose(*spec.waypoints[0], 0.0), spec.radius)
        return self.add_walker(walker, spec)

    def move_walker(self, walker: str, x: float, y: float) -> None:
        """Put a walker elsewhere, metres; the waypoints move with the walker.

        Raises:
            PlaceTakenError: A robot or another walker is there.
        """
        moved = self._walkers[walker]
        self._check_free(Pose(x, y, 0.0), moved.spec.radius, but=(walker,))
        moved.put(x, y)
        self._space.reindex_shapes_for_body(moved.body)

    def remove_walker(self, walker: str) -> None:
        """Remove a walker."""
        gone = self._walkers.pop(walker)
        self._space.remove(gone.shape, gone.body)

    def add_walker(self, walker: str, spec: WalkerSpec) -> Walker:
        """Add a walker.

        Raises:
            PlaceTakenError: A robot is at the first waypoint.
        """
        self._check_free(Pose(*spec.waypoints[0], 0.0), spec.radius, but=tuple(self._walkers))
        made = self._walkers[walker] = Walker(walker, spec)
        made.shape.collision_type = Kind.WALKER
        self._space.add(made.body, made.shape)
        return made

    # Time

    def step(self, dt: float | None = None) -> None:
        """Advance time by ``dt`` seconds, one time step by default.

        Only whole time steps are made; the remainder is added to the next call.
        """
        goal = self.time + (self.spec.time_step if dt is None else dt)
        while (self._steps + 1) * self.spec.time_step <= goal + 1e-9:
            self._one_step()
        self.time = max(goal, self._steps * self.spec.time_step)

    def reset(self) -> None:
        """Begin anew: time 0, all robots, doors and walkers at their starts, the same noise to come.

        Boxes stay where they are, unless they are timed.
        """
        self.time, self._steps, self.min_separation = 0.0, 0, inf
        for robot in self._robots.values():
            self._space.remove(robot.shape, robot.body)
            robot.reset()
            self._space.add(robot.body, robot.shape)
        for walker in self._walkers.values():
            walker.reset()
            self._space.reindex_shapes_for_body(walker.body)
        for door in self._doors.values():
            door.reset()
            self._solids.put(door.id, door.block, Kind.DOOR)
        self._contacts.reset()
        if self.light is not None:
            self.light.reset()
        self._note_places()
        self._update_timed()

    def scan(self, robot: str) -> Floats:
        """Return a scan of a robot; as :meth:`scans`."""
        return self.scans((robot,))[robot]

    def scans(self, robots: Iterable[str]) -> dict[str, Floats]:
        """Return what the range sensors of robots measure now, with noise.

        Two scans of the same moment are the same.

        Returns:
            For each robot shape (beams,), metres: infinite where nothing returned, NaN where something is
            nearer than the sensor measures.
        """
        seers = [self._robots[robot] for robot in robots]
        walkers = [(*walker.position, walker.spec.radius) for walker in self._walkers.values()]
        light = np.empty((0, 3)) if self.light is None else self.light.discs
        circles = np.concatenate((self._places, np.array(walkers, np.float64).reshape(-1, 3), light))
        return scan_all(seers, self._solids, circles, self._steps)

    # Inside

    def _one_step(self) -> None:
        dt, now = self.spec.time_step, self._steps * self.spec.time_step
        robots = self._places if self.light is None else np.concatenate((self._places, self.light.discs))
        for walker in self._walkers.values():
            walker.walk(now, dt, robots)
        for door in self._doors.values():
            if door.advance(now, dt, lambda leaf, apart: bool(self._near(leaf, apart))):
                self._solids.put(door.id, door.block, Kind.DOOR)
        for robot in self._robots.values():
            robot.push(dt, touched=bool(self._contacts.bearings(robot.id)))
        self._space.step(dt)
        for robot in self._robots.values():
            robot.settle(dt, docked=bool(self.spec.docks) and self._docked(robot))
        self._steps += 1
        self._note_places()
        self._update_timed()
        if self.light is not None:
            self.light.others = self._places
            walkers = [(*walker.position, walker.spec.radius) for walker in self._walkers.values()]
            self.light.walkers = np.array(walkers, np.float64).reshape(-1, 3)
            self.light.doors = [door.block for door in self._doors.values()]
            self.light.advance(dt)
            self.min_separation = self.light.judge.min_separation
        else:
            self.min_separation = min(self.min_separation, separation(self._places))

    def _note_places(self) -> None:
        """Note the robots' places and radii, shape (N, 3)."""
        rows = [(*robot.place[:2], robot.radius) for robot in self._robots.values()]
        self._places = np.array(rows, np.float64).reshape(-1, 3)

    def _update_timed(self) -> None:
        """Let timed boxes come and go; one that has no room yet comes later."""
        for name, box in self._timed.items():
            due = box.is_due(self._steps * self.spec.time_step)
            if due and name not in self._boxes and not self._near(box.block, 0.0):
                self._boxes[name] = box
                self._solids.put(name, box.block, Kind.BOX)
                self._show_boxes()
            elif not due and self._boxes.pop(name, None) is not None:
                self._solids.take(name)
                self._show_boxes()

    def _show_boxes(self) -> None:
        """Tell light robots, who do not see the physics engine's shapes, where boxes are."""
        if self.light is not None:
            edges = [edge for box in self._boxes.values() for edge in box.block.edges]
            self.light.set_boxes(np.array(edges, np.float64).reshape(-1, 4))

    def _docked(self, robot: SimulatedRobot) -> bool:
        x, y, _ = robot.place
        stands = abs(robot.wheels.wheels.speed) < _STANDS
        return stands and any(dock.reaches(x, y) for dock in self.spec.docks)

    def _discs(self) -> list[tuple[str, float, float, float]]:
        """Return name, place and radius of all robots and walkers."""
        robots = [(robot.id, *robot.place[:2], robot.radius) for robot in self._robots.values()]
        walkers = [(walker.id, *walker.position, walker.spec.radius) for walker in self._walkers.values()]
        light = [] if self.light is None else self.light.discs.tolist()
        names = () if self.light is None else self.light.present_names.values()
        return robots + walkers + [(name, *disc) for name, disc in zip(names, light, strict=True)]

    def _near(self, block: Block, apart: float) -> tuple[str, ...]:
        """Return the robots and walkers that are nearer to a block than ``apart``, metres."""
        return tuple(name for name, x, y, radius in self._discs() if block.distance(x, y) < radius + apart)

    def _check_room(self, box: BoxSpec) -> None:
        """Raise PlaceTakenError if a robot or a walker is where a box is to stand."""
        in_the_way = self._near(box.block, 0.0)
        if in_the_way:
            raise PlaceTakenError(box.pose.x, box.pose.y, in_the_way)

    def _check_not_solid(self, pose: Pose, radius: float) -> None:
        """Raise PlaceTakenError if something solid is where a disc is to stand."""
        if self.is_solid(pose.x, pose.y, radius):
            raise PlaceTakenError(pose.x, pose.y, ("a wall, box or door",))

    def _check_free(self, pose: Pose, radius: float, but: Collection[str] = ()) -> None:
        """Raise PlaceTakenError if a robot or a walker, but for some, is where a disc is to stand."""
        taken = tuple(
            name
            for name, x, y, other in self._discs()
            if name not in but and hypot(x - pose.x, y - pose.y) < radius + other
        )
        if taken:
            raise PlaceTakenError(pose.x, pose.y, taken)
