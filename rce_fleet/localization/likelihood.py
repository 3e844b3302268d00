"""The likelihood field: how probable it is that beams end where they would, seen from each particle.

Thrun, Burgard, Fox: Probabilistic Robotics, section 6.4. As in ROS's ``amcl``, ``likelihood_field`` adds the
cubes of the beams' probabilities (beams are far from independent). ``likelihood_field_prob`` multiplies the
probabilities, and can leave out beams that contradict the map.
"""

from __future__ import annotations

from math import ceil, cos, sin
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel
from rce_fleet.maps.distance import squares_to_nearest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.localization.parameters import AmclParameters
    from rce_fleet.localization.scan import Beams
    from rce_fleet.maps.distance import Squares
    from rce_fleet.maps.occupancy_map import OccupancyMap

_AT_ONCE = 16_000
"""Ends of beams that are looked up at a time in numpy: larger arrays leave the cache, and their memory
is made anew by the kernel each time."""
_TABLES = 8
"""Tables that are kept: one or two for each laser with a range of its own."""


class LikelihoodField:
    """The field of one map.

    Args:
        grid: The map.
        parameters: Those of the laser.
    """

    def __init__(self, grid: OccupancyMap, parameters: AmclParameters) -> None:
        self._parameters = parameters
        self._resolution = grid.resolution
        self._to_map = grid.origin.inverse().as_array()
        farthest = parameters.laser_likelihood_max_dist
        reach = min(ceil(farthest / grid.resolution), grid.rows + grid.columns)
        # One cell more on each side stands for everything outside.
        self._squares = np.pad(squares_to_nearest(grid.occupied, reach), 1, constant_values=reach**2 + 1)
        self._distances = np.minimum(np.sqrt(np.arange(reach**2 + 2)) * grid.resolution, farthest)
        self._distances[-1] = farthest
        self._tables: dict[tuple[str, float], NDArray[np.float64]] = {}

    def sums_of_cubes(self, particles: NDArray[np.float64], beams: Beams) -> NDArray[np.float64]:
        """Return the weights of the model ``likelihood_field``.

        Args:
            particles: shape (3, N): x, y, yaw in the world.
            beams: Those of a scan.

        Returns:
            shape (N,), at least 1.
        """
        return 1.0 + self._sum(self._table("cube", beams.range_max), particles, beams.ends)

    def log_products(
        self, particles: NDArray[np.float64], beams: Beams, *, skip: bool = False
    ) -> NDArray[np.float64]:
        """Return the logarithms of the weights of the model ``likelihood_field_prob``, shape (N,).

        Args:
            particles: shape (3, N): x, y, yaw in the world.
            beams: Those of a scan.
            skip: Leave out beams that most particles contradict.
        """
        ends = beams.ends
        if skip and ends.size:
            ends = ends[:, self._agreeing(particles, ends)]
        return self._sum(self._table("log", beams.range_max), particles, ends)

    def _sum(
        self, table: NDArray[np.float64], particles: NDArray[np.float64], ends: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        places = np.ascontiguousarray(particles), np.ascontiguousarray(ends)
        return sum_at_ends(table, self._squares, *places, self._to_map, self._resolution)

    def _agreeing(self, particles: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.bool_]:
        parameters = self._parameters
        rows, columns = _cells(particles, ends, self._to_map, self._resolution, self._squares.shape)
        near = self._distances[self._squares[rows, columns]] < parameters.beam_skip_distance
        agrees = near.mean(axis=0) > parameters.beam_skip_threshold
        if (~agrees).mean() >= parameters.beam_skip_error_threshold:
            return np.ones_like(agrees)
        return np.asarray(agrees)

    def _table(self, form: str, range_max: float) -> NDArray[np.float64]:
        """Return what a beam adds that ends in a cell, by the square of the cell's distance in cells."""
        key = (form, range_max)
        if key not in self._tables:
            parameters = self._parameters
            sigma = parameters.laser_sigma_hit
            hit = np.exp(-(self._distances**2) / (2 * sigma * sigma))
            chance = parameters.laser_z_hit * hit + parameters.laser_z_rand / range_max
            if len(self._tables) >= _TABLES:
                self._tables.clear()
            self._tables[key] = chance**3 if form == "cube" else np.log(np.maximum(chance, 1e-300))
        return self._tables[key]


def _cells(
    particles: NDArray[np.float64],
    ends: NDArray[np.float64],
    to_map: NDArray[np.float64],
    resolution: float,
    shape: tuple[int, ...],
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the beams' ends in a padded table, shape (N, K), clipped to it."""
    x, y, yaw = particles
    turn_c, turn_s = cos(to_map[2]), sin(to_map[2])
    c, s = np.cos(yaw + to_map[2]), np.sin(yaw + to_map[2])
    inverse = 1.0 / resolution
    local_x = (to_map[0] + turn_c * x - turn_s * y) * inverse + 1.0
    local_y = (to_map[1] + turn_s * x + turn_c * y) * inverse + 1.0
    across = np.empty((3, len(x)))
    up = np.empty((3, len(x)))
    across[0], across[1], across[2] = local_x, c, -s
    up[0], up[1], up[2] = local_y, s, c
    beams = np.ones((3, ends.shape[1]))
    np.multiply(ends, inverse, out=beams[1:])
    columns, rows = across.T @ beams, up.T @ beams
    for places, last in ((columns, shape[1] - 1), (rows, shape[0] - 1)):
        np.maximum(places, 0.0, out=places)
        np.minimum(places, last, out=places)
    return rows.astype(np.intp), columns.astype(np.intp)


def _sum_numpy(
    table: NDArray[np.float64],
    squares: Squares,
    particles: NDArray[np.float64],
    ends: NDArray[np.float64],
    to_map: NDArray[np.float64],
    resolution: float,
) -> NDArray[np.float64]:
    flat = squares.reshape(-1)
    sums = np.empty(particles.shape[1])
    step = max(_AT_ONCE // max(ends.shape[1], 1), 1)
    for first in range(0, len(sums), step):
        part = particles[:, first : first + step]
        rows, columns = _cells(part, ends, to_map, resolution, squares.shape)
        rows *= squares.shape[1]
        rows += columns
        table.take(flat.take(rows)).sum(axis=1, out=sums[first : first + step])
    return sums


@kernel(
    "float64[::1](float64[::1], uint16[:,::1], float64[:,::1], float64[:,::1], float64[::1], float64)",
    "float64[::1](float64[::1], uint32[:,::1], float64[:,::1], float64[:,::1], float64[::1], float64)",
    numpy=_sum_numpy,
)
def sum_at_ends(
    table: NDArray[np.float64],
    squares: Squares,
    particles: NDArray[np.float64],
    ends: NDArray[np.float64],
    to_map: NDArray[np.float64],
    resolution: float,
) -> NDArray[np.float64]:
    """Return the sums of a table's values where beams end.

    Args:
        table: shape (S,): values by the squares of distances, in cells.
        squares: shape (rows + 2, columns + 2), below S: the squares of the map's cells, and one more on each
            side for what is outside.
        particles: shape (3, N): x, y, yaw in the world.
        ends: shape (2, K): ends of the beams in the frame of the particle, metres.
        to_map: shape (3,): pose of the world in the map's own frame.
        resolution: Edge of a cell, metres.

    Returns:
        shape (N,).
    """
    last_row, last_column = squares.shape[0] - 1.0, squares.shape[1] - 1.0
    turn_c, turn_s = np.cos(to_map[2]), np.sin(to_map[2])
    inverse = 1.0 / resolution
    width, flat = squares.shape[1], squares.reshape(squares.size)
    # First the cells, then the values: a loop without look-ups is compiled to vector instructions.
    cells = np.empty(ends.shape[1], np.int32)
    result = np.empty(particles.shape[1])
    for i in range(particles.shape[1]):
        x, y = particles[0, i], particles[1, i]
        c, s = np.cos(particles[2, i] + to_map[2]) * inverse, np.sin(particles[2, i] + to_map[2]) * inverse
        local_x = (to_map[0] + turn_c * x - turn_s * y) * inverse + 1.0
        local_y = (to_map[1] + turn_s * x + turn_c * y) * inverse + 1.0
        for k in range(ends.shape[1]):
            column = min(max(local_x + c * ends[0, k] - s * ends[1, k], 0.0), last_column)
            row = min(max(local_y + s * ends[0, k] + c * ends[1, k], 0.0), last_row)
            cells[k] = np.int32(row) * np.int32(width) + np.int32(column)
        total = 0.0
        for k in range(ends.shape[1]):
            total += table[flat[np.uint32(cells[k])]]  # unsigned: no look whether the index is negative
        result[i] = total
    return result
