"""The solid things of a world in the physics engine, and their edges for sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pymunk

from rce_fleet.simulation.contacts import Kind
from rce_fleet.simulation.lidar import Floats

if TYPE_CHECKING:
    from rce_fleet.simulation.walls import Block, Walls


class Solids:
    """Walls, and solid blocks that come, move and go.

    Args:
        space: The physics engine's space.
        walls: What never moves.
    """

    def __init__(self, space: pymunk.Space, walls: Walls) -> None:
        self._space = space
        self._blocks: dict[str, tuple[Block, pymunk.Shape]] = {}
        self._wall_edges = {glass: walls.edges(glass=glass) for glass in (False, True)}
        self._edges: dict[bool, Floats] = {}
        static = space.static_body
        shapes: list[pymunk.Shape] = [pymunk.Poly(static, block.corners) for block in walls.blocks]
        lines = np.concatenate((walls.lines, walls.glass_lines)).tolist()
        shapes += [pymunk.Segment(static, (ax, ay), (bx, by), 0.0) for ax, ay, bx, by in lines]
        for shape in shapes:
            shape.collision_type = Kind.WALL
        space.add(*shapes)

    def put(self, name: str, block: Block, kind: Kind) -> None:
        """Add a block, in place of the one of this name."""
        self.take(name)
        shape = pymunk.Poly(self._space.static_body, block.corners)
        shape.collision_type = kind
        self._space.add(shape)
        self._blocks[name] = (block, shape)
        self._edges.clear()

    def take(self, name: str) -> None:
        """Remove the block of this name; do nothing if there is none."""
        found = self._blocks.pop(name, None)
        if found is not None:
            self._space.remove(found[1])
            self._edges.clear()

    def edges(self, *, glass: bool) -> Floats:
        """Return the edges of glass, or of everything else, shape (N, 4): x, y of both ends, metres."""
        if glass not in self._edges:
            moving = [
                edge for block, _ in self._blocks.values() if block.glass is glass for edge in block.edges
            ]
            self._edges[glass] = np.concatenate(
                (self._wall_edges[glass], np.array(moving, np.float64).reshape(-1, 4))
            )
        return self._edges[glass]
