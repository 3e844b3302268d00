"""The global planner: the cheapest way to a goal on a costmap, straightened.

It reads the way from the field of :mod:`~rce_fleet.navigation.planners.cost_to_go` and replaces parts of it
by straight lines where these cost no more, so that the way is not bound to eight directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.costs import INSCRIBED, LETHAL, UNKNOWN
from rce_fleet.navigation.planners.cost_to_go import UNREACHED, descend, spread, steps_of
from rce_fleet.navigation.planners.shortcuts import line_cost, straighten

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.navigation.costmap.cost_grid import CostGrid

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

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
        tolerance: How far from the goal the way may end, metres; None: ``default_tolerance``.
    """
    settings = parameters or GlobalPlannerParameters()
    reach = settings.default_tolerance if tolerance is None else tolerance
    for name, pose in (("start", start), ("goal", goal)):
        if not np.isfinite((pose.x, pose.y, pose.yaw)).all():
            return _failed(f"the {name} ({pose.x}, {pose.y}, {pose.yaw}) is not finite")
    if not grid.has(start.x, start.y):
        return _failed(f"the start ({start.x:.2f}, {start.y:.2f}) is off the costmap{_extent(grid)}")
    steps = steps_of(grid.values, allow_unknown=settings.allow_unknown)
    first = grid.cell_of(start.x, start.y)
    _open_start(grid, steps, first)
    last = _end_near(grid, steps, goal, reach)
    if last is None:
        return _failed(_why_no_end(grid, goal, reach))
    columns = steps.shape[1]
    begin, end = (first[0] + 1) * columns + first[1] + 1, (last[0] + 1) * columns + last[1] + 1
    field = spread(steps, end, begin)
    if field.reshape(-1)[begin] >= UNREACHED:
        return _failed(f"no way leads from ({start.x:.2f}, {start.y:.2f}) to ({goal.x:.2f}, {goal.y:.2f})")
    way = np.array(descend(field, steps, begin))
    cells = np.stack(divmod(way, columns), axis=1)
    corners = straighten(steps, cells) - 1
    points = _with_exact_ends(grid, steps, grid.centres_of(corners), start, goal, last)
    return Plan(_with_headings(points, grid.resolution, goal.yaw))


def _with_exact_ends(
    grid: CostGrid, steps: Ints, points: Floats, start: Pose, goal: Pose, last: tuple[int, int]
) -> Floats:
    """Return a way from the start itself and, unless that is in an obstacle, to the goal itself.

    The centres of their cells stay where a straight line past them would cross an obstacle.
    """
    reaches = last == grid.cell_of(goal.x, goal.y)
    ends = [np.array(((start.x, start.y),)), np.array(((goal.x, goal.y),)) if reaches else points[-1:]]
    if len(points) == 1:
        return np.concatenate(ends)

    def is_free(one: Floats, other: Floats) -> bool:
        at, to = (((p - grid.origin) / grid.resolution + 1)[::-1] for p in (one, other))
        return bool(np.isfinite(line_cost(steps, at, to)))

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


def _open_start(grid: CostGrid, steps: Ints, first: tuple[int, int]) -> None:
    """Let a way lead out of the inscribed cells around the start."""
    row, column = first
    if steps[row + 1, column + 1]:
        return
    x, y = grid.centres_of(np.array((first,)))[0]
    reach = 0.0
    # The nearest cell that can be entered tells how far the robot is inside.
    rows, columns = np.nonzero(steps)
    if len(rows):
        reach = float(np.hypot(rows - 1 - row, columns - 1 - column).min() + 1) * grid.resolution
    area = grid.area_around(x, y, min(reach, grid.resolution * max(grid.shape)))
    part = steps[area.low + 1 : area.high + 1, area.left + 1 : area.right + 1]
    part[(part == 0) & (grid.values[area.slices] == INSCRIBED)] = _ESCAPE_COST
    steps[row + 1, column + 1] = _ESCAPE_COST


def _end_near(grid: CostGrid, steps: Ints, goal: Pose, reach: float) -> tuple[int, int] | None:
    """Return the goal's cell, or if it cannot be entered the nearest one that can within ``reach``."""
    row, column = grid.cell_of(goal.x, goal.y)
    if grid.has(goal.x, goal.y) and steps[row + 1, column + 1]:
        return row, column
    area = grid.area_around(goal.x, goal.y, ceil(reach / grid.resolution) * grid.resolution)
    if reach <= 0 or area.is_empty:
        return None
    rows, columns = np.nonzero(steps[area.low + 1 : area.high + 1, area.left + 1 : area.right + 1])
    cells = np.stack((rows + area.low, columns + area.left), axis=1)
    away = np.hypot(*(grid.centres_of(cells) - (goal.x, goal.y)).T)
    if not len(away) or away.min() > reach:
        return None
    best = cells[int(away.argmin())]
    return int(best[0]), int(best[1])


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
