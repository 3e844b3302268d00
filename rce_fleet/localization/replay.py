"""Localizes a robot in a recorded log, as the node would have done it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.amcl import Amcl, Estimate
from rce_fleet.localization.parameters import AmclParameters
from rce_fleet.localization.scan import LaserScan

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from rce_fleet.maps.occupancy_map import OccupancyMap


@dataclass(frozen=True, slots=True)
class Recorded:
    """One scan of a log.

    Attributes:
        odometry: Pose of the robot by odometry when the scan was taken.
        scan: The scan.
    """

    odometry: Pose
    scan: LaserScan


@dataclass(frozen=True, slots=True)
class Localized:
    """Where the robot was at a scan.

    Attributes:
        pose: Its pose on the map: the last update's, moved on by odometry.
        estimate: What the filter found, if it used this scan.
    """

    pose: Pose
    estimate: Estimate | None


def replay(
    log: Iterable[Recorded],
    grid: OccupancyMap,
    parameters: AmclParameters | None = None,
    *,
    seed: int = 0,
    start: Pose | None = None,
    covariance: ArrayLike | None = None,
) -> Iterator[Localized]:
    """Localize the robot at every scan of a log.

    Args:
        log: Its scans, in order.
        grid: The map.
        parameters: Those of the filter; by default those of ROS's ``amcl``.
        seed: The same seed gives the same poses.
        start: The pose at the first scan; None: unknown, the robot may be anywhere on the map.
        covariance: Of ``start``, shape (3, 3); by default that of the parameters.

    Yields:
        One for each scan, in order.

    Raises:
        MapError: The map has no free cell.

    Example:
        ```python
        poses = [found.pose for found in replay(log, grid, start=Pose(0.0, 0.0, 0.0))]
        ```
    """
    chosen = AmclParameters() if parameters is None else parameters
    amcl = Amcl(grid, chosen, np.random.default_rng(seed))
    if start is None:
        amcl.scatter()
    else:
        spread = (chosen.initial_cov_xx, chosen.initial_cov_yy, chosen.initial_cov_aa)
        amcl.set_pose(start, np.diag(spread) if covariance is None else covariance)
    map_from_odom = Pose(0.0, 0.0, 0.0)
    for each in log:
        estimate = amcl.update(each.odometry, each.scan)
        if estimate is not None:
            map_from_odom = estimate.map_from_odom
        yield Localized(map_from_odom.compose(each.odometry), estimate)
