"""The occupancy map of a graph: its keyscans, drawn at their poses."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.mapping.occupancy_mapping import OCCUPIED_SHARE, draw_map
from rce_fleet.mapping.records import LaserRecord

if TYPE_CHECKING:
    from rce_fleet.mapping.graph.key_graph import KeyGraph
    from rce_fleet.mapping.graph.scan_points import ScanPoints
    from rce_fleet.maps.occupancy_map import OccupancyMap


def draw_graph(
    graph: KeyGraph,
    *,
    resolution: float = 0.05,
    farthest: float = 30.0,
    occupied_share: float = OCCUPIED_SHARE,
) -> OccupancyMap:
    """Return the map of the first part of a graph.

    Args:
        graph: The graph.
        resolution: Cell size, metres.
        farthest: Beams are drawn up to here, metres.
        occupied_share: A cell is occupied if more than this share of the beams through it ended there.

    Raises:
        MapError: If the map would become larger than any floor.
    """
    keys = np.flatnonzero(graph.parts == 0)
    records = [_record(key, graph.scans[key]) for key in keys.tolist()]
    return draw_map(
        records, graph.poses[keys], resolution=resolution, farthest=farthest, occupied_share=occupied_share
    )


def _record(key: int, scan: ScanPoints) -> LaserRecord:
    return LaserRecord(
        index=key,
        time=0.0,
        ranges=scan.ranges.astype(np.float64),
        angle_min=scan.angle_min,
        angle_increment=scan.angle_increment,
        range_max=inf,
        odometry=(0.0, 0.0, 0.0),
        laser=scan.laser,
    )
