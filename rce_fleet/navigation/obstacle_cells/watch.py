"""Watches the cells of a fleet's grid by scans: which are blocked by something that is on no map.

The cells around the robot are divided into small parts. Hits and rays that pass tell which parts are
occupied. A cell is blocked if its occupied parts, and those in their shadow, leave the robot no passage; it
is free again once most of it was seen to be free.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, inf, pi
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import transform_points
from rce_fleet.maps.distance import squares_to_nearest
from rce_fleet.navigation.costmap.obstacle_layer import passed_by_rays
from rce_fleet.navigation.obstacle_cells.passage import can_pass

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from rce_fleet.maps.occupancy_map import OccupancyMap
    from rce_fleet.navigation.costmap.observation import Observation

    Floats = NDArray[np.float64]

_MOST, _OCCUPIED = 4, 2
"""Evidence of a part: hits add 1 and rays that pass take 1 away, within 0 .. 4; from 2 on it is occupied."""
_FRESH = 2.0
"""A part that was seen to be free counts as free for so long, seconds."""
_BEGINNING = 10.0
"""What the watch's own time begins with, seconds: 0 is a part that was never seen."""
_TIME_JUMP = 1.0
"""Time that goes back by more than this began anew, with a simulation or a bag, seconds."""


@dataclass(frozen=True, slots=True)
class WatchParameters:
    """Private parameters of the node ``obstacle_cells``.

    Attributes:
        robot_radius: Metres.
        sight: How far away cells are judged, metres.
        parts: Number of parts along the edge of a cell.
        least_hits: Occupied parts that a blocked cell has at least.
        border: Parts this near to the cell's edge do not count as hits, metres: they may belong to the next.
        map_tolerance: Points this near to an obstacle of the map are on the map, metres.
        robot_tolerance: Points this near to another robot's hull are that robot, metres.
        confirm: How long a cell must be found blocked, or free, before it is reported, seconds.
        seen_share: Share of a cell that must be seen to be free, before it is reported free.
    """

    robot_radius: float = 0.22
    sight: float = 2.5
    parts: int = 20
    least_hits: int = 3
    border: float = 0.1
    map_tolerance: float = 0.15
    robot_tolerance: float = 0.2
    confirm: float = 0.5
    seen_share: float = 0.6

    def __post_init__(self) -> None:
        if not (self.robot_radius > 0 and self.sight > 0 and self.parts >= 4):  # noqa: PLR2004
            raise ValueError("robot_radius and sight must be above 0, parts at least 4")


@dataclass(frozen=True, slots=True)
class Findings:
    """What became of cells.

    Attributes:
        blocked: Cells that are blocked and in sight, ascending.
        freed: Cells that were blocked and are seen to be free, ascending.
    """

    blocked: tuple[int, ...] = ()
    freed: tuple[int, ...] = ()


