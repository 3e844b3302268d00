"""The simulated world: walls, boxes and robots in a pymunk space.

Time advances in fixed steps and all noise is seeded, so the same commands give the same run. A world belongs
to one thread. The caller decides how fast time advances.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from math import inf
from typing import TYPE_CHECKING

import numpy as np
import pymunk

from rce_fleet.exceptions import OccupiedError
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.lidar import Floats, LidarSpec, cast
from rce_fleet.simulation.noise import NoiseSpec
from rce_fleet.simulation.robot import SimulatedRobot

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_fleet.planning.grid import GridMap

_ROBOT, _BOX, _WALL = 1, 2, 3
_WALL_THICKNESS = 0.1


@dataclass(slots=True)
class Collisions:
    """Number of collisions; each contact counts once, when it begins."""

    robot_robot: int = 0
    robot_box: int = 0
    robot_wall: int = 0

    @property
    def total(self) -> int:
        """All contacts."""
        return self.robot_robot + self.robot_box + self.robot_wall


@dataclass(frozen=True, slots=True)
class WorldSpec:
    """Properties of a world.

    Attributes:
        time_step: Length of a step, seconds.
        robot_radius: Radius of the robots' hulls, metres.
        box_size: Edge of a box, metres.
        lidar: Properties of the robots' lidars.
        noise: The robots' sensor noise.
    """

    time_step: float = 0.02
    robot_radius: float = 0.22
    box_size: float = 0.6
    lidar: LidarSpec = field(default_factory=LidarSpec)
    noise: NoiseSpec = field(default_factory=NoiseSpec)


class World:
    """A floor with a wall around it; the map's blocked cells are solid.

    Args:
        grid: The map.
        spec: Properties of the world.
        seed: Seed of all noise.

    Attributes:
        time: Simulated time, seconds.
        collisions: Collisions so far.
        min_separation: Smallest distance between the hulls of two robots so far, metres; ``inf`` while
            there are fewer than two.
    """

    def __init__(self, grid: GridMap, spec: WorldSpec | None = None, *, seed: int = 0) -> None:
        self.grid = grid
        self.spec = spec or WorldSpec()
        self.time = 0.0
        self.collisions = Collisions()
        self.min_separation = inf
        self._seed = seed
        self._steps = 0
        self._space = pymunk.Space()
        self._robots: dict[str, SimulatedRobot] = {}
        self._boxes: dict[int, pymunk.Poly] = {}
        self._watch_contacts()
        self._wall_edges = self._build_walls()
        self._edges = self._wall_edges

    # Things in it

    @property
    def robots(self) -> dict[str, SimulatedRobot]:
        """The robots by id. Read only."""
        return self._robots

    @property
    def boxes(self) -> tuple[int, ...]:
        """Cells with a box, ascending."""
        return tuple(sorted(self._boxes))

    def add_robot(self, robot: str, cell: int, yaw: float = 0.0) -> SimulatedRobot:
        """Put a robot at the centre of a cell.

        Raises:
            ValueError: A robot of this id exists, or the cell is not on the map.
            OccupiedError: Another robot is there.
        """
        if robot in self._robots:
            raise ValueError(f"robot {robot} exists already")
        x, y = self.grid.centre(cell)
        others = self._robots_within(x, y, 2 * self.spec.robot_radius)
        if others:
            raise OccupiedError(cell, others)
        # A robot's noise depends on the seed and its own id only, not on the other robots.
        rng = np.random.default_rng([self._seed, *robot.encode()])
        made = SimulatedRobot(robot, Pose(x, y, yaw), self.spec.robot_radius, self.spec.noise, rng)
        made.shape.collision_type = _ROBOT
        self._space.add(made.body, made.shape)
        self._robots[robot] = made
        return made

    def remove_robot(self, robot: str) -> None:
        """Remove a robot."""
        gone = self._robots.pop(robot)
        self._space.remove(gone.shape, gone.body)

    def add_box(self, cell: int) -> None:
        """Put a box into the middle of a cell; do nothing if it has one.

        Raises:
            OccupiedError: A robot is in the way.
        """
        if cell in self._boxes:
            return
        if cell not in self.grid:
            raise ValueError(f"cell {cell} is not on the map")
        x, y = self.grid.centre(cell)
        half = self.spec.box_size / 2
        in_the_way = tuple(
            robot.id for robot in self._robots.values() if _overlaps(robot.pose, robot.radius, x, y, half)
        )
        if in_the_way:
            raise OccupiedError(cell, in_the_way)
        box = self._block(x - half, y - half, x + half, y + half, _BOX)
        self._space.add(box)
        self._boxes[cell] = box
        self._rebuild_edges()

    def remove_box(self, cell: int) -> None:
        """Remove the box from a cell; do nothing if it has none."""
        box = self._boxes.pop(cell, None)
        if box is not None:
            self._space.remove(box)
            self._rebuild_edges()

    # Time

    def step(self, dt: float | None = None) -> None:
        """Advance time by ``dt`` seconds, one time step by default.

        Only whole time steps are made; the remainder is added to the next call.
        """
        goal = self.time + (self.spec.time_step if dt is None else dt)
        while (self._steps + 1) * self.spec.time_step <= goal + 1e-9:
            self._one_step()
        self.time = max(goal, self._steps * self.spec.time_step)

    def scan(self, robot: str) -> Floats:
        """Return a scan of the robot's lidar, with noise: shape (beams,), metres.

        A range of ``lidar.max_range`` means that the beam hit nothing.
        """
        spec = self.spec.lidar
        seer = self._robots[robot]
        others = [
            (other.pose.x, other.pose.y, other.radius) for other in self._robots.values() if other is not seer
        ]
        pose = seer.pose
        circles = np.array(others, np.float64).reshape(-1, 3)
        ranges = cast(spec, (pose.x, pose.y), pose.yaw, self._edges, circles)
        hit = ranges < spec.max_range
        noisy = ranges + spec.noise * seer.rng.standard_normal(spec.beams)
        return np.where(hit, np.clip(noisy, 0.0, spec.max_range), spec.max_range)

    @property
    def edges(self) -> Floats:
        """All edges of walls and boxes, shape (N, 4): x, y of both ends, metres."""
        return self._edges

    @property
    def space(self) -> pymunk.Space:
        """The physics engine's space, for queries."""
        return self._space

    def _one_step(self) -> None:
        dt = self.spec.time_step
        for robot in self._robots.values():
            robot.push()
        self._space.step(dt)
        for robot in self._robots.values():
            robot.settle(dt)
        self._steps += 1
        if len(self._robots) > 1:
            places = np.array([robot.body.position for robot in self._robots.values()])
            apart = np.hypot(*(places[:, None, :] - places[None, :, :]).transpose(2, 0, 1))
            nearest = float(apart[np.triu_indices(len(places), 1)].min())
            self.min_separation = min(self.min_separation, nearest - 2 * self.spec.robot_radius)

    # Making it

    def _watch_contacts(self) -> None:
        def count_robot(_arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: object) -> None:
            self.collisions.robot_robot += 1

        def count_box(_arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: object) -> None:
            self.collisions.robot_box += 1

        def count_wall(_arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: object) -> None:
            self.collisions.robot_wall += 1

        self._space.on_collision(_ROBOT, _ROBOT, begin=count_robot)
        self._space.on_collision(_ROBOT, _BOX, begin=count_box)
        self._space.on_collision(_ROBOT, _WALL, begin=count_wall)

    def _build_walls(self) -> Floats:
        """Add the wall around the floor and the map's blocked cells; return their edges."""
        grid = self.grid
        (left, low), size = grid.origin, grid.cell_size
        right, high = left + grid.columns * size, low + grid.rows * size
        corners = [(left, low), (right, low), (right, high), (left, high), (left, low)]
        edges: list[tuple[float, float, float, float]] = []
        thick = _WALL_THICKNESS
        for sides in (
            (left - thick, low - thick, left, high + thick),
            (right, low - thick, right + thick, high + thick),
            (left, low - thick, right, low),
            (left, high, right, high + thick),
        ):
            self._space.add(self._block(*sides, _WALL))
        edges += [(*a, *b) for a, b in pairwise(corners)]
        for row, first, last in _runs(grid):
            x, y = left + first * size, low + row * size
            block = self._block(x, y, left + (last + 1) * size, y + size, _WALL)
            self._space.add(block)
            edges += _edges_of(block)
        return np.array(edges, np.float64)

    def _block(self, left: float, low: float, right: float, high: float, kind: int) -> pymunk.Poly:
        corners = [(left, low), (right, low), (right, high), (left, high)]
        block = pymunk.Poly(self._space.static_body, corners)
        block.collision_type = kind
        return block

    def _rebuild_edges(self) -> None:
        edges = [edge for box in self._boxes.values() for edge in _edges_of(box)]
        self._edges = np.concatenate((self._wall_edges, np.array(edges, np.float64).reshape(-1, 4)))

    def _robots_within(self, x: float, y: float, reach: float) -> tuple[str, ...]:
        return tuple(
            robot.id
            for robot in self._robots.values()
            if (robot.pose.x - x) ** 2 + (robot.pose.y - y) ** 2 < reach * reach
        )


def _runs(grid: GridMap) -> Iterator[tuple[int, int, int]]:
    """Yield blocked cells joined along rows: row, first and last column."""
    for row in range(grid.rows):
        first: int | None = None
        for column in range(grid.columns + 1):
            solid = column < grid.columns and grid.cell(row, column) in grid.blocked
            if solid and first is None:
                first = column
            elif not solid and first is not None:
                yield row, first, column - 1
                first = None


def _edges_of(block: pymunk.Poly) -> list[tuple[float, float, float, float]]:
    corners = block.get_vertices()
    return [(*a, *b) for a, b in pairwise([*corners, corners[0]])]


def _overlaps(pose: Pose, radius: float, x: float, y: float, half: float) -> bool:
    """Return whether a disc and a square with centre ``(x, y)`` overlap."""
    dx = max(abs(pose.x - x) - half, 0.0)
    dy = max(abs(pose.y - y) - half, 0.0)
    return dx * dx + dy * dy < radius * radius
