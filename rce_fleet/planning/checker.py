"""Checks plans, without any code of the planners: the rules of motion are written here a second time.

::

    faults = check_plan(grid, paths)
    if faults:
        print(faults[0])  # step 12: robots 3 and 7 are both in cell 40
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from rce_fleet.planning.grid import GridMap


@dataclass(frozen=True, slots=True)
class PlanFault:
    """A rule that a plan breaks.

    Attributes:
        step: The step at the end of which it is broken.
        robots: Robots that break it.
        cells: Cells where.
        reason: What is wrong, for people.
    """

    step: int
    robots: tuple[int, ...]
    cells: tuple[int, ...]
    reason: str

    def __str__(self) -> str:
        return f"step {self.step}: {self.reason}"


def check_plan(
    grid: GridMap,
    paths: Sequence[Sequence[int]],
    *,
    starts: Sequence[int] | None = None,
    goals: Sequence[int] | None = None,
    one_way: Collection[tuple[int, int]] = (),
    following: int = 0,
    rotations: bool = True,
) -> list[PlanFault]:
    """Return every fault of a joint plan on a grid, in the order of steps; an empty list if it is right.

    A robot stays in the last cell of its path.

    Args:
        grid: The map.
        paths: Cell of each robot at each step, from step 0 on.
        starts: Cells where the paths must begin.
        goals: Cells where the paths must end.
        one_way: Moves ``(from, to)`` that are not allowed.
        following: Steps for which a cell must have been empty before another robot enters it: 0 lets a robot
            enter a cell in the step in which another one leaves it.
        rotations: Whether robots may follow one another around in a circle.
    """
    faults = list(_ends(paths, starts, goals))
    for robot, path in enumerate(paths):
        faults += _moves(grid, robot, path, frozenset(one_way))
    last = max(map(len, paths), default=0)
    rows = [[path[min(step, len(path) - 1)] for path in paths if path] for step in range(last)]
    numbers = [robot for robot, path in enumerate(paths) if path]
    for step, row in enumerate(rows):
        faults += _shared(step, row, numbers)
    for step, (now, after) in enumerate(pairwise(rows), start=1):
        faults += _exchanges(step, now, after, numbers)
        if not rotations:
            faults += _circles(step, now, after, numbers)
    if following:
        faults += _followed(rows, numbers, following)
    return sorted(faults, key=lambda fault: fault.step)


def _ends(
    paths: Sequence[Sequence[int]], starts: Sequence[int] | None, goals: Sequence[int] | None
) -> Iterator[PlanFault]:
    """Yield paths that are empty, and those that begin or end elsewhere."""
    for robot, path in enumerate(paths):
        if not path:
            yield PlanFault(0, (robot,), (), f"robot {robot} has no path")
    for place, wanted in ((0, starts), (-1, goals)):
        if wanted is None:
            continue
        if len(wanted) != len(paths):
            yield PlanFault(0, (), (), f"{len(paths)} paths for {len(wanted)} robots")
        for robot, (path, cell) in enumerate(zip(paths, wanted, strict=False)):
            if path and path[place] != cell:
                where = "begins" if place == 0 else "ends"
                step = 0 if place == 0 else len(path) - 1
                reason = f"the path of robot {robot} {where} in cell {path[place]} instead of {cell}"
                yield PlanFault(step, (robot,), (path[place], cell), reason)


def _moves(
    grid: GridMap, robot: int, path: Sequence[int], one_way: frozenset[tuple[int, int]]
) -> Iterator[PlanFault]:
    """Yield moves of a robot that the map does not allow."""
    for step, cell in enumerate(path):
        if not 0 <= cell < grid.rows * grid.columns:
            yield PlanFault(step, (robot,), (cell,), f"robot {robot} is outside the map, in cell {cell}")
        elif cell in grid.blocked and cell != path[0]:
            yield PlanFault(step, (robot,), (cell,), f"robot {robot} is in the blocked cell {cell}")
    for step, (here, there) in enumerate(pairwise(path), start=1):
        if here == there:
            continue
        rows = abs(here // grid.columns - there // grid.columns)
        columns = abs(here % grid.columns - there % grid.columns)
        if rows + columns != 1:
            reason = f"robot {robot} goes from cell {here} to {there}, which is not beside it"
            yield PlanFault(step, (robot,), (here, there), reason)
        elif (here, there) in one_way:
            reason = f"robot {robot} goes from cell {here} to {there} against a one-way edge"
            yield PlanFault(step, (robot,), (here, there), reason)


def _shared(step: int, row: Sequence[int], numbers: Sequence[int]) -> Iterator[PlanFault]:
    """Yield cells with two robots."""
    first: dict[int, int] = {}
    for robot, cell in zip(numbers, row, strict=True):
        if cell in first:
            reason = f"robots {first[cell]} and {robot} are both in cell {cell}"
            yield PlanFault(step, (first[cell], robot), (cell,), reason)
        else:
            first[cell] = robot


def _exchanges(
    step: int, now: Sequence[int], after: Sequence[int], numbers: Sequence[int]
) -> Iterator[PlanFault]:
    """Yield pairs of robots that go through each other."""
    moves: dict[tuple[int, int], int] = {}
    for robot, here, there in zip(numbers, now, after, strict=True):
        if here == there:
            continue
        other = moves.get((there, here))
        if other is not None:
            reason = f"robots {other} and {robot} exchange cells {there} and {here}"
            yield PlanFault(step, (other, robot), (there, here), reason)
        moves[here, there] = robot


def _circles(
    step: int, now: Sequence[int], after: Sequence[int], numbers: Sequence[int]
) -> Iterator[PlanFault]:
    """Yield rings of three and more robots that all enter the next one's cell."""
    onward = {
        here: (there, robot) for robot, here, there in zip(numbers, now, after, strict=True) if here != there
    }
    seen: set[int] = set()
    for begin in onward:
        trail: list[int] = []
        cell = begin
        while cell in onward and cell not in seen:
            seen.add(cell)
            trail.append(cell)
            cell = onward[cell][0]
        ring = trail[trail.index(cell) :] if cell in trail else []
        if len(ring) > len((cell, begin)):
            robots = tuple(onward[each][1] for each in ring)
            yield PlanFault(
                step, robots, tuple(ring), f"robots {robots} follow one another around in a circle"
            )


def _followed(rows: Sequence[Sequence[int]], numbers: Sequence[int], following: int) -> Iterator[PlanFault]:
    """Yield entries of cells that another robot left too late."""
    left: dict[int, tuple[int, int]] = {}
    for step, (now, after) in enumerate(pairwise(rows), start=1):
        for robot, here, there in zip(numbers, now, after, strict=True):
            if here != there:
                left[here] = step, robot
        for robot, here, there in zip(numbers, now, after, strict=True):
            when, other = left.get(there, (step - following - 1, robot))
            if here != there and other != robot and step - when < following:
                reason = f"robot {robot} enters cell {there} {step - when} steps after robot {other} left it"
                yield PlanFault(step, (other, robot), (there,), reason)
