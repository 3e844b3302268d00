"""What localization and navigation keep, and take for a moment, for each cell of a large map."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.amcl import Amcl
from rce_fleet.localization.parameters import AmclParameters
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.layered import LayeredCostmap
from rce_fleet.navigation.costmap.parameters import (
    CostmapParameters,
    InflationParameters,
    ObservationSource,
    ObstacleLayerParameters,
    StaticLayerParameters,
)
from rce_fleet.navigation.obstacle_cells.watch import CellWatch, WatchParameters
from rce_fleet.navigation.planners.global_planner import make_plan

SIZE = 2000
"""Rows and columns: 100 m x 100 m with cells of 5 cm."""


PLANNED = 600
"""The same of a map for a plan, which takes more."""


def large_map(size: int = SIZE) -> OccupancyMap:
    """A floor with a pillar every five metres."""
    data = np.zeros((size, size), np.int8)
    data[::100, ::100] = 100
    return OccupancyMap(data, 0.05)


def bytes_per_cell(make: Callable[[], object], size: int = SIZE) -> tuple[float, float]:
    """Return what is kept of what ``make`` returns, and what it takes at most meanwhile."""
    tracemalloc.start()
    try:
        made = make()
        kept, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert made is not None
    return kept / size**2, most / size**2


def test_localization_keeps_four_bytes_for_each_cell() -> None:
    """Masks of free and occupied cells, and a squared distance of two bytes."""
    grid = large_map()
    kept, most = bytes_per_cell(lambda: Amcl(grid, AmclParameters(), np.random.default_rng(1)))
    assert kept < 4.5
    assert most < 14


def test_a_costmap_keeps_five_bytes_for_each_cell() -> None:
    """The costs, those of the map, and of what sensors saw the cost and the place of the hit."""
    grid = large_map()
    parameters = CostmapParameters(
        static_layer=StaticLayerParameters(),
        obstacle_layer=ObstacleLayerParameters(),
        inflation_layer=InflationParameters(),
        sources={"scan": ObservationSource()},
    )

    def make() -> LayeredCostmap:
        costmap = LayeredCostmap(parameters, Footprint(0.2))
        costmap.set_map(grid)
        costmap.update(Pose(50.0, 50.0, 0.0), 1.0)
        return costmap

    kept, most = bytes_per_cell(make)
    assert kept < 5.5
    assert most < 16


@pytest.mark.slow
def test_a_plan_over_a_whole_map_takes_a_quarter_of_a_kilobyte_for_each_cell() -> None:
    """In numpy, most of it for scipy's edges; the compiled loop takes 17 bytes."""
    costmap = LayeredCostmap(CostmapParameters(static_layer=StaticLayerParameters()), Footprint(0.2))
    costmap.set_map(large_map(PLANNED))
    costmap.update(Pose(15.0, 15.0, 0.0), 1.0)
    ends = Pose(2.5, 2.5, 0.0), Pose(7.5, 27.5, 0.0)
    _, most = bytes_per_cell(lambda: make_plan(costmap.grid, *ends).path, PLANNED)
    assert most < 280


def test_a_watch_of_cells_keeps_two_bytes_for_each_cell_of_the_map() -> None:
    grid = large_map()
    fleet = OccupancyMap(np.zeros((10, 10), np.int8), 1.0)
    kept, _ = bytes_per_cell(lambda: CellWatch(fleet, WatchParameters(), grid))
    assert kept < 2.5