class CellWatch:
    """Watches the cells around a robot.

    Args:
        fleet: The fleet's grid: one pixel is one cell.
        parameters: Of the watch.
        known: The localization map, whose obstacles are not reported; None: everything is.
    """

    def __init__(
        self, fleet: OccupancyMap, parameters: WatchParameters, known: OccupancyMap | None = None
    ) -> None:
        self.fleet = fleet
        self.parameters = parameters
        self._known = known
        self._mapped = None if known is None else _near_occupied(known, parameters.map_tolerance)
        self._part = fleet.resolution / parameters.parts
        self._now = -inf
        self._begin(-inf)

    def take(
        self,
        seen: Observation,
        now: float,
        *,
        robots: Floats | None = None,
        held: Collection[int] = (),
        suspects: Collection[int] = (),
    ) -> Findings:
        """Take a scan and return what is found.

        Args:
            seen: What the sensor saw, in the map's frame.
            now: Time, seconds.
            robots: Other robots, shape (K, 3): x, y and radius, metres.
            held: Cells that other robots hold; nothing in them is reported, and what was seen is forgotten.
            suspects: Cells that are blocked as far as the fleet knows; they are reported if they are free.
        """
        if now < self._now - _TIME_JUMP or self._now == -inf:
            self._begin(now)
        self._now = now
        sensor = self._local(np.array(((seen.x, seen.y),)))[0]
        hits = self._foreign(seen.hits, robots)
        self._update(seen, hits, now)
        blocked, freed = [], []
        for cell in self._in_sight(sensor):
            if cell in held:
                self._since.pop(cell, None)
                self._evidence[self._square(cell)] = 0  # it may be the robot, which drives on unseen
                continue
            is_blocked = self._is_blocked(cell, sensor)
            was, since = self._since.get(cell, (not is_blocked, now))
            if was is not is_blocked:
                since = now
            self._since[cell] = (is_blocked, since)
            if now - since < self.parameters.confirm:
                continue
            if is_blocked:
                blocked.append(cell)
            elif cell in suspects and self._seen_free(cell, now):
                freed.append(cell)
        return Findings(tuple(blocked), tuple(freed))

    def _begin(self, now: float) -> None:
        """Forget all that was seen."""
        count = self.parameters.parts
        shape = (self.fleet.rows * count, self.fleet.columns * count)
        # Zeros: memory of parts that no scan reaches is not used.
        self._evidence: NDArray[np.int8] = np.zeros(shape, np.int8)
        self._seen_at: NDArray[np.float32] = np.zeros(shape, np.float32)
        self._since: dict[int, tuple[bool, float]] = {}
        self._start = now - _BEGINNING

    # Parts

    def _local(self, points: Floats) -> Floats:
        """Return points of the map's frame in that of the fleet's grid, in parts."""
        return transform_points(self.fleet.origin.inverse().as_array(), points) / self._part

    def _foreign(self, hits: Floats, robots: Floats | None) -> Floats:
        """Return the hits that belong neither to the map nor to other robots."""
        keep = np.ones(len(hits), np.bool_)
        if self._known is not None and self._mapped is not None and len(hits):
            cells = self._known.world_to_cell(hits)
            inside = self._known.inside(cells)
            keep &= ~(inside & self._mapped[tuple(np.where(inside[:, None], cells, 0).T)])
        for x, y, radius in robots if robots is not None else ():
            keep &= np.hypot(hits[:, 0] - x, hits[:, 1] - y) > radius + self.parameters.robot_tolerance
        return hits[keep]

    def _update(self, seen: Observation, hits: Floats, now: float) -> None:
        rows, columns = self._evidence.shape
        x, y = self._local(np.array(((seen.x, seen.y),)))[0]
        reach = self.parameters.sight / self._part
        low, left = max(int(y - reach), 0), max(int(x - reach), 0)
        high, right = min(int(y + reach) + 1, rows), min(int(x + reach) + 1, columns)
        if high <= low or right <= left or not len(seen.bearings):
            return
        grid = np.mgrid[low:high, left:right].reshape(2, -1)
        centres = transform_points(self.fleet.origin.as_array(), (grid[::-1].T + 0.5) * self._part)
        passed = passed_by_rays(centres, seen, self._part)
        gone = grid[:, passed]
        evidence = self._evidence[gone[0], gone[1]]
        self._evidence[gone[0], gone[1]] = np.maximum(evidence - 1, 0)
        self._seen_at[gone[0], gone[1]] = now - self._start
        parts = np.unique(np.floor(self._local(hits)[:, ::-1]).astype(np.int64), axis=0)
        inside = ((parts >= 0) & (parts < (rows, columns))).all(axis=1)
        row, column = parts[inside].T
        # A ray beside a hit may have passed the same part: a hit counts for more.
        self._evidence[row, column] = np.minimum(self._evidence[row, column] + 2, _MOST)

    # Cells

    def _in_sight(self, sensor: Floats) -> list[int]:
        """Return the cells whose middle is in sight."""
        x, y = sensor / self.parameters.parts
        reach = self.parameters.sight / self.fleet.resolution
        low, left = max(floor(y - reach), 0), max(floor(x - reach), 0)
        high, right = min(ceil(y + reach), self.fleet.rows), min(ceil(x + reach), self.fleet.columns)
        rows, columns = np.mgrid[low : max(low, high), left : max(left, right)]
        near = np.hypot(columns + 0.5 - x, rows + 0.5 - y) <= reach
        return [int(cell) for cell in rows[near] * self.fleet.columns + columns[near]]

    def _square(self, cell: int) -> tuple[slice, slice]:
        count = self.parameters.parts
        row, column = divmod(cell, self.fleet.columns)
        return slice(row * count, (row + 1) * count), slice(column * count, (column + 1) * count)

    def _is_blocked(self, cell: int, sensor: Floats) -> bool:
        square = self._square(cell)
        occupied = self._evidence[square] >= _OCCUPIED
        border = round(self.parameters.border / self._part)
        inner = occupied[border : len(occupied) - border, border : len(occupied) - border]
        if np.count_nonzero(inner) < self.parameters.least_hits:
            return False
        hidden = occupied | _shadow(occupied, sensor - (square[1].start, square[0].start))
        return not can_pass(hidden, self.fleet.resolution, self.parameters.robot_radius)

    def _seen_free(self, cell: int, now: float) -> bool:
        """Return whether most of a cell was seen to be free a moment ago."""
        fresh = self._seen_at[self._square(cell)] >= now - self._start - _FRESH
        return float(fresh.mean()) >= self.parameters.seen_share


def _near_occupied(known: OccupancyMap, within: float) -> NDArray[np.bool_]:
    """Return which cells of a map are at most so far from an occupied one, metres; shape (rows, columns)."""
    limit = within / known.resolution
    return np.asarray(squares_to_nearest(known.occupied, ceil(limit)) <= limit * limit + 1e-9)


def _shadow(occupied: NDArray[np.bool_], sensor: Floats) -> NDArray[np.bool_]:
    """Return the parts that occupied ones hide from the sensor, shape (N, N).

    Args:
        occupied: Shape (N, N).
        sensor: x and y, in parts.
    """
    rows, columns = np.mgrid[0 : len(occupied), 0 : len(occupied)] + 0.5
    away = np.hypot(columns - sensor[0], rows - sensor[1])
    bearing = np.arctan2(rows - sensor[1], columns - sensor[0])
    hit_bearing, hit_away = bearing[occupied], away[occupied]
    half = np.arctan2(0.75, np.maximum(hit_away, 0.75))
    off = np.abs((bearing[:, :, None] - hit_bearing + pi) % (2 * pi) - pi)
    return np.asarray(((off <= half) & (away[:, :, None] > hit_away)).any(axis=2))
