"""The global planner: the cheapest way to a goal on a costmap, straightened.

It reads the way from the field of :mod:`~rce_fleet.navigation.planners.cost_to_go` and replaces parts of it
by straight lines where these cost no more, so that the way is not bound to eight directions. The field is
computed in a window around the goal, which grows until no way through the rest of the map can be cheaper: a
plan costs what its way is long, not what the map is large.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, hypot, isnan
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.cost_grid import Area
from rce_fleet.navigation.costmap.costs import INSCRIBED, LETHAL, UNKNOWN
from rce_fleet.navigation.planners.cost_to_go import NEUTRAL_COST, UNREACHED, descend, spread, steps_of
from rce_fleet.navigation.planners.shortcuts import line_cost, straighten

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from rce_fleet.navigation.costmap.cost_grid import CostGrid

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

FIRST_RADIUS = 64
"""Radius of the first window in cells, besides twice the distance between start and goal."""
_ESCAPE_COST = 1000
"""Cost of a step in an inscribed cell beside a start that is in one too: out of it, on the shortest way."""


@dataclass(frozen=True, slots=True)
class GlobalPlannerParameters:
    """Parameters of the global planner, named as navfn's: ``~NavfnROS/...``.

    Attributes:
        allow_unknown: The way may lead through unknown cells.
        default_tolerance: How far from a goal in an obstacle the way may end, metres.
    """

    allow_unknown: bool = True
    default_tolerance: float = 0.0


@dataclass(frozen=True, slots=True)
class Plan:
    """The result of planning.

    Attributes:
        path: Poses one cell apart, shape (N, 3): x, y, yaw; empty if there is no way.
        reason: Why there is no way; else empty.
    """

    path: Floats
    reason: str = ""

    @property
    def found(self) -> bool:
        """Whether there is a way."""
        return not self.reason


def make_plan(
    grid: CostGrid,
    start: Pose,
    goal: Pose,
    parameters: GlobalPlannerParameters | None = None,
    *,
    tolerance: float | None = None,
) -> Plan:
    """Return the cheapest way from one pose to another.

    A start in an inscribed cell (the robot touches an obstacle, as far as the costmap knows) leads out of it
    on the shortest way.

    Args:
        grid: The costmap.
        start: Where the way begins.
        goal: Where it ends, in the costmap's frame too.
        parameters: Of the planner.
        tolerance: How far from the goal the way may end, metres; infinity: anywhere; None:
            ``default_tolerance``.
    """
    settings = parameters or GlobalPlannerParameters()
    reach = settings.default_tolerance if tolerance is None else tolerance
    for name, pose in (("start", start), ("goal", goal)):
        if not np.isfinite((pose.x, pose.y, pose.yaw)).all():
            return _failed(f"the {name} ({pose.x}, {pose.y}, {pose.yaw}) is not finite")
    if not grid.has(start.x, start.y):
        return _failed(f"the start ({start.x:.2f}, {start.y:.2f}) is off the costmap{_extent(grid)}")
    if isnan(reach):
        return _failed("the tolerance is not a number")
    rows, columns = grid.shape
    reach = min(reach, hypot(goal.x - start.x, goal.y - start.y) + hypot(rows, columns) * grid.resolution)
    first = grid.cell_of(start.x, start.y)
    for area, radius in _windows(grid, first, goal, reach):
        window = _Window(grid, area, steps_of(grid.values[area.slices], allow_unknown=settings.allow_unknown))
        is_open = window.open_start(first)
        last = window.end_near(goal, reach)
        if last is not None:
            limit = UNREACHED - 1 if area == grid.whole else radius * NEUTRAL_COST
            path = _path_in(window, start, goal, last, limit)
            if path is not None:
                return Plan(path)
        elif not is_open or area == grid.whole:
            return _failed(_why_no_end(grid, goal, reach))
    return _failed(f"no way leads from ({start.x:.2f}, {start.y:.2f}) to ({goal.x:.2f}, {goal.y:.2f})")


@dataclass(frozen=True, slots=True)
class _Window:
    """A part of the costmap.

    Attributes:
        grid: The costmap.
        area: The part, cells of the costmap.
        steps: Cost of a step from each cell of the part, with a border, as of ``steps_of``.
    """

    grid: CostGrid
    area: Area
    steps: NDArray[np.int16]

    def index_of(self, cell: tuple[int, int]) -> tuple[int, int]:
        """Return the index of a cell of the costmap in ``steps``."""
        return cell[0] - self.area.low + 1, cell[1] - self.area.left + 1

    def cells_at(self, indices: Ints) -> Ints:
        """Return the cells of the costmap at indices of ``steps``, both of shape (N, 2)."""
        return indices - 1 + (self.area.low, self.area.left)

    def point_of(self, point: Floats) -> Floats:
        """Return row and column in ``steps``, with fractions, of a point in metres."""
        grid = self.grid
        inside: Floats = ((point - grid.origin) / grid.resolution)[::-1]
        return inside - (self.area.low - 1, self.area.left - 1)

    def open_start(self, start: tuple[int, int]) -> bool:
        """Let a way lead out of the inscribed cells around the start; return whether the start is in one."""
        row, column = self.index_of(start)
        if self.steps[row, column]:
            return False
        # The nearest cell that can be entered tells how far the robot is inside.
        rows, columns = np.nonzero(self.steps)
        reach = ceil(np.hypot(rows - row, columns - column).min() + 0.5) if len(rows) else 0
        near = Area(start[0], start[1], start[0] + 1, start[1] + 1).grown(reach)
        shared = Area(
            max(near.low, self.area.low),
            max(near.left, self.area.left),
            min(near.high, self.area.high),
            min(near.right, self.area.right),
        )
        (low, left), (high, right) = (self.index_of(one) for one in (shared[:2], shared[2:]))
        part = self.steps[low:high, left:right]
        part[(part == 0) & (self.grid.values[shared.slices] == INSCRIBED)] = _ESCAPE_COST
        self.steps[row, column] = _ESCAPE_COST
        return True

    def end_near(self, goal: Pose, reach: float) -> tuple[int, int] | None:
        """Return the goal's cell, or if it cannot be entered the nearest one that can within ``reach``."""
        grid = self.grid
        cell = grid.cell_of(goal.x, goal.y)
        if grid.has(goal.x, goal.y) and self.steps[self.index_of(cell)]:
            return cell
        near = grid.area_around(goal.x, goal.y, ceil(reach / grid.resolution) * grid.resolution)
        if reach <= 0 or near.is_empty:
            return None
        (low, left), (high, right) = (self.index_of(one) for one in (near[:2], near[2:]))
        cells = np.argwhere(self.steps[low:high, left:right]) + np.array((near.low, near.left))
        away = np.hypot(*(grid.centres_of(cells) - (goal.x, goal.y)).T)
        if not len(away) or away.min() > reach:
            return None
        best = cells[int(away.argmin())]
        return int(best[0]), int(best[1])


