"""The layer of the map."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.cost_grid import NOWHERE, Area, CostGrid
from rce_fleet.navigation.costmap.costs import UNKNOWN, from_occupancy
from rce_fleet.navigation.costmap.layer import write_known, write_larger

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.maps.occupancy_map import OccupancyMap
    from rce_fleet.navigation.costmap.parameters import StaticLayerParameters


class StaticLayer:
    """Costs from a map.

    The map may have another resolution than the costmap, and may lie askew in it, for a costmap in another
    frame or a map with a rotated origin: then each cell gets the cost at its centre.

    Args:
        parameters: How pixels become costs.

    Attributes:
        map_from_grid: Pose of the costmap's frame in the map's frame.
    """

    def __init__(self, parameters: StaticLayerParameters) -> None:
        self.parameters = parameters
        self.map_from_grid = Pose(0.0, 0.0, 0.0)
        self._map: CostGrid | None = None
        self._origin_yaw = 0.0
        self._changed = False

    @property
    def has_map(self) -> bool:
        """Whether a map was set."""
        return self._map is not None

    def set_map(self, picture: OccupancyMap) -> None:
        """Set the map."""
        origin = picture.origin
        made = CostGrid(picture.rows, picture.columns, picture.resolution, (origin.x, origin.y))
        made.values = self._costs(picture.data)
        self._map, self._origin_yaw, self._changed = made, origin.yaw, True

    def update_map(self, values: NDArray[np.int8], row: int, column: int) -> None:
        """Replace a part of the map, as ``map_msgs/OccupancyGridUpdate`` does.

        Raises:
            ValueError: There is no map yet, or the part is not inside it.
        """
        if self._map is None:
            raise ValueError("an update of a map came before the map")
        area = Area(row, column, row + values.shape[0], column + values.shape[1])
        if area != area.clipped(*self._map.shape):
            raise ValueError(f"an update of {area} lies outside the map of {self._map.shape} cells")
        self._map.values[area.slices] = self._costs(values)
        self._changed = True

    def _costs(self, values: NDArray[np.int8]) -> NDArray[np.uint8]:
        return from_occupancy(
            values,
            lethal_threshold=self.parameters.lethal_cost_threshold,
            unknown_value=self.parameters.unknown_cost_value,
            track_unknown=self.parameters.track_unknown_space,
            trinary=self.parameters.trinary_costmap,
        )

    def place(self, at: Pose) -> None:
        """Set the pose of the costmap's frame in the map's frame, for a costmap in another frame."""
        if at != self.map_from_grid:
            self.map_from_grid, self._changed = at, True

    # The layer

    def match(self, _grid: CostGrid) -> None:
        """Write everything anew at the next update."""
        self._changed = True

    def move(self, _grid: CostGrid, _rows: int, _columns: int) -> None:
        """Write everything anew at the next update."""
        self._changed = True

    def update_bounds(self, grid: CostGrid, _robot: Pose, _now: float) -> Area:
        """Return all cells if the map is new, or lies elsewhere in the costmap."""
        if self._map is None or not self._changed:
            return NOWHERE
        self._changed = False
        return grid.whole

    def update_costs(self, grid: CostGrid, area: Area) -> None:
        """Write the map's costs; those of cells outside the map are unknown."""
        if self._map is None or area.is_empty:
            return
        write = write_larger if self.parameters.use_maximum else write_known
        write(grid.values[area.slices], self._sampled(self._map, grid, area))

    def clear(self, _grid: CostGrid, _keep: Area) -> Area:
        """Do nothing: a map is not forgotten."""
        return NOWHERE

    def _sampled(self, picture: CostGrid, grid: CostGrid, area: Area) -> NDArray[np.uint8]:
        if self._is_aligned(picture, grid):
            return picture.values[area.slices]
        rows, columns = np.mgrid[area.slices]
        centres = grid.centres_of(np.stack((rows.reshape(-1), columns.reshape(-1)), axis=1))
        at, (left, low) = self.map_from_grid, picture.origin
        x, y = _turned(centres[:, 0], centres[:, 1], at.yaw)
        x, y = _turned(x + at.x - left, y + at.y - low, -self._origin_yaw)
        points = np.stack((x + left, y + low), axis=1)
        return picture.costs_at(points, outside=UNKNOWN).reshape(rows.shape)

    def _is_aligned(self, picture: CostGrid, grid: CostGrid) -> bool:
        return (
            self.map_from_grid == Pose(0.0, 0.0, 0.0)
            and not self._origin_yaw
            and picture.shape == grid.shape
            and picture.resolution == grid.resolution
            and picture.origin == grid.origin
        )


def _turned(
    x: NDArray[np.float64], y: NDArray[np.float64], angle: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    c, s = cos(angle), sin(angle)
    return c * x - s * y, s * x + c * y
