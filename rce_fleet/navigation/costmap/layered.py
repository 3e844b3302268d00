"""A costmap of layers: a static one of the size of a map, or one that rolls with the robot."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import transform_points
from rce_fleet.navigation.costmap.cost_grid import NOWHERE, Area, CostGrid, shift_of
from rce_fleet.navigation.costmap.inflation_layer import InflationLayer
from rce_fleet.navigation.costmap.layer import Layer, fill_of
from rce_fleet.navigation.costmap.obstacle_layer import ObstacleLayer, lethal_points
from rce_fleet.navigation.costmap.static_layer import StaticLayer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.geometry.poses import Pose
    from rce_fleet.maps.occupancy_map import OccupancyMap
    from rce_fleet.navigation.costmap.footprint import Footprint
    from rce_fleet.navigation.costmap.parameters import CostmapParameters


class LayeredCostmap:
    """Costs of the cells around a robot, or of a whole map.

    Args:
        parameters: Size, frame and layers.
        footprint: The robot's outline, with its padding.

    Attributes:
        grid: The costs.
        static: The layer of the map, if it is used.
        obstacles: The layer of what sensors see, if it is used.
        inflation: The layer of costs around obstacles, if it is used.
    """

    def __init__(self, parameters: CostmapParameters, footprint: Footprint) -> None:
        self.parameters = parameters
        self.footprint = footprint
        self.static = self.obstacles = self.inflation = None
        size = parameters.resolution
        self._fill = fill_of(track_unknown=parameters.track_unknown_space)
        self.grid = CostGrid(
            max(ceil(parameters.height / size - 1e-9), 1),
            max(ceil(parameters.width / size - 1e-9), 1),
            size,
            (parameters.origin_x, parameters.origin_y),
            fill=self._fill,
        )
        self._layers: list[Layer] = []
        if parameters.static_layer is not None and parameters.static_layer.enabled:
            self.static = StaticLayer(parameters.static_layer)
            self._layers.append(self.static)
        if parameters.obstacle_layer is not None and parameters.obstacle_layer.enabled:
            self.obstacles = ObstacleLayer(
                parameters.obstacle_layer, parameters.sources, footprint, self.grid
            )
            self._layers.append(self.obstacles)
        if parameters.inflation_layer is not None and parameters.inflation_layer.enabled:
            self.inflation = InflationLayer(parameters.inflation_layer, footprint.inscribed_radius)
        self._outdated = self.grid.whole

    static: StaticLayer | None
    obstacles: ObstacleLayer | None
    inflation: InflationLayer | None

    @property
    def is_ready(self) -> bool:
        """Whether the map is there, if one is used."""
        return self.static is None or self.static.has_map

    def set_map(self, picture: OccupancyMap) -> None:
        """Set the map; a costmap that does not roll takes on its resolution, and covers all of it."""
        if self.static is None:
            return
        self.static.set_map(picture)
        size, place = _box_of(picture)
        same = (size, picture.resolution, place) == (self.grid.shape, self.grid.resolution, self.grid.origin)
        if not self.parameters.rolling_window and not same:
            self.grid = CostGrid(*size, picture.resolution, place, fill=self._fill)
            for layer in self._layers:
                layer.match(self.grid)
            self._outdated = self.grid.whole

    def update(self, robot: Pose, now: float) -> Area:
        """Bring the costs up to date.

        Args:
            robot: Pose of the robot in the costmap's frame; a rolling costmap moves there.
            now: Time, seconds.

        Returns:
            The cells whose costs may have changed.
        """
        grid = self.grid
        if self.parameters.rolling_window:
            self._roll(robot)
        changed = self._outdated
        self._outdated = NOWHERE
        for layer in self._layers:
            changed = changed.joined(layer.update_bounds(grid, robot, now))
        if self.inflation is not None:
            changed = changed.grown(self.inflation.reach(grid))
        changed = changed.clipped(*grid.shape)
        if changed.is_empty:
            return NOWHERE
        # Costs spread from lethal cells outside the area too, which stay as they are.
        grid.values[changed.slices] = self._fill
        for layer in self._layers:
            layer.update_costs(grid, changed)
        if self.inflation is not None:
            self.inflation.update_costs(grid, changed)
        return changed

    def clear(self, keep: Area = NOWHERE) -> None:
        """Forget what sensors saw outside an area; without one everywhere. The map stays."""
        for layer in self._layers:
            self._outdated = self._outdated.joined(layer.clear(self.grid, keep))

    def clear_outside(self, robot: Pose, side: float) -> None:
        """Forget what sensors saw outside a square of edge ``side`` (metres) around the robot."""
        self.clear(self.grid.area_around(robot.x, robot.y, side / 2))

    def obstacles_near(self, x: float, y: float, reach: float) -> NDArray[np.float64]:
        """Return the points of obstacles within a square of half edge ``reach``, shape (M, 2), metres."""
        return lethal_points(self.grid, self.obstacles, self.grid.area_around(x, y, reach))

    def _roll(self, robot: Pose) -> None:
        grid = self.grid
        rows, columns = shift_of(grid.origin, (robot.x, robot.y), grid.shape, grid.resolution)
        if not rows and not columns:
            return
        left, low = grid.origin
        grid.origin = (left + columns * grid.resolution, low + rows * grid.resolution)
        for layer in self._layers:
            layer.move(grid, rows, columns)
        self._outdated = grid.whole


def _box_of(picture: OccupancyMap) -> tuple[tuple[int, int], tuple[float, float]]:
    """Return rows and columns, and the outer corner of cell (0, 0), of the upright box around a map."""
    origin, size = picture.origin, picture.resolution
    if not origin.yaw:
        return (picture.rows, picture.columns), (origin.x, origin.y)
    width, height = picture.size
    corners = np.array(((0.0, 0.0), (width, 0.0), (width, height), (0.0, height)))
    turned = transform_points(origin.as_array(), corners)
    low, extent = turned.min(axis=0), np.ptp(turned, axis=0)
    columns, rows = (ceil(each / size - 1e-6) for each in extent)
    return (rows, columns), (float(low[0]), float(low[1]))