def _windows(grid: CostGrid, start: tuple[int, int], goal: Pose, reach: float) -> Iterator[tuple[Area, int]]:
    """Yield growing areas that contain the start and all cells where the way may end; the last is the grid.

    With each comes its radius around those cells: cells outside are farther away.
    """
    row, column = grid.cell_of(goal.x, goal.y)
    margin = ceil(reach / grid.resolution) + 1
    radius = 2 * (max(abs(row - start[0]), abs(column - start[1])) + margin) + FIRST_RADIUS
    while True:
        area = Area(row, column, row + 1, column + 1).grown(radius + margin).clipped(*grid.shape)
        yield area, radius
        if area == grid.whole:
            return
        radius *= 4


def _path_in(window: _Window, start: Pose, goal: Pose, last: tuple[int, int], limit: int) -> Floats | None:
    """Return the poses of the cheapest way in a window if it costs at most ``limit``, else None."""
    grid, steps = window.grid, window.steps
    ends = grid.cell_of(start.x, start.y), last
    begin, end = (int(np.ravel_multi_index(window.index_of(one), steps.shape)) for one in ends)
    field = spread(steps, end, begin)
    if field.reshape(-1)[begin] > limit:
        return None
    way = np.array(descend(field, steps, begin))
    corners = straighten(steps, np.stack(divmod(way, steps.shape[1]), axis=1))
    points = _with_exact_ends(window, grid.centres_of(window.cells_at(corners)), start, goal, last)
    return _with_headings(points, grid.resolution, goal.yaw)


