"""Frontiers: where known free space ends and unknown space begins.

Yamauchi, "A Frontier-Based Approach for Autonomous Exploration", 1997. Ranking, parameters and the meaning of
sizes are those of ROS 1's package explore_lite (wiki page explore_lite).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, inf
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.distance import distances_to
from rce_fleet.maps.ray_casting import cast_in_cells
from rce_fleet.navigation.costmap.costs import FREE, INSCRIBED
from rce_fleet.navigation.planners.cost_to_go import NEUTRAL_COST, UNREACHED, spread, steps_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from rce_fleet.maps.occupancy_map import OccupancyMap

    Cells = NDArray[np.int64]
    Floats = NDArray[np.float64]
    Mask = NDArray[np.bool_]

EXTENT = 2.0
"""Longer frontiers are split, metres: the middle of one around the robot would be the robot's own place."""
REACH = 0.6
"""A frontier is reachable if the robot can stand so near to it, and see it from there, metres."""
START_REACH = 1.0
"""The search begins in the nearest cell in which the robot has room, within this distance, metres."""
COST_INSCRIBED, COST_LETHAL = 99, 100
"""Values of a published costmap: the robot would touch an obstacle; an obstacle."""
_NEIGHBOURS = np.array(((0, 1, 0), (1, 0, 1), (0, 1, 0)), bool)
_TOUCHING = np.ones((3, 3), bool)


@dataclass(frozen=True, slots=True)
class FrontierParameters:
    """How frontiers are found and ranked; names as in explore_lite.

    Attributes:
        min_frontier_size: Shorter frontiers are ignored, metres: cells times their edge.
        potential_scale: What a metre of the way costs.
        gain_scale: What a cell of a frontier gains.
        robot_radius: Radius that the robot needs on a map that is not inflated, metres; 0: the map is a
            costmap, as ``move_base`` publishes it.
    """

    min_frontier_size: float = field(default=0.5, metadata={"minimum": 0})
    potential_scale: float = field(default=1e-3, metadata={"minimum": 0})
    gain_scale: float = field(default=1.0, metadata={"minimum": 0})
    robot_radius: float = field(default=0.0, metadata={"minimum": 0})


@dataclass(frozen=True, slots=True)
class Frontier:
    """A line of free cells beside unknown ones.

    Attributes:
        points: Centres of its cells in the world, shape (N, 2), metres.
        middle: The one of them that stands for it.
        goal: Where the robot should go: near the middle, and turned to it.
        way: Length of the robot's way to the goal, metres.
        size: Cells times their edge, metres.
        cost: Its rank; the least is the best.
    """

    points: Floats
    middle: tuple[float, float]
    goal: Pose
    way: float
    size: float
    cost: float


@dataclass(frozen=True, slots=True)
class FrontierSearch:
    """Result of a search.

    Attributes:
        frontiers: Those that the robot can reach, the best first.
        unreachable: Points of the others, each of shape (N, 2), metres.
        reason: Why nothing can be reached; empty if the search was possible.
    """

    frontiers: tuple[Frontier, ...] = ()
    unreachable: tuple[Floats, ...] = ()
    reason: str = ""
    _picture: OccupancyMap | None = None
    _ways: Floats | None = None

    def way_to(self, x: float, y: float) -> float:
        """Return the length of the robot's way to a point, metres; infinite if it cannot stand there."""
        if self._picture is None or self._ways is None:
            return inf
        cell = self._picture.world_to_cell((x, y))
        return float(self._ways[tuple(cell)]) if self._picture.inside(cell) else inf


def find_frontiers(picture: OccupancyMap, robot: Pose, parameters: FrontierParameters) -> FrontierSearch:
    """Return the frontiers of a map.

    Args:
        picture: A map with unknown cells, or a costmap.
        robot: The robot's pose on it.
        parameters: How to find and rank them.
    """
    free, blocked, roomy = _spaces(picture, parameters.robot_radius)
    start = _start(picture, roomy, robot)
    if start is None:
        place = f"the robot's place ({robot.x:.2f}, {robot.y:.2f})"
        if not picture.inside(picture.world_to_cell((robot.x, robot.y))):
            return FrontierSearch(reason=f"{place} is off the map")
        return FrontierSearch(
            reason=f"no cell within {START_REACH:g} m of {place} has room for it: check robot_radius"
        )
    ways = _ways(roomy, start, picture.resolution)
    reached = np.isfinite(ways)
    away, nearest = ndimage.distance_transform_edt(~reached, return_indices=True)
    unknown_beside = ndimage.binary_dilation(picture.data < 0, structure=_NEIGHBOURS)
    fewest = parameters.min_frontier_size / picture.resolution - 1e-9
    found: list[Frontier] = []
    unreachable: list[Floats] = []
    for cells in _clusters(free & unknown_beside, fewest, EXTENT / picture.resolution):
        stands = np.asarray(nearest[:, cells[:, 0], cells[:, 1]].T, np.int64)
        near = away[cells[:, 0], cells[:, 1]] * picture.resolution <= REACH
        near[near] = _sees(blocked, stands[near], cells[near])
        points = picture.cell_to_world(cells)
        if not near.any():
            unreachable.append(points)
            continue
        middle = _middle(cells, near)
        stand = stands[middle]
        way = float(ways[tuple(stand)])
        cost = (parameters.potential_scale * way - parameters.gain_scale * len(cells)) * picture.resolution
        goal = _facing(picture.cell_to_world(stand), points[middle], robot)
        at = (float(points[middle, 0]), float(points[middle, 1]))
        found.append(Frontier(points, at, goal, way, len(cells) * picture.resolution, cost))
    found.sort(key=lambda one: (one.cost, one.middle))
    return FrontierSearch(tuple(found), tuple(unreachable), "", picture, ways)


