"""Demo scenarios: who starts where, who goes where, and what is in the way. All drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from random import Random
from typing import TYPE_CHECKING

from rce_fleet.exceptions import ScenarioError
from rce_fleet.planning.dijkstra import shortest_path
from rce_fleet.planning.lacam import DEFAULT_EFFORT, plan

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from rce_fleet.planning.grid import GridMap

_ATTEMPTS = 200
_EFFORT = DEFAULT_EFFORT
_EFFORT_PER_ROBOT = 4000
"""Moves of robots that are tried to find out whether all can get to their goals."""
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
    so that a robot finds it. On maps of narrow lanes there are fewer boxes than asked for, where more would
    leave no room to pass: all robots can always get to their goals at once.

    Raises:
        ScenarioError: The map has no room for so many robots and boxes.
    """
    rng = Random(seed)  # noqa: S311 - draws a scenario, keeps no secret
    room = _largest_part(grid)
    boxes_wanted = known_boxes + hidden_boxes
    # Robots need some cells to get around one another.
    if robots < 1 or 2 * robots + boxes_wanted > len(room):
        raise ScenarioError(f"{robots} robots and {boxes_wanted} boxes do not fit into {len(room)} cells")
    best: Scenario | None = None
    for _ in range(_ATTEMPTS):
        found = _draw(grid, room, robots, (known_boxes, hidden_boxes), rng)
        if found is None:
            continue
        if best is None or len(found.boxes) > len(best.boxes):
            best = found
        if len(best.boxes) == boxes_wanted:
            break
    if best is None:
        raise ScenarioError(
            f"no starts and goals were found for {robots} robots from which all can get to their goals; "
            "take fewer robots or a map with wider lanes"
        )
    return best


def _draw(
    grid: GridMap, room: Sequence[int], robots: int, boxes: tuple[int, int], rng: Random
) -> Scenario | None:
    """Draw a scenario with at most so many known and hidden boxes; ``None`` if it has no joint plan."""
    starts, goals = rng.sample(room, robots), rng.sample(room, robots)
    if any(start == goal for start, goal in zip(starts, goals, strict=True)):
        return None
    if not solvable(grid, starts, goals):
        return None
    spare = sorted(set(room).difference(starts, goals))
    rng.shuffle(spare)
    known = _place_boxes(grid, spare, boxes[0])
    known_grid = grid.with_blocked(grid.blocked.union(known))
    ways = [cell for robot in range(robots) for cell in _way(known_grid, starts[robot], goals[robot])]
    rng.shuffle(ways)
    hidden = _place_boxes(known_grid, [cell for cell in [*ways, *spare] if cell in spare], boxes[1])
    headings = tuple(rng.choice(_HEADINGS) for _ in starts)
    for told, found in ((known, hidden), (known, ()), ((), hidden)):
        if solvable(grid.with_blocked(grid.blocked.union(told, found)), starts, goals):
            return Scenario(grid, tuple(starts), headings, tuple(goals), told, found)
    return Scenario(grid, tuple(starts), headings, tuple(goals), (), ())


def solvable(grid: GridMap, starts: Sequence[int], goals: Sequence[int]) -> bool:
    """Whether a plan was found that brings every robot from its start to its goal, all at the same time.

    Args:
        grid: The map with everything blocked that stands there.
        starts: Cells of the robots, all different.
        goals: Where they are to be, all different.

    Returns:
        True only with a plan at hand; False also where the search gave up.
    """
    if not all(grid.connected((start, goal)) for start, goal in zip(starts, goals, strict=True)):
        return False
    return plan(grid, starts, goals, effort=max(_EFFORT, _EFFORT_PER_ROBOT * len(starts))).complete


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
        A cell whose blocking leaves all robots a way to their goals at once; ``None`` if there is none.
    """
    bound = [robot for robot, path in plans.items() if path and robot in goals]
    starts, ends = [plans[robot][0] for robot in bound], [goals[robot] for robot in bound]
    if len(set(starts)) < len(starts):
        return None
    for cell in _from_the_middle(plans, {*goals.values(), *avoid, *grid.blocked}):
        if solvable(grid.with_blocked(grid.blocked | {cell}), starts, ends):
            return cell
    return None


def _from_the_middle(plans: Mapping[str, Sequence[int]], taken: Collection[int]) -> Iterator[int]:
    """Each cell of the paths that no robot stands in, once: of the longest path first, its middle first."""
    seen = {*taken, *(path[0] for path in plans.values() if path)}
    for path in sorted(plans.values(), key=len, reverse=True):
        middle = len(path) / 2
        for index in sorted(range(1, len(path)), key=lambda index: abs(index - middle)):
            if path[index] not in seen:
                seen.add(path[index])
                yield path[index]


def _place_boxes(grid: GridMap, candidates: Sequence[int], count: int) -> tuple[int, ...]:
    """The first ``count`` cells that can be blocked without parting the cells around them, ascending."""
    placed: list[int] = []
    for cell in candidates:
        if len(placed) == count:
            break
        shut = grid.with_blocked({*grid.blocked, *placed, cell})
        if cell not in {*grid.blocked, *placed} and shut.connected(shut.neighbours[cell]):
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
