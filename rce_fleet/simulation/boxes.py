"""Keeps boxes where the fleet's cells are blocked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.exceptions import OccupiedError, PlaceTakenError
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.box import BoxSpec

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.simulation.world import World

REQUESTED = "requested_"
"""Beginning of the names of boxes in cells of another grid than the world's."""


class BoxKeeper:
    """Puts a box into every cell that becomes blocked, and removes it when the cell is freed.

    Boxes in cells that were never blocked (hidden boxes) are left alone.

    Args:
        world: Where the boxes are.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._blocked: frozenset[int] = frozenset()
        self._grid = world.grid

    def follow(self, blocked: Iterable[int], grid: GridMap | None = None) -> None:
        """Set the cells that are blocked now.

        Args:
            blocked: The cells.
            grid: The fleet's grid, which says where they are; None: the world's own.
        """
        fleet = self._world.grid if grid is None else grid
        same = fleet.layout == self._grid.layout
        now = frozenset(cell for cell in blocked if cell in fleet)
        for cell in self._blocked - now if same else self._blocked:
            if self._is_own:
                self._world.remove_box(cell)
            else:
                self._world.take_box(f"{REQUESTED}{cell}")
        self._blocked, self._grid = now, fleet
        self.update()

    def update(self) -> tuple[int, ...]:
        """Add the missing boxes; return the cells in which a robot is in the way."""
        occupied = []
        for cell in sorted(self._missing()):
            try:
                if self._is_own:
                    self._world.add_box(cell)
                else:
                    self._world.put_box(f"{REQUESTED}{cell}", self._box(cell))
            except (OccupiedError, PlaceTakenError):
                occupied.append(cell)
        return tuple(occupied)

    @property
    def _is_own(self) -> bool:
        """Whether the fleet has the world's own grid."""
        return self._grid.layout == self._world.grid.layout

    def _missing(self) -> set[int]:
        """Return the blocked cells that have no box."""
        world = self._world
        if self._is_own:
            return set(self._blocked.difference(world.boxes, world.grid.blocked))
        return {cell for cell in self._blocked if f"{REQUESTED}{cell}" not in world.all_boxes}

    def _box(self, cell: int) -> BoxSpec:
        """Return the box of a cell of another grid: as much of its cell as in the world's."""
        spec, fleet = self._world.spec, self._grid
        size = spec.box_size * fleet.cell_size / self._world.grid.cell_size
        return BoxSpec(Pose(*fleet.centre(cell), fleet.yaw), size, size)
