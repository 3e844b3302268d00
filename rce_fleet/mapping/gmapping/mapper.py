"""Maps a log with the particle filter, and refines the result when the log is over."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.mapping.gmapping.filter import GridFilter
from rce_fleet.mapping.gmapping.motion import prior_information
from rce_fleet.mapping.gmapping.parameters import FilterParameters
from rce_fleet.mapping.occupancy_mapping import beams_of, draw_record, map_of
from rce_fleet.mapping.scan_matching import match, scores
from rce_fleet.mapping.tiles import TileStore
from rce_fleet.mapping.trajectory import complete_trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.records import LaserRecord
    from rce_fleet.maps.occupancy_map import OccupancyMap

REFINE_STD = np.array((0.05, 0.05, 0.03))
"""How far from the filter's poses scans are expected when matched with the whole map: metres, radians."""
REFINE_STEPS = 12


class ParticleMapper:
    """A mapper (:class:`rce_fleet.mapping.mapper.Mapper`) with GMapping's algorithm and parameters.

    The filter uses the scans that GMapping uses. At the end all scans are matched with the map of the best
    particle, those too that the filter left out, and the map is drawn again.

    Args:
        parameters: GMapping's.
        seed: Seed of the filter; the same seed and log give the same result.
    """

    def __init__(self, parameters: FilterParameters | None = None, *, seed: int = 0) -> None:
        self.parameters = parameters or FilterParameters()
        self.filter = GridFilter(self.parameters, np.random.default_rng(seed))
        self._records: list[LaserRecord] = []
        self._used: list[int] = []
        self._tracked: list[NDArray[np.float64]] = []
        self._refined: NDArray[np.float64] | None = None

    @property
    def loop_closures(self) -> int:
        """0: the filter closes loops without recognizing places."""
        return 0

    def add(self, record: LaserRecord) -> None:
        """Use the next scan, if the robot has moved enough since the last one.

        Raises:
            MapError: If the map would become larger than any floor: odometry or readings are wrong.
        """
        self._refined = None
        if self.filter.add(record):
            self._used.append(len(self._records))
        self._records.append(record)
        self._tracked.append(self.filter.tracked)

    def finish(self) -> None:
        """Match all scans with the best particle's map."""
        poses = self.trajectory()
        store = self.filter.store.only(self.filter.best)
        for number, record in enumerate(self._records):
            poses[number] = self._match(store, record, poses[number])
        self._refined = poses

    def trajectory(self) -> NDArray[np.float64]:
        """Return the best particle's pose at each scan, shape (N, 3)."""
        if self._refined is not None:
            return self._refined.copy()
        if not self._records:
            return np.empty((0, 3))
        return complete_trajectory(np.array(self._tracked), np.array(self._used), self.filter.path())

    def occupancy_map(self) -> OccupancyMap:
        """Return the map of the best particle, or that of all scans when they have been refined."""
        threshold = self.parameters.occupied_threshold
        if self._refined is None:
            return map_of(self.filter.store, self.filter.best, threshold)
        store = TileStore(1, self.parameters.delta)
        for record, pose in zip(self._records, self._refined, strict=True):
            draw_record(store, record, pose[None], self.filter.farthest(record))
        return map_of(store, 0, threshold)

    def _match(self, store: TileStore, record: LaserRecord, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        p = self.parameters
        _, ends, hit = beams_of(record, self.filter.farthest(record))
        beams = np.ascontiguousarray(ends[hit])
        if p.minimum_score == inf or not len(beams):
            return pose
        prior = pose[None]
        found = match(
            store,
            slice(None),
            beams,
            prior,
            prior,
            prior_information(prior[:, 2], REFINE_STD),
            sigma=p.sigma,
            iterations=REFINE_STEPS,
        )
        score = scores(store, slice(None), beams, found.poses[:, None], sigma=p.sigma)[0, 0, 0]
        return found.poses[0] if score > p.minimum_score else pose
