"""What never moves in a world: solid blocks and thin walls, some of glass."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import cos, hypot, inf, sin
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose, transform_points
from rce_fleet.simulation.lidar import Floats

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rce_fleet.planning.grid import GridMap

THICKNESS = 0.1
"""Thickness of the wall around a floor of cells, metres."""

Point = tuple[float, float]


def no_lines() -> Floats:
    """Return an empty array of edges."""
    return np.empty((0, 4))


@dataclass(frozen=True, slots=True)
class Block:
    """A solid convex polygon.

    Attributes:
        corners: Its corners in order, metres.
        glass: Whether sensors may see through it.
        face: The only edge that sensors can see, by its number; None if they can see all.
    """

    corners: tuple[Point, ...]
    glass: bool = False
    face: int | None = None

    @classmethod
    def rectangle(cls, left: float, low: float, right: float, high: float) -> Block:
        """Return a rectangle along the axes."""
        return cls(((left, low), (right, low), (right, high), (left, high)))

    @classmethod
    def box(cls, pose: Pose, width: float, depth: float, *, glass: bool = False) -> Block:
        """Return a rectangle around a pose, ``width`` along its direction and ``depth`` across, metres."""
        c, s = cos(pose.yaw), sin(pose.yaw)
        sides = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        half = [(a * width / 2, b * depth / 2) for a, b in sides]
        return cls(tuple((pose.x + c * x - s * y, pose.y + s * x + c * y) for x, y in half), glass)

    @classmethod
    def wall(cls, start: Point, end: Point, thickness: float, *, glass: bool = False) -> Block:
        """Return a wall of some thickness around the line between two points."""
        length = hypot(end[0] - start[0], end[1] - start[1])
        x, y = (end[0] - start[0]) / length * thickness / 2, (end[1] - start[1]) / length * thickness / 2
        return cls(
            (
                (start[0] + y, start[1] - x),
                (end[0] + y, end[1] - x),
                (end[0] - y, end[1] + x),
                (start[0] - y, start[1] + x),
            ),
            glass,
        )

    def placed(self, frame: Pose) -> Block:
        """Return the block in the parent frame of the frame that its corners are given in."""
        corners = transform_points(frame.as_array(), self.corners).tolist()
        return replace(self, corners=tuple((x, y) for x, y in corners))

    @property
    def edges(self) -> list[tuple[float, float, float, float]]:
        """Its edges: x, y of both ends."""
        return [(*a, *b) for a, b in pairwise([*self.corners, self.corners[0]])]

    @property
    def seen(self) -> list[tuple[float, float, float, float]]:
        """The edges that sensors can see."""
        return self.edges if self.face is None else [self.edges[self.face]]

    def distance(self, x: float, y: float) -> float:
        """Return the distance of a point from the block, metres; 0 inside."""
        return float(distances(np.array([(x, y)]), np.array(self.edges), self)[0])


@dataclass(frozen=True)
class Walls:
    """Solid blocks, and thin walls of no thickness.

    Attributes:
        blocks: The blocks.
        lines: Thin walls, shape (N, 4): x, y of both ends, metres.
        glass_lines: Thin walls of glass.
    """

    blocks: tuple[Block, ...] = ()
    lines: Floats = field(default_factory=no_lines)
    glass_lines: Floats = field(default_factory=no_lines)

    def __add__(self, other: Walls) -> Walls:
        return Walls(
            self.blocks + other.blocks,
            np.concatenate((self.lines, other.lines)),
            np.concatenate((self.glass_lines, other.glass_lines)),
        )

    def edges(self, *, glass: bool) -> Floats:
        """Return what sensors see, shape (N, 4): of glass, or of everything else."""
        lines = self.glass_lines if glass else self.lines
        seen = [edge for block in self.blocks if block.glass is glass for edge in block.seen]
        return np.concatenate((lines, np.array(seen, np.float64).reshape(-1, 4)))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x and y, largest x and y, metres; all 0 if there are no walls."""
        corners = [corner for block in self.blocks for corner in block.corners]
        lines = np.concatenate((self.lines, self.glass_lines)).reshape(-1, 2)
        points = np.concatenate((np.array(corners, np.float64).reshape(-1, 2), lines))
        if not len(points):
            return 0.0, 0.0, 0.0, 0.0
        (left, low), (right, high) = points.min(axis=0), points.max(axis=0)
        return float(left), float(low), float(right), float(high)


def distances(points: Floats, edges: Floats, inside: Block | None = None) -> Floats:
    """Return the distance of points, shape (N, 2), from the nearest of some edges, shape (M, 4); metres.

    Points inside of the convex block ``inside`` have the distance 0.
    """
    nearest = np.full(len(points), inf)
    sides = []
    for ax, ay, bx, by in edges:
        ex, ey = bx - ax, by - ay
        dx, dy = points[:, 0] - ax, points[:, 1] - ay
        length = ex * ex + ey * ey
        along = np.clip((dx * ex + dy * ey) / length, 0.0, 1.0) if length else np.zeros(len(points))
        np.minimum(nearest, np.hypot(dx - along * ex, dy - along * ey), out=nearest)
        if inside is not None:
            sides.append(ex * dy - ey * dx)
    if sides:
        turns = np.array(sides)
        nearest[(turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)] = 0.0
    return nearest


def polyline(points: Sequence[Point], *, closed: bool = False) -> Floats:
    """Return the edges of a line through points, shape (N, 4)."""
    ends = [*points, points[0]] if closed else list(points)
    return np.array([(*a, *b) for a, b in pairwise(ends)], np.float64).reshape(-1, 4)


def grid_walls(grid: GridMap, *, enclosed: bool = True) -> Walls:
    """Return the walls of a floor of cells: its blocked cells and, if ``enclosed``, a wall around it."""
    size, thick = grid.cell_size, THICKNESS
    blocks = [
        Block.rectangle(first * size, row * size, (last + 1) * size, (row + 1) * size)
        for row, first, last in _runs(grid)
    ]
    if enclosed:
        right, high = grid.columns * size, grid.rows * size
        around = (  # With the number of the edge that faces the floor.
            (1, (-thick, -thick, 0.0, high + thick)),
            (3, (right, -thick, right + thick, high + thick)),
            (2, (0.0, -thick, right, 0.0)),
            (0, (0.0, high, right, high + thick)),
        )
        blocks += [replace(Block.rectangle(*sides), face=face) for face, sides in around]
    corner = Pose(*grid.origin, grid.yaw)
    return Walls(tuple(block.placed(corner) for block in blocks))


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