def _spaces(picture: OccupancyMap, radius: float) -> tuple[Mask, Mask, Mask]:
    """Return which cells are free, which hide what is behind, and in which the robot has room."""
    if radius > 0:
        free, blocked = picture.free, picture.occupied
        return free, blocked, free & (distances_to(blocked, picture.resolution) > radius)
    free = (picture.data >= 0) & (picture.data < COST_INSCRIBED)
    return free, picture.data == COST_LETHAL, free


def _start(picture: OccupancyMap, roomy: Mask, robot: Pose) -> tuple[int, int] | None:
    """Return the cell in which the way begins: the robot's own, or the nearest one with room."""
    cell = picture.world_to_cell((robot.x, robot.y))
    if not picture.inside(cell):
        return None
    if not roomy[tuple(cell)]:
        open_cells = np.argwhere(roomy)
        apart = np.hypot(*(open_cells - cell).T)
        if not len(apart) or apart.min() * picture.resolution > START_REACH:
            return None
        cell = open_cells[apart.argmin()]
    return int(cell[0]), int(cell[1])


def _ways(roomy: Mask, start: tuple[int, int], resolution: float) -> Floats:
    """Return the length of the way from a cell to each, metres; infinite where none leads."""
    steps = steps_of(np.where(roomy, FREE, INSCRIBED).astype(np.uint8), allow_unknown=False)
    field = spread(steps, (start[0] + 1) * steps.shape[1] + start[1] + 1, -1)[1:-1, 1:-1]
    return np.where(field < UNREACHED, field * (resolution / NEUTRAL_COST), inf)


def _clusters(mask: Mask, fewest: float, extent: float) -> Iterator[Cells]:
    """Yield the cells of each frontier, shape (N, 2); long ones in pieces."""
    labels, count = ndimage.label(mask, structure=_TOUCHING)
    if not count:
        return
    cells = np.argwhere(mask)
    order = np.argsort(labels[mask], kind="stable")
    ends = np.cumsum(np.bincount(labels[mask], minlength=count + 1)[1:])
    for members in np.split(cells[order], ends[:-1]):
        if len(members) >= fewest:
            yield from _pieces(members, extent)


def _pieces(cells: Cells, extent: float) -> Iterator[Cells]:
    """Yield parts of a frontier that are not longer than ``extent`` cells: it is cut across its long axis."""
    offsets = cells - cells.mean(axis=0)
    if np.hypot(*offsets.T).max() <= extent / 2:
        yield cells
        return
    along = offsets @ np.linalg.eigh(offsets.T @ offsets)[1][:, -1]
    for side in (along < 0, along >= 0):
        yield from _pieces(cells[side], extent)


def _sees(blocked: Mask, stands: Cells, cells: Cells) -> Mask:
    """Return whether no obstacle is on the line from each place to its cell, both shape (N, 2)."""
    away: Floats = np.hypot(*(cells - stands).T)
    far: Mask = np.asarray(away > 0)
    if far.any():
        rows, columns = (cells - stands)[far].T
        starts = np.ascontiguousarray(stands[far, ::-1] + 0.5, np.float64)
        angles = np.arctan2(rows, columns).astype(np.float64)
        free = cast_in_cells(np.ascontiguousarray(blocked), starts, angles, float(away.max()))
        far[far] = free < away[far]
    return np.logical_not(far)


def _middle(cells: Cells, allowed: Mask) -> int:
    """Return the number of the allowed cell nearest to the middle of all of them."""
    apart = np.hypot(*(cells - cells[allowed].mean(axis=0)).T)
    return int(np.where(allowed, apart, inf).argmin())


def _facing(stand: Floats, point: Floats, robot: Pose) -> Pose:
    """Return the pose at a place that looks at a point; at the point itself, along the way there."""
    dx, dy = point - stand
    if not (dx or dy):
        dx, dy = stand - (robot.x, robot.y)
    return Pose(float(stand[0]), float(stand[1]), atan2(dy, dx))
