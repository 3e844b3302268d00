"""What all layers of a costmap have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from rce_fleet.navigation.costmap.costs import FREE, UNKNOWN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.geometry.poses import Pose
    from rce_fleet.navigation.costmap.cost_grid import Area, CostGrid


class Layer(Protocol):
    """A part of a costmap. An update asks each layer what changed, then each writes its costs there."""

    def match(self, grid: CostGrid) -> None:
        """Take on the size and the place of the costmap; what the layer stored is lost."""

    def move(self, grid: CostGrid, rows: int, columns: int) -> None:
        """Follow the costmap, whose window moved by whole cells; ``grid`` is at its new place."""

    def update_bounds(self, grid: CostGrid, robot: Pose, now: float) -> Area:
        """Take in what is new; return the cells whose costs may have changed."""

    def update_costs(self, grid: CostGrid, area: Area) -> None:
        """Write the layer's costs of an area over those of the layers below."""

    def clear(self, grid: CostGrid, keep: Area) -> Area:
        """Forget what is stored of the cells outside ``keep``; return which costs may have changed."""


def write_larger(below: NDArray[np.uint8], costs: NDArray[np.uint8]) -> None:
    """Write costs where they are known and larger than those below, or where those are unknown."""
    better = (costs != UNKNOWN) & ((below == UNKNOWN) | (costs > below))
    np.copyto(below, costs, where=better)


def write_known(below: NDArray[np.uint8], costs: NDArray[np.uint8]) -> None:
    """Write all costs that are known."""
    np.copyto(below, costs, where=costs != UNKNOWN)


def fill_of(*, track_unknown: bool) -> int:
    """Return the cost of cells of which nothing is known."""
    return UNKNOWN if track_unknown else FREE
