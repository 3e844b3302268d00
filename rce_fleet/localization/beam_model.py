"""The beam model: compares each range with the one that the map gives.

Thrun, Burgard, Fox: Probabilistic Robotics, section 6.3. As in ROS's ``amcl``, the cubes of the beams'
probabilities are added. It casts a ray for each particle and beam, which costs about a hundred times as much
as the likelihood field; with the compiled ray casting it is usable.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import transform_points
from rce_fleet.maps.ray_casting import cast_in_cells

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.localization.parameters import AmclParameters
    from rce_fleet.localization.scan import Beams
    from rce_fleet.maps.occupancy_map import OccupancyMap


class BeamModel:
    """The beam model on one map.

    Args:
        grid: The map. Beams end at everything that is not free.
        parameters: Those of the laser.
    """

    def __init__(self, grid: OccupancyMap, parameters: AmclParameters) -> None:
        self._parameters = parameters
        self._grid = grid
        self._to_map = grid.origin.inverse().as_array()
        self._solid = np.ascontiguousarray(~grid.free)

    def sums_of_cubes(self, particles: NDArray[np.float64], beams: Beams) -> NDArray[np.float64]:
        """Return the weights of particles, shape (N,), at least 1.

        Args:
            particles: shape (3, N): x, y, yaw in the world.
            beams: Those of a scan.
        """
        parameters, farthest = self._parameters, beams.range_max
        expected = self.expected(particles, beams)
        error = beams.ranges - expected
        chance = parameters.laser_z_hit * np.exp(-(error**2) / (2 * parameters.laser_sigma_hit**2))
        early = parameters.laser_lambda_short * np.exp(-parameters.laser_lambda_short * beams.ranges)
        chance += np.where(error < 0, parameters.laser_z_short * early, 0.0)
        returned = beams.returned
        chance += np.where(returned, parameters.laser_z_rand / farthest, parameters.laser_z_max)
        return np.asarray(1.0 + (chance**3).sum(axis=1))

    def expected(self, particles: NDArray[np.float64], beams: Beams) -> NDArray[np.float64]:
        """Return the ranges that the map gives, shape (N, K), metres."""
        size = self._grid.resolution
        lasers = transform_points(particles.T, (beams.laser.x, beams.laser.y))
        starts = transform_points(self._to_map, lasers) / size
        angles = (particles[2] - self._grid.origin.yaw)[:, None] + beams.angles
        count = len(beams.angles)
        cells = cast_in_cells(
            self._solid,
            np.ascontiguousarray(np.repeat(starts, count, axis=0)),
            np.ascontiguousarray(angles.reshape(-1)),
            beams.range_max / size,
        )
        return np.asarray(np.minimum(cells * size, beams.range_max).reshape(-1, count))
