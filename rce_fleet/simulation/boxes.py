"""Keeps boxes where the fleet's cells are blocked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.exceptions import OccupiedError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.simulation.world import World


class BoxKeeper:
    """Puts a box into every cell that becomes blocked, and removes it when the cell is freed.

    Boxes in cells that were never blocked (hidden boxes) are left alone.

    Args:
        world: Where the boxes are.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._blocked: frozenset[int] = frozenset()

    def follow(self, blocked: Iterable[int]) -> None:
        """Set the cells that are blocked now."""
        now = frozenset(cell for cell in blocked if cell in self._world.grid)
        for cell in self._blocked - now:
            self._world.remove_box(cell)
        self._blocked = now
        self.update()

    def update(self) -> tuple[int, ...]:
        """Add the missing boxes; return the cells in which a robot is in the way."""
        occupied = []
        for cell in sorted(self._blocked.difference(self._world.boxes, self._world.grid.blocked)):
            try:
                self._world.add_box(cell)
            except OccupiedError:
                occupied.append(cell)
        return tuple(occupied)