def _with_exact_ends(
    window: _Window, points: Floats, start: Pose, goal: Pose, last: tuple[int, int]
) -> Floats:
    """Return a way from the start itself and, unless that is in an obstacle, to the goal itself.

    The centres of their cells stay where a straight line past them would cross an obstacle.
    """
    reaches = last == window.grid.cell_of(goal.x, goal.y)
    ends = [np.array(((start.x, start.y),)), np.array(((goal.x, goal.y),)) if reaches else points[-1:]]
    if len(points) == 1:
        return np.concatenate(ends)

    def is_free(one: Floats, other: Floats) -> bool:
        return bool(np.isfinite(line_cost(window.steps, window.point_of(one), window.point_of(other))))

    first = 1 if is_free(ends[0][0], points[1]) else 0
    before = points[-2] if len(points) > first + 1 else ends[0][0]
    until = -1 if is_free(before, ends[1][0]) else len(points)
    return np.concatenate((ends[0], points[first:until], ends[1]))


def _failed(reason: str) -> Plan:
    return Plan(np.empty((0, 3)), reason)


def _extent(grid: CostGrid) -> str:
    rows, columns = grid.shape
    (left, low), size = grid.origin, grid.resolution
    return f" (x {left:.2f} to {left + columns * size:.2f} m, y {low:.2f} to {low + rows * size:.2f} m)"


def _why_no_end(grid: CostGrid, goal: Pose, reach: float) -> str:
    place = f"the goal ({goal.x:.2f}, {goal.y:.2f})"
    if not grid.has(goal.x, goal.y):
        return f"{place} is off the costmap{_extent(grid)}"
    cost = grid.cost_at(goal.x, goal.y)
    what = {
        LETHAL: "is in an obstacle",
        INSCRIBED: "is so near to an obstacle that the robot would touch it",
        UNKNOWN: "is in unknown space, and allow_unknown is false",
    }.get(cost, "cannot be entered")
    return f"{place} {what}; no free cell is within the tolerance of {reach:.2f} m"


def _with_headings(points: Floats, spacing: float, last_yaw: float) -> Floats:
    """Return poses along straight lines between points, headed along them; the last one has ``last_yaw``."""
    lengths = np.hypot(*np.diff(points, axis=0).T)
    kept = np.concatenate(((True,), lengths > 1e-9))  # noqa: PLR2004 - the same point twice
    points, lengths = points[kept], lengths[lengths > 1e-9]  # noqa: PLR2004
    if not len(lengths):
        return np.array(((points[0, 0], points[0, 1], last_yaw),))
    travelled = np.concatenate(((0.0,), np.cumsum(lengths)))
    count = max(1, ceil(travelled[-1] / spacing - 1e-9))
    at = np.linspace(0.0, travelled[-1], count + 1)
    x, y = (np.interp(at, travelled, points[:, axis]) for axis in (0, 1))
    segment = np.clip(np.searchsorted(travelled, at, side="right") - 1, 0, len(lengths) - 1)
    yaws = np.arctan2(*np.diff(points, axis=0).T[::-1])[segment]
    yaws[-1] = last_yaw
    return np.stack((x, y, yaws), axis=1)
