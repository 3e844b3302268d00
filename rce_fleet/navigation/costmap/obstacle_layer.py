"""The layer of what sensors see: hits mark cells, rays clear them."""

from __future__ import annotations

from math import pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose, transform_points
from rce_fleet.navigation.costmap.cost_grid import NOWHERE, Area, CostGrid, shifted
from rce_fleet.navigation.costmap.costs import FREE, LETHAL
from rce_fleet.navigation.costmap.layer import fill_of, write_known, write_larger

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.navigation.costmap.footprint import Footprint
    from rce_fleet.navigation.costmap.observation import Observation
    from rce_fleet.navigation.costmap.parameters import ObservationSource, ObstacleLayerParameters

    Floats = NDArray[np.float64]


PARTS = 255
"""Parts of a cell's edge, by which it is known where in the cell a hit was."""
MAX_KEPT = 1000
"""Observations of a source that are kept, however long it persists."""
JUMP = 1.0
"""A message that is older than the one before by more than this came after a jump of time, seconds."""


class ObstacleLayer:
    """Marks the cells of hits and clears the cells that rays pass.

    Rays are not walked cell by cell: only cells that are not free need a decision, and each is looked up in
    the ray nearest to its bearing. The ray clears the cell if it passes within the cell's half diagonal and
    reaches beyond the cell's centre.

    Args:
        parameters: Of the layer.
        sources: The sensors by name.
        footprint: The robot's outline, under which cells are cleared.
        grid: The costmap.

    Attributes:
        hits: Where in each marked cell the last hit was, shape (rows, columns, 2): x and y from the cell's
            corner in its :data:`PARTS`, counted from 1; else 0.
    """

    def __init__(
        self,
        parameters: ObstacleLayerParameters,
        sources: dict[str, ObservationSource],
        footprint: Footprint,
        grid: CostGrid,
    ) -> None:
        self.parameters = parameters
        self.sources = sources
        self._footprint = footprint
        self._fill = fill_of(track_unknown=parameters.track_unknown_space)
        self._kept: dict[str, list[Observation]] = {name: [] for name in sources}
        self.match(grid)

    def take(self, source: str, observation: Observation) -> None:
        """Take an observation of a source; it is used at the next update."""
        kept = self._kept[source]
        if kept and kept[-1].stamp - observation.stamp > JUMP:
            kept.clear()  # Time jumped back: a simulation or a bag began anew.
        kept.append(observation)
        self._drop_old(source, observation.stamp)

    def late_sources(self, now: float) -> list[str]:
        """Return the sources whose last observation is older than their ``expected_update_rate`` allows."""
        late = []
        for name, source in self.sources.items():
            kept = self._kept[name]
            newest = max((one.stamp for one in kept), default=-np.inf)
            if source.expected_update_rate > 0 and now - newest > source.expected_update_rate:
                late.append(name)
        return late

    # The layer

    def match(self, grid: CostGrid) -> None:
        """Begin with nothing marked."""
        self._costs: NDArray[np.uint8] = np.full(grid.shape, self._fill, np.uint8)
        # Zeros: memory of parts that no sensor reaches is not used.
        self.hits: NDArray[np.uint8] = np.zeros((*grid.shape, 2), np.uint8)

    def move(self, _grid: CostGrid, rows: int, columns: int) -> None:
        """Shift the marks."""
        self._costs = shifted(self._costs, rows, columns, self._fill)
        self.hits = shifted(self.hits, rows, columns, 0)

    def update_bounds(self, grid: CostGrid, robot: Pose, now: float) -> Area:
        """Clear and mark by the observations that are kept; return what may have changed."""
        changed = NOWHERE
        observations = []
        for name, kept in self._kept.items():
            self._drop_old(name, now)
            observations += [(self.sources[name], one) for one in kept]
        for source, one in observations:
            changed = changed.joined(self._clear_rays(grid, one, source.raytrace_min_range))
        for _, one in observations:
            changed = changed.joined(self._mark(grid, one.hits))
        if self.parameters.footprint_clearing_enabled:
            changed = changed.joined(self._clear_footprint(grid, robot))
        return changed

    def update_costs(self, grid: CostGrid, area: Area) -> None:
        """Write the marks."""
        write = write_larger if self.parameters.combination_method else write_known
        write(grid.values[area.slices], self._costs[area.slices])

    def clear(self, grid: CostGrid, keep: Area) -> Area:
        """Forget the marks outside an area, and the observations; return the cells that had marks."""
        inside = keep.clipped(*grid.shape)
        marked = _bounds_of(self._costs != self._fill)
        costs, hits = self._costs, self.hits
        self.match(grid)
        self._costs[inside.slices], self.hits[inside.slices] = costs[inside.slices], hits[inside.slices]
        for kept in self._kept.values():
            kept.clear()
        return marked

    def _drop_old(self, source: str, now: float) -> None:
        """Leave a source's newest observation, and with a persistence those that are younger than it."""
        kept, persistence = self._kept[source], self.sources[source].observation_persistence
        newest = max(kept, key=lambda one: one.stamp, default=None)
        if newest is None:
            return
        if persistence > 0:
            kept[:] = [one for one in kept if one.stamp >= min(now - persistence, newest.stamp)][-MAX_KEPT:]
        else:  # Of several with its stamp, as while simulated time stands still, the last.
            kept[:] = [[one for one in kept if one.stamp == newest.stamp][-1]]

    def _clear_rays(self, grid: CostGrid, seen: Observation, nearest: float) -> Area:
        if not len(seen.bearings):
            return NOWHERE
        area = grid.area_around(seen.x, seen.y, float(seen.reach.max()))
        filled = self._costs[area.slices] != FREE
        rows, columns = np.nonzero(filled)
        if not len(rows):
            return NOWHERE
        cells = np.stack((rows + area.low, columns + area.left), axis=1)
        passed = passed_by_rays(grid.centres_of(cells), seen, grid.resolution, nearest)
        if not passed.any():
            return NOWHERE
        rows, columns = cells[passed].T
        self._costs[rows, columns], self.hits[rows, columns] = FREE, 0
        return _bounds(cells[passed])

    def _mark(self, grid: CostGrid, hits: Floats) -> Area:
        cells = grid.cells_of(hits)
        inside = grid.contains(cells)
        if not inside.any():
            return NOWHERE
        rows, columns = cells[inside].T
        parts = (hits[inside] - grid.corners_of(cells[inside])) * (PARTS / grid.resolution)
        self._costs[rows, columns] = LETHAL
        self.hits[rows, columns] = 1 + np.clip(parts, 0, PARTS - 1)
        return _bounds(cells[inside])

    def _clear_footprint(self, grid: CostGrid, robot: Pose) -> Area:
        area = grid.area_around(robot.x, robot.y, self._footprint.circumscribed_radius)
        rows, columns = np.nonzero(self._costs[area.slices] != FREE)
        if not len(rows):
            return NOWHERE
        cells = np.stack((rows + area.low, columns + area.left), axis=1)
        local = transform_points(robot.inverse().as_array(), grid.centres_of(cells))
        under = self._footprint.distances(local) < 0
        if not under.any():
            return NOWHERE
        rows, columns = cells[under].T
        self._costs[rows, columns], self.hits[rows, columns] = FREE, 0
        return _bounds(cells[under])


