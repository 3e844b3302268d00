"""Occupancy grids from scans with known poses, and from counts of hits and visits, by GMapping's rule."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose, transform_points
from rce_fleet.mapping.draw_kernels import register
from rce_fleet.mapping.tiles import TileStore
from rce_fleet.maps.occupancy_map import FREE, OCCUPIED, UNKNOWN, OccupancyMap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rce_fleet.mapping.records import LaserRecord

OCCUPIED_SHARE = 0.25
"""Cells that were hit in more than this share of visits are occupied (GMapping's ``occ_thresh``)."""
BORDER = 10
"""Unknown cells around what was seen."""


def draw_record(store: TileStore, record: LaserRecord, poses: NDArray[np.float64], farthest: float) -> None:
    """Draw a scan into all maps of a store.

    Args:
        store: The maps; they grow if need be.
        record: The scan.
        poses: shape (maps, 3): pose of the base in each map.
        farthest: Readings beyond are free up to here, metres.

    Raises:
        MapError: If a map would become larger than any floor.
    """
    laser, ends, hit = beams_of(record, farthest)
    if not len(ends):
        return
    # The laser's place first, so that the tables cover it too.
    places = transform_points(poses[:, None], np.vstack((laser[None], ends))[None])
    store.cover(places.reshape(-1, 2))
    store.reserve(places)
    cells = store.to_cells(places)
    register(
        store.tables,
        store.counts,
        store.points,
        store.owner,
        store.references,
        store.free,
        store.state,
        np.ascontiguousarray(cells[:, 0]),
        np.ascontiguousarray(cells[:, 1:]),
        hit.astype(np.uint8),
    )


def beams_of(
    record: LaserRecord, farthest: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the laser's place, where beams end, and whether they hit something, in the base's frame.

    Beams without a return are left out; beams longer than ``farthest`` end there without a hit.
    """
    seen = np.isfinite(record.ranges) & (record.ranges > 0) & (record.ranges <= record.range_max)
    ranges = record.ranges[seen]
    hit = ranges <= farthest
    ranges = np.minimum(ranges, farthest)
    x, y, yaw = record.laser
    directions = record.angles()[seen] + yaw
    ends = np.column_stack((x + ranges * np.cos(directions), y + ranges * np.sin(directions)))
    return np.array((x, y)), ends, hit


def map_of(store: TileStore, number: int, occupied_share: float = OCCUPIED_SHARE) -> OccupancyMap:
    """Return one map of a store as an occupancy grid, as large as what was seen and a border."""
    counts = store.dense_counts(number)
    visits = counts[..., 1]
    values = np.full(visits.shape, UNKNOWN, np.int8)
    seen = visits > 0
    values[seen] = np.where(counts[..., 0][seen] > occupied_share * visits[seen], OCCUPIED, FREE)
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        return OccupancyMap(np.full((1, 1), UNKNOWN, np.int8), store.resolution)
    cut = values[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    corner = (np.array((columns[0], rows[0])) + store.origin - BORDER) * store.resolution
    return OccupancyMap(
        np.pad(cut, BORDER, constant_values=UNKNOWN),
        store.resolution,
        Pose(float(corner[0]), float(corner[1]), 0.0),
    )


def draw_map(
    records: Sequence[LaserRecord],
    poses: NDArray[np.float64],
    *,
    resolution: float = 0.05,
    farthest: float = np.inf,
    occupied_share: float = OCCUPIED_SHARE,
) -> OccupancyMap:
    """Return the map of scans whose poses, shape (N, 3), are known."""
    store = TileStore(1, resolution)
    for record, pose in zip(records, poses, strict=True):
        draw_record(store, record, pose[None], farthest)
    return map_of(store, 0, occupied_share)
