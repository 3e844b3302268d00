"""Demo scenarios: who starts where, who goes where, and what is in the way. All drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from random import Random
from typing import TYPE_CHECKING

from rce.fleet.dijkstra import shortest_path
from rce.fleet.exceptions import ScenarioError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from rce.fleet.grid import GridMap

_ATTEMPTS = 1000
_HEADINGS = (0.0, pi / 2, pi, -pi / 2)


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is to be driven.

    Attributes:
        grid: The map with its walls only.
        starts: Start cell of each robot, all different.
        headings: Direction of each robot at the start, radians.
        goals: Goal cell of each robot, all different, none of them a start of the same robot.
        known_boxes: Cells with a box that the planner is told of at the beginning.
        hidden_boxes: Cells with a box that a robot has to find.
    """

    grid: GridMap
    starts: tuple[int, ...]
    headings: tuple[float, ...]
    goals: tuple[int, ...]
    known_boxes: tuple[int, ...]
    hidden_boxes: tuple[int, ...]

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots, ``Robot1`` first."""
        return tuple(f"Robot{number}" for number in range(1, len(self.starts) + 1))

    @property
    def boxes(self) -> frozenset[int]:
        """Cells with a box."""
        return frozenset(self.known_boxes + self.hidden_boxes)


def make_scenario(
    grid: GridMap, robots: int, *, seed: int = 0, known_boxes: int = 2, hidden_boxes: int = 1
) -> Scenario:
    """Draw a scenario; the same arguments make the same one.

    Robots and boxes are drawn from the largest part of the map whose cells can reach one another, and they
    still can with all boxes in place. A hidden box stands on the shortest way of a robot if that is possible,
    so that somebody finds it.

    Raises:
        ScenarioError: The map has no room for so many robots and boxes.
    """
    rng = Random(seed)  # noqa: S311 - draws a scenario, keeps no secret
    room = _largest_part(grid)
    boxes_wanted = known_boxes + hidden_boxes
    # Robots need some cells to get around one another.
    if robots < 1 or 2 * robots + boxes_wanted > len(room):
        raise ScenarioError(f"{robots} robots and {boxes_wanted} boxes do not fit into {len(room)} cells")
    for _ in range(_ATTEMPTS):
        starts, goals = rng.sample(room, robots), rng.sample(room, robots)
        if any(start == goal for start, goal in zip(starts, goals, strict=True)):
            continue
        spare = sorted(set(room).difference(starts, goals))
        rng.shuffle(spare)
        known = _place_boxes(grid, spare, known_boxes)
        told = grid.with_blocked(grid.blocked.union(known))
        ways = [cell for robot in range(robots) for cell in _way(told, starts[robot], goals[robot])]
        rng.shuffle(ways)
        hidden = _place_boxes(told, [cell for cell in [*ways, *spare] if cell in spare], hidden_boxes)
        if len(known) + len(hidden) == boxes_wanted:
            headings = tuple(rng.choice(_HEADINGS) for _ in starts)
            return Scenario(grid, tuple(starts), headings, tuple(goals), known, hidden)
    raise ScenarioError(f"no scenario was found for {robots} robots and {boxes_wanted} boxes")


def given_scenario(grid: GridMap, pairs: Iterable[tuple[int, int]], *, seed: int = 0) -> Scenario:
    """A scenario with given starts and goals and no boxes, as of a benchmark.

    Raises:
        ScenarioError: Starts or goals are not all different, or a goal cannot be reached.
    """
    rng = Random(seed)  # noqa: S311 - draws headings, keeps no secret
    starts, goals = (tuple(cells) for cells in zip(*pairs, strict=True))
    if len(set(starts)) < len(starts) or len(set(goals)) < len(goals):
        raise ScenarioError("two robots have the same start or the same goal")
    for start, goal in zip(starts, goals, strict=True):
        if not grid.connected((start, goal)):
            raise ScenarioError(f"no way leads from cell {start} to cell {goal}")
    headings = tuple(rng.choice(_HEADINGS) for _ in starts)
    return Scenario(grid, starts, headings, goals, (), ())


def midway_cell(
    grid: GridMap,
    plans: Mapping[str, Sequence[int]],
    goals: Mapping[str, int],
    avoid: Collection[int] = (),
) -> int | None:
    """A cell to block while robots drive: as near as possible to the middle of the longest path left.

    Args:
        grid: The map with everything blocked that stands there, hidden boxes included.
        plans: Cells of each robot's path, its own first.
        goals: Goal of each robot.
        avoid: Cells that shall not be taken, such as those that robots were granted.

    Returns:
        A cell whose blocking cuts no robot off its goal; ``None`` if no path has one.
    """
    taken = {*goals.values(), *avoid, *(plan[0] for plan in plans.values() if plan)}
    for plan in sorted(plans.values(), key=len, reverse=True):
        middle = len(plan) / 2
        for index in sorted(range(1, len(plan)), key=lambda index: abs(index - middle)):
            cell = plan[index]
            if cell in taken or cell in grid.blocked:
                continue
            shut = grid.with_blocked(grid.blocked | {cell})
            if all(
                shut.connected((path[0], goals[robot])) for robot, path in plans.items() if robot in goals
            ):
                return cell
    return None


def _place_boxes(grid: GridMap, candidates: Sequence[int], count: int) -> tuple[int, ...]:
    """The first ``count`` cells that can be blocked without parting the cells around them, ascending."""
    placed: list[int] = []
    for cell in candidates:
        if len(placed) == count:
            break
        shut = grid.with_blocked({*grid.blocked, *placed, cell})
        if cell not in placed and shut.connected(shut.neighbours[cell]):
            placed.append(cell)
    return tuple(sorted(placed))


def _way(grid: GridMap, start: int, goal: int) -> list[int]:
    """Cells of the shortest way between two cells, without both."""
    return (shortest_path(grid, start, goal) or [])[1:-1]


def _largest_part(grid: GridMap) -> list[int]:
    """The largest set of free cells that can reach one another, ascending."""
    left = set(grid.free)
    best: set[int] = set()
    while left:
        part = grid.reachable(min(left))
        left -= part
        if len(part) > len(best):
            best = part
    return sorted(best)