def passed_by_rays(
    centres: Floats, seen: Observation, resolution: float, nearest: float = 0.0
) -> NDArray[np.bool_]:
    """Return through which cells a sensor saw, shape (N,).

    Args:
        centres: Centres of the cells, shape (N, 2), metres.
        seen: The observation, with at least one ray.
        resolution: Edge of a cell, metres.
        nearest: Cells nearer to the sensor than this are not passed, metres.
    """
    dx, dy = centres[:, 0] - seen.x, centres[:, 1] - seen.y
    away, bearing = np.hypot(dx, dy), np.arctan2(dy, dx)
    count = len(seen.bearings)
    after = np.searchsorted(seen.bearings, bearing)
    before, after = (after - 1) % count, after % count
    off_before = np.abs((bearing - seen.bearings[before] + pi) % (2 * pi) - pi)
    off_after = np.abs((bearing - seen.bearings[after] + pi) % (2 * pi) - pi)
    ray = np.where(off_before <= off_after, before, after)
    off = np.minimum(off_before, off_after)
    half_diagonal = resolution / sqrt(2)
    meets = (np.sin(np.minimum(off, pi / 2)) * away <= half_diagonal) | (away <= half_diagonal)
    return np.asarray(meets & (seen.reach[ray] > away + resolution / 2) & (away >= nearest))


def _bounds(cells: NDArray[np.intp]) -> Area:
    low, left = cells.min(axis=0)
    high, right = cells.max(axis=0)
    return Area(int(low), int(left), int(high) + 1, int(right) + 1)


def _bounds_of(mask: NDArray[np.bool_]) -> Area:
    """Return the smallest area with all cells that are set, shape (rows, columns)."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return NOWHERE
    return Area(int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1)


def lethal_points(grid: CostGrid, layer: ObstacleLayer | None, area: Area) -> Floats:
    """Return a point for each lethal cell of an area, shape (M, 2), metres.

    The point is the one that a sensor hit, else the cell's centre.
    """
    rows, columns = np.nonzero(grid.values[area.slices] == LETHAL)
    if not len(rows):
        return np.empty((0, 2))
    cells = np.stack((rows + area.low, columns + area.left), axis=1)
    points = grid.centres_of(cells)
    if layer is None:
        return points
    parts = layer.hits[cells[:, 0], cells[:, 1]]
    hits = grid.corners_of(cells) + (parts - 0.5) * (grid.resolution / PARTS)
    return np.where(parts > 0, hits, points)
