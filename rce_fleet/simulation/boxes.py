"""Keeps boxes where the fleet's cells are blocked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.exceptions import OccupiedError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.simulation.world import World


class BoxKeeper:
    """Puts a box into every cell that becomes blocked, and takes it away when the cell is freed.

    Boxes that stand in cells that were never blocked, which nobody knows of yet, are left alone.

    Args:
        world: Where the boxes are.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._blocked: frozenset[int] = frozenset()

    def follow(self, blocked: Iterable[int]) -> None:
        """Take the cells that are blocked now, all of them."""
        now = frozenset(cell for cell in blocked if cell in self._world.grid)
        for cell in self._blocked - now:
            self._world.remove_box(cell)
        self._blocked = now
        self.update()

    def update(self) -> tuple[int, ...]:
        """Put up the boxes that are still missing; returns cells that a robot is in the way of."""
        occupied = []
        for cell in sorted(self._blocked.difference(self._world.boxes, self._world.grid.blocked)):
            try:
                self._world.add_box(cell)
            except OccupiedError:
                occupied.append(cell)
        return tuple(occupied)
