"""Whether a scan contradicts the map, or things that are not on the map explain it.

A thing that is not on the map (a person, another robot, a box) makes ranges shorter than the map says, never
longer. After the distance filter of Fox, Burgard and Thrun, "Markov localization for mobile robots in dynamic
environments", JAIR 11 (1999), section 3.3.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose, transform_points
from rce_fleet.maps.ray_casting import cast_rays

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.localization.scan import Beams
    from rce_fleet.maps.occupancy_map import OccupancyMap

MARGIN_M = 0.3
"""A range that differs from the map's by less than this, metres..."""
MARGIN_SHARE = 0.05
"""... plus this share of it fits."""
THROUGH = 0.1
"""The map is contradicted if more than this share of the beams went through its walls..."""
FITTING = 0.3
"""... or less than this share ended at them."""


def contradicts_map(grid: OccupancyMap, pose: Pose, beams: Beams) -> bool:
    """Return whether a scan, taken at a pose, contradicts the map.

    Args:
        grid: The map.
        pose: Where the robot would be on it.
        beams: Those of the scan. Beams that hit nothing say nothing: glass and black things return nothing.
    """
    through, fitting = explained_shares(grid, pose, beams)
    return through > THROUGH or fitting < FITTING


def explained_shares(grid: OccupancyMap, pose: Pose, beams: Beams) -> tuple[float, float]:
    """Return the shares of beams that went through walls of the map, and that ended at them.

    Args:
        grid: The map.
        pose: Where the robot would be on it.
        beams: Those of the scan; without any that hit something the shares are 0 and 1.
    """
    hit = beams.returned
    if not hit.any():
        return 0.0, 1.0
    ranges: NDArray[np.float64] = beams.ranges[hit]
    origin = transform_points(pose.as_array(), np.array(((beams.laser.x, beams.laser.y),)))[0]
    expected = cast_rays(grid, origin, beams.angles[hit] + pose.yaw, beams.range_max)
    margin = MARGIN_M + MARGIN_SHARE * expected
    through = ranges > expected + margin
    fitting = np.abs(ranges - expected) <= margin
    return float(through.mean()), float(fitting.mean())
