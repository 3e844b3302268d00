"""The layer of costs around obstacles."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.maps.distance import squares_to_nearest
from rce_fleet.navigation.costmap.cost_grid import NOWHERE, Area, CostGrid
from rce_fleet.navigation.costmap.costs import FREE, INSCRIBED, LETHAL, UNKNOWN, cost_of_distance

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.geometry.poses import Pose
    from rce_fleet.navigation.costmap.parameters import InflationParameters


class InflationLayer:
    """Costs that fall with the distance to the nearest lethal cell.

    The distance is exact (Euclidean, between centres of cells). costmap_2d's differs from it in few cells,
    since it spreads from obstacles cell by cell.

    Args:
        parameters: Of the layer.
        inscribed_radius: Radius of the largest circle inside the footprint, metres.
    """

    def __init__(self, parameters: InflationParameters, inscribed_radius: float) -> None:
        self.parameters = parameters
        self._inscribed = inscribed_radius
        self._table = np.empty(0, np.uint8)
        self._resolution = 0.0

    def reach(self, grid: CostGrid) -> int:
        """Return how many cells around an obstacle get a cost."""
        return ceil(self.parameters.inflation_radius / grid.resolution)

    # The layer

    def match(self, _grid: CostGrid) -> None:
        """Do nothing: the layer stores nothing."""

    def move(self, _grid: CostGrid, _rows: int, _columns: int) -> None:
        """Do nothing: the layer stores nothing."""

    def update_bounds(self, _grid: CostGrid, _robot: Pose, _now: float) -> Area:
        """Return no cell: the costmap lets this layer write around what others changed."""
        return NOWHERE

    def update_costs(self, grid: CostGrid, area: Area) -> None:
        """Write costs around the lethal cells of an area and of its surroundings."""
        reach = self.reach(grid)
        around = area.grown(reach).clipped(*grid.shape)
        lethal = grid.values[around.slices] == LETHAL
        if not lethal.any():
            return
        squares = squares_to_nearest(lethal, reach)
        inner = Area(
            area.low - around.low, area.left - around.left, area.high - around.low, area.right - around.left
        )
        costs = self._costs_by_square(grid.resolution, reach)[squares[inner.slices]]
        below = grid.values[area.slices]
        least = FREE + 1 if self.parameters.inflate_unknown else INSCRIBED
        unknown = below == UNKNOWN
        np.copyto(below, np.maximum(below, costs), where=~unknown)
        np.copyto(below, costs, where=unknown & (costs >= least))

    def clear(self, _grid: CostGrid, _keep: Area) -> Area:
        """Do nothing: the layer stores nothing."""
        return NOWHERE

    def _costs_by_square(self, resolution: float, reach: int) -> NDArray[np.uint8]:
        """Return the cost for each squared distance in cells; the last entry is for those beyond reach."""
        if resolution != self._resolution:
            squares = np.arange(reach * reach + 2)
            costs = cost_of_distance(
                np.sqrt(squares) * resolution, self._inscribed, self.parameters.cost_scaling_factor
            )
            costs[-1] = FREE
            self._table, self._resolution = costs, resolution
        return self._table
