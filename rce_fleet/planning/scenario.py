"""Demo scenarios: starts, goals and boxes, drawn from a seed."""

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
"""Moves of robots to try before a scenario is taken as not solvable."""
_HEADINGS = (0.0, pi / 2, pi, -pi / 2)


@dataclass(frozen=True, slots=True)
class Scenario:
    """Starts, goals and boxes on a map.

    Attributes:
        grid: The map with its walls only.
        starts: Start cell of each robot, all different.
        headings: Direction of each robot at the start, radians.
        goals: Goal cell of each robot, all different, none of them a start of the same robot.
        known_boxes: Cells with a box that the planner knows from the beginning.
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

    Robots and boxes are placed in the largest connected part of the map, which stays connected with all
    boxes. A hidden box stands on the shortest path of a robot if possible, so that a robot finds it. A map
    of narrow lanes gets fewer boxes than requested if more would leave no room to pass: all robots can
    always reach their goals, at the same time.

    Raises:
        ScenarioError: The map is too small for the robots and boxes.
    """
    rng = Random(seed)  # noqa: S311 - for scenarios, not for secrets
    room = _largest_part(grid)
    boxes_wanted = known_boxes + hidden_boxes
    # Robots need free cells to pass each other.
    if robots < 1 or 2 * robots + boxes_wanted > len(room):
        raise ScenarioError(
            f"{robots} robots and {boxes_wanted} boxes do not fit into {len(room)} cells; take fewer robots"
        )
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
            f"found no starts and goals from which all {robots} robots can reach their goals; "
            "take fewer robots or a map with wider lanes"
        )
    return best


def spread_scenario(grid: GridMap, robots: int, *, seed: int = 0) -> Scenario:
    """Draw starts and goals of many robots, without boxes; the same arguments make the same scenario.

    No joint plan is made: on a map with as much room as robots each can reach its goal, but whether all can
    stand at theirs at the same time is not checked.

    Raises:
        ScenarioError: The map is too small for the robots.
    """
    rng = Random(seed)  # noqa: S311 - for scenarios, not for secrets
    room = _largest_part(grid)
    if robots < 1 or 2 * robots > len(room):
        raise ScenarioError(f"{robots} robots do not fit into {len(room)} cells; take fewer robots")
    starts, goals = rng.sample(room, robots), rng.sample(room, robots)
    while any(start == goal for start, goal in zip(starts, goals, strict=True)):
        goals = rng.sample(room, robots)
    headings = tuple(rng.choice(_HEADINGS) for _ in starts)
    return Scenario(grid, tuple(starts), headings, tuple(goals), (), ())


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
    placeable = set(spare)
    hidden = _place_boxes(known_grid, [cell for cell in [*ways, *spare] if cell in placeable], boxes[1])
    headings = tuple(rng.choice(_HEADINGS) for _ in starts)
    for told, found in ((known, hidden), (known, ()), ((), hidden)):
        if solvable(grid.with_blocked(grid.blocked.union(told, found)), starts, goals):
            return Scenario(grid, tuple(starts), headings, tuple(goals), told, found)
    return Scenario(grid, tuple(starts), headings, tuple(goals), (), ())


def solvable(grid: GridMap, starts: Sequence[int], goals: Sequence[int]) -> bool:
    """Return whether a plan was found that brings all robots from their starts to their goals.

    Args:
        grid: The map, with all boxes as blocked cells.
        starts: Cells of the robots, all different.
        goals: Goal cells of the robots, all different.

    Returns:
        True if a plan was found; False also if the search reached its limit.
    """
    if not all(grid.connected((start, goal)) for start, goal in zip(starts, goals, strict=True)):
        return False
    return plan(grid, starts, goals, effort=max(_EFFORT, _EFFORT_PER_ROBOT * len(starts))).complete


def given_scenario(grid: GridMap, pairs: Iterable[tuple[int, int]], *, seed: int = 0) -> Scenario:
    """Return a scenario with given starts and goals and without boxes, as in a benchmark.

    Raises:
        ScenarioError: There are no pairs, starts or goals are not all different, or a goal cannot be reached.
    """
    rng = Random(seed)  # noqa: S311 - for headings, not for secrets
    pairs = tuple(pairs)
    if not pairs:
        raise ScenarioError("a scenario needs a start and a goal of one robot at least")
    starts, goals = (tuple(cells) for cells in zip(*pairs, strict=True))
    if len(set(starts)) < len(starts) or len(set(goals)) < len(goals):
        raise ScenarioError("two robots have the same start or the same goal; make them different")
    for start, goal in zip(starts, goals, strict=True):
        if not grid.connected((start, goal)):
            raise ScenarioError(f"no path leads from cell {start} to cell {goal}; choose another goal")
    headings = tuple(rng.choice(_HEADINGS) for _ in starts)
    return Scenario(grid, starts, headings, goals, (), ())


def midway_cell(
    grid: GridMap,
    plans: Mapping[str, Sequence[int]],
    goals: Mapping[str, int],
    avoid: Collection[int] = (),
) -> int | None:
    """Return a cell to block while robots drive: as near as possible to the middle of the longest path.

    Args:
        grid: The map, with all boxes as blocked cells, hidden boxes too.
        plans: Cells of each robot's path, its own first.
        goals: Goal of each robot.
        avoid: Cells not to return, such as those that are granted to robots.

    Returns:
        A cell around which all robots can still reach their goals at the same time; ``None`` without one.
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
    """Yield each cell of the paths without a robot once: those of the longest path first, from its middle."""
    seen = {*taken, *(path[0] for path in plans.values() if path)}
    for path in sorted(plans.values(), key=len, reverse=True):
        middle = len(path) / 2
        for index in sorted(range(1, len(path)), key=lambda index: abs(index - middle)):
            if path[index] not in seen:
                seen.add(path[index])
                yield path[index]


def _place_boxes(grid: GridMap, candidates: Sequence[int], count: int) -> tuple[int, ...]:
    """Return the first ``count`` cells that can be blocked while the map stays connected, ascending."""
    placed: list[int] = []
    for cell in candidates:
        if len(placed) == count:
            break
        shut = grid.with_blocked({*grid.blocked, *placed, cell})
        if cell not in {*grid.blocked, *placed} and shut.connected(shut.neighbours[cell]):
            placed.append(cell)
    return tuple(sorted(placed))


def _way(grid: GridMap, start: int, goal: int) -> list[int]:
    """Return the cells of the shortest path between two cells, without both."""
    return (shortest_path(grid, start, goal) or [])[1:-1]


def _largest_part(grid: GridMap) -> list[int]:
    """Return the largest connected set of free cells, ascending."""
    seen: set[int] = set()
    best: set[int] = set()
    for cell in grid.free:
        if cell not in seen:
            part = grid.reachable(cell)
            seen |= part
            if len(part) > len(best):
                best = part
    return sorted(best)
