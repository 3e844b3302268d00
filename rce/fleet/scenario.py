"""Demo scenarios: who starts where, who goes where, and what is in the way. All drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from random import Random
from typing import TYPE_CHECKING

from rce.fleet.exceptions import ScenarioError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from rce.fleet.grid import GridMap

_ATTEMPTS = 1000


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

    Free cells that could reach one another still can with all boxes in place, and one more cell can be blocked
    without parting them: nobody's goal is cut off.

    Raises:
        ScenarioError: The map has no room for so many robots and boxes.
    """
    rng = Random(seed)  # noqa: S311 - draws a scenario, keeps no secret
    room = _largest_part(grid)
    boxes_wanted = known_boxes + hidden_boxes
    # Robots need some cells to get around one another.
    if robots < 1 or 2 * robots + boxes_wanted > len(room):
        raise ScenarioError(
            f"{robots} robots and {boxes_wanted} boxes do not fit into {len(room)} free cells"
        )
    for _ in range(_ATTEMPTS):
        boxes = rng.sample(room, boxes_wanted)
        left = sorted(set(room) - set(boxes))
        if not grid.with_blocked(grid.blocked.union(boxes)).connected(left):
            continue
        starts, goals = rng.sample(left, robots), rng.sample(left, robots)
        if any(start == goal for start, goal in zip(starts, goals, strict=True)):
            continue
        headings = tuple(rng.choice((0.0, pi / 2, pi, -pi / 2)) for _ in starts)
        known, hidden = tuple(sorted(boxes[:known_boxes])), tuple(sorted(boxes[known_boxes:]))
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
    headings = tuple(rng.choice((0.0, pi / 2, pi, -pi / 2)) for _ in starts)
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
