"""The likelihood field: how probable it is that beams end where they would, seen from each particle.

Thrun, Burgard, Fox: Probabilistic Robotics, section 6.4. As in ROS's ``amcl``, ``likelihood_field`` adds the
cubes of the beams' probabilities (beams are far from independent). ``likelihood_field_prob`` multiplies the
probabilities, and can leave out beams that contradict the map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import kernel
from rce_fleet.geometry.poses import transform_points
from rce_fleet.maps.distance import distance_field

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.localization.parameters import AmclParameters
    from rce_fleet.localization.scan import Beams
    from rce_fleet.maps.occupancy_map import OccupancyMap


class LikelihoodField:
    """The field of one map.

    Args:
        grid: The map.
        parameters: Those of the laser.
    """

    def __init__(self, grid: OccupancyMap, parameters: AmclParameters) -> None:
        self._parameters = parameters
        self._resolution = grid.resolution
        self._yaw = grid.origin.yaw
        self._to_map = grid.origin.inverse().as_array()
        farthest = parameters.laser_likelihood_max_dist
        # One cell more on each side stands for everything outside.
        self._distance = np.pad(distance_field(grid, farthest), 1, constant_values=farthest)
        self._tables: dict[tuple[str, float], NDArray[np.float64]] = {}

    def sums_of_cubes(self, particles: NDArray[np.float64], beams: Beams) -> NDArray[np.float64]:
        """Return the weights of the model ``likelihood_field``.

        Args:
            particles: shape (3, N): x, y, yaw in the world.
            beams: Those of a scan.

        Returns:
            shape (N,), at least 1.
        """
        table = self._table("cube", beams.range_max)
        return 1.0 + sum_at_ends(table, self._local(particles), beams.ends() / self._resolution)

    def log_products(
        self, particles: NDArray[np.float64], beams: Beams, *, skip: bool = False
    ) -> NDArray[np.float64]:
        """Return the logarithms of the weights of the model ``likelihood_field_prob``, shape (N,).

        Args:
            particles: shape (3, N): x, y, yaw in the world.
            beams: Those of a scan.
            skip: Leave out beams that most particles contradict.
        """
        ends = beams.ends() / self._resolution
        local = self._local(particles)
        if skip and ends.size:
            ends = ends[:, self._agreeing(local, ends)]
        return sum_at_ends(self._table("log", beams.range_max), local, ends)

    def _agreeing(self, local: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.bool_]:
        parameters = self._parameters
        rows, columns = _cells(local, ends, self._distance.shape)
        near = self._distance[rows, columns] < parameters.beam_skip_distance
        agrees = near.mean(axis=0) > parameters.beam_skip_threshold
        if (~agrees).mean() >= parameters.beam_skip_error_threshold:
            return np.ones_like(agrees)
        return np.asarray(agrees)

    def _local(self, particles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return shape (4, N): x, y in cells of the padded table, cosine and sine of yaw on the map."""
        places = transform_points(self._to_map, particles[:2].T)
        local = np.empty((4, particles.shape[1]))
        local[:2] = places.T / self._resolution + 1.0
        heading = particles[2] - self._yaw
        np.cos(heading, out=local[2])
        np.sin(heading, out=local[3])
        return local

    def _table(self, form: str, range_max: float) -> NDArray[np.float64]:
        """Return what a beam that ends in a cell adds; shape (rows + 2, columns + 2)."""
        key = (form, range_max)
        if key not in self._tables:
            parameters = self._parameters
            sigma = parameters.laser_sigma_hit
            hit = np.exp(-(self._distance**2) / (2 * sigma * sigma))
            chance = parameters.laser_z_hit * hit + parameters.laser_z_rand / range_max
            self._tables = {}  # a robot has one laser; several take turns rarely
            self._tables[key] = chance**3 if form == "cube" else np.log(np.maximum(chance, 1e-300))
        return self._tables[key]


def _cells(
    local: NDArray[np.float64], ends: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the beams' ends, shape (N, K), clipped to the table."""
    x, y, c, s = local
    across = np.stack((x, c, -s), axis=1) @ np.stack((np.ones_like(ends[0]), ends[0], ends[1]))
    up = np.stack((y, s, c), axis=1) @ np.stack((np.ones_like(ends[0]), ends[0], ends[1]))
    for places, last in ((across, shape[1] - 1), (up, shape[0] - 1)):
        np.maximum(places, 0.0, out=places)
        np.minimum(places, last, out=places)
    return up.astype(np.intp), across.astype(np.intp)


def _sum_numpy(
    table: NDArray[np.float64], local: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    rows, columns = _cells(local, ends, table.shape)
    rows *= table.shape[1]
    rows += columns
    return np.asarray(table.reshape(-1).take(rows).sum(axis=1))


@kernel("float64[::1](float64[:,::1], float64[:,::1], float64[:,::1])", numpy=_sum_numpy)
def _sum_loop(
    table: NDArray[np.float64], local: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    last_row, last_column = table.shape[0] - 1.0, table.shape[1] - 1.0
    result = np.empty(local.shape[1])
    for i in range(local.shape[1]):
        x, y, c, s = local[0, i], local[1, i], local[2, i], local[3, i]
        total = 0.0
        for k in range(ends.shape[1]):
            column = x + c * ends[0, k] - s * ends[1, k]
            row = y + s * ends[0, k] + c * ends[1, k]
            total += table[int(min(max(row, 0.0), last_row)), int(min(max(column, 0.0), last_column))]
        result[i] = total
    return result


def sum_at_ends(
    table: NDArray[np.float64], local: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sums of a table's values where beams end.

    Args:
        table: shape (rows, columns); its outer cells stand for everything outside.
        local: shape (4, N): x, y (in cells), cosine and sine of each particle.
        ends: shape (2, K): ends of the beams in the frame of the particle, in cells.

    Returns:
        shape (N,).
    """
    return _sum_loop(table, local, np.ascontiguousarray(ends))
