"""What a task costs robots of one profile after its first stop, which may be made in one of several cells."""

from __future__ import annotations

from itertools import islice
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.tasks.energy import Effort, driven, effort_of
from rce_fleet.tasks.order import MOST_CELLS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rce_fleet.tasks.records import RobotProfile
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts

MOST_STARTS = 3
"""So many cells of a first stop are looked at, from which the rest is possible, if the next stop may be made
in several cells too: the nearest to that one may lead on to a longer rest."""


def tails_of(
    task: Task,
    robots: NDArray[np.int64],
    travel: TravelCosts,
    profile: RobotProfile,
    to_chargers: NDArray[np.float32] | None,
    *,
    in_metres: bool = False,
) -> list[Effort]:
    """Return what a task costs after its first stop, for cells in which it can be made; empty: for none.

    Cells from which no way leads to the other stops are left out, and so are those that are farther from the
    next stop than some others.

    Args:
        task: The task.
        robots: Cells of the robots, shape (robots,): a first stop without cells is made in one of them.
        travel: Distances.
        profile: The robots'.
        to_chargers: Metres to the nearest charger from each cell, shape (cells,); None: there is none.
        in_metres: See :func:`~rce_fleet.tasks.energy.effort_of`.
    """
    stop = task.next_stop
    cells = stop.cells if stop is not None else ()
    starts = np.array(cells) if cells else robots
    later = (task.order.stop(number) for number in range(task.position + 1, task.order.length))
    following = next((stop.cells for stop in later if stop.cells), ())
    if len(starts) > 1:
        starts = _by_way(starts, following, travel, profile, to_chargers)[:MOST_CELLS]
    each = (effort_of(task, start, travel, profile, in_metres=in_metres) for start in starts.tolist())
    possible = (effort for effort in each if effort.first < inf)
    return list(islice(possible, MOST_STARTS if cells and len(following) > 1 else 1))


def _by_way(
    starts: NDArray[np.int64],
    following: Sequence[int],
    travel: TravelCosts,
    profile: RobotProfile,
    to_chargers: NDArray[np.float32] | None,
) -> NDArray[np.int64]:
    """Return the cells from which a way leads to those of the next stop, the nearest ones first.

    Without a next stop all cells are returned, the nearest to a charger first.
    """
    zones = driven(profile.zone_cost)
    ways = np.zeros(len(starts), np.float32)
    if not following:
        if to_chargers is not None:
            to_chargers.take(starts, out=ways, mode="clip")
        return starts[np.argsort(ways, kind="stable")]
    each = np.empty_like(ways)
    ways[:] = inf
    for cell in following:
        travel.write_metres(starts, cell, zones, each)
        np.minimum(ways, each, out=ways)
    order = np.argsort(ways, kind="stable")
    return starts[order[ways[order] < inf]]
