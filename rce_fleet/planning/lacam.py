"""LaCAM: complete planning for several robots over the configurations that PIBT proposes.

After Okumura, "LaCAM: Search-Based Algorithm for Quick Multi-Agent Pathfinding" (2023): a depth-first
search over configurations. Every configuration has a tree of constraints, read breadth first, that
forces more and more robots to other cells, so that in the end all successors are tried. Given time, it finds
a plan whenever one exists; after a limit on the work it returns the best configuration found so far.
"""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field
from math import inf
from random import Random
from typing import TYPE_CHECKING

from rce_fleet.planning.dijkstra import distances
from rce_fleet.planning.pibt import Configuration, ConfigurationGenerator

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.planning.grid import GridMap

DEFAULT_EFFORT = 40_000
"""How many single-robot moves are tried before the search gives up."""


@dataclass(frozen=True, slots=True)
class JointPlan:
    """The cell of every robot at every step.

    In a step a robot stays or goes to a neighbouring cell. It may enter the cell that another leaves in
    the same step, but robots never follow one another around in a circle.

    Attributes:
        steps: Configurations, from the start on.
        complete: Whether the last one is the goal; otherwise it is the nearest that was found.
    """

    steps: tuple[Configuration, ...]
    complete: bool

    def route(self, robot: int) -> list[tuple[int, int]]:
        """``(step, cell)`` of every cell that a robot enters, the start with step 0 first."""
        route = [(0, self.steps[0][robot])]
        for step, configuration in enumerate(self.steps):
            if configuration[robot] != route[-1][1]:
                route.append((step, configuration[robot]))
        return route


@dataclass(slots=True)
class _Node:
    """A configuration in the search, with what is still to be tried from it."""

    cells: Configuration
    parent: _Node | None
    urgency: list[float]
    order: list[int]
    focus: list[int] | None = None
    constraints: deque[tuple[tuple[int, int], ...]] = field(default_factory=lambda: deque([()]))


def plan(
    grid: GridMap,
    starts: Sequence[int],
    goals: Sequence[int],
    *,
    seed: int = 0,
    effort: int = DEFAULT_EFFORT,
) -> JointPlan:
    """Return a plan that brings every robot from its start to its goal.

    Args:
        grid: The map. A robot may start in a blocked cell and leave it; none enters one.
        starts: Cells of the robots, all different.
        goals: Goal cells of the robots, all different.
        seed: The same arguments with the same seed make the same plan.
        effort: Moves of single robots to try at most.
    """
    if len(set(starts)) != len(starts) or len(set(goals)) != len(goals) or len(starts) != len(goals):
        raise ValueError("each robot needs a start and a goal: all starts different, all goals different")
    if not starts:
        return JointPlan(((),), complete=True)
    fields = [_field(grid, start, goal) for start, goal in zip(starts, goals, strict=True)]
    search = _Search(grid, fields, Random(seed))  # noqa: S311 - for ties, not for secrets
    return search.run(tuple(starts), tuple(goals), effort // len(starts))


def _field(grid: GridMap, start: int, goal: int) -> list[float]:
    """Distances to the goal, also from a start that is blocked and can only be left."""
    costs = distances(grid, goal)
    if start == goal:
        costs[start] = 0.0
    elif start in grid.blocked:
        costs[start] = 1.0 + min((costs[cell] for cell in grid.neighbours[start]), default=inf)
    return costs


class _Search:
    def __init__(self, grid: GridMap, fields: list[list[float]], rng: Random) -> None:
        self._grid = grid
        self._fields = fields
        self._rng = rng
        self._generator = ConfigurationGenerator(grid.neighbours, fields, rng)

    def run(self, starts: Configuration, goals: Configuration, rounds: int) -> JointPlan:
        root = self._node(starts, None)
        known = {starts: root}
        stack = [root]
        best, best_rest = root, self._rest(starts)
        for _ in range(max(rounds, 1)):
            node = stack[-1]
            if node.cells == goals:
                return JointPlan(_straighten(_trace(node)), complete=True)
            if not node.constraints:
                stack.pop()
                if not stack:
                    break
                continue
            successor = self._successor(node)
            if successor is None:
                continue
            reached = known.get(successor)
            if reached is None:
                reached = known[successor] = self._node(successor, node)
                rest = self._rest(successor)
                if rest < best_rest:
                    best, best_rest = reached, rest
            stack.append(reached)
        return JointPlan(_straighten(_trace(best)), complete=best.cells == goals)

    def _node(self, cells: Configuration, parent: _Node | None) -> _Node:
        """A node whose robots are the more urgent the longer they have been away from their goals."""
        away = [self._fields[robot][cell] for robot, cell in enumerate(cells)]
        if parent is None:
            urgency = [distance / len(self._grid) if distance < inf else 0.0 for distance in away]
        else:
            urgency = [
                before + 1.0 if distance > 0 else before % 1.0
                for before, distance in zip(parent.urgency, away, strict=True)
            ]
        order = sorted(range(len(cells)), key=lambda robot: -urgency[robot])
        return _Node(cells, parent, urgency, order)

    def _successor(self, node: _Node) -> Configuration | None:
        """Read the next constraint, grow the tree below it, and let PIBT fill in the rest."""
        constraint = node.constraints.popleft()
        if len(constraint) < len(node.cells):
            robot = self._focus(node)[len(constraint)]
            choices = [*self._grid.neighbours[node.cells[robot]], node.cells[robot]]
            self._rng.shuffle(choices)
            node.constraints.extend((*constraint, (robot, cell)) for cell in choices)
        before = node.parent.cells if node.parent is not None else node.cells
        return self._generator.generate(node.cells, before, node.order, dict(constraint))

    def _focus(self, node: _Node) -> list[int]:
        """The robots in the order in which they are constrained.

        First come those that are not at their goals, then those nearest to them: where robots block each
        other, it is mostly one of these that has to step aside.
        """
        if node.focus is None:
            away = [robot for robot in node.order if self._fields[robot][node.cells[robot]] > 0]
            places = [self._grid.place(node.cells[robot]) for robot in away]
            rest = [robot for robot in node.order if self._fields[robot][node.cells[robot]] == 0]

            def distance(robot: int) -> int:
                row, column = self._grid.place(node.cells[robot])
                return min((abs(row - r) + abs(column - c) for r, c in places), default=0)

            node.focus = [*away, *sorted(rest, key=distance)]
        return node.focus

    def _rest(self, cells: Configuration) -> float:
        return sum(min(self._fields[robot][cell], len(self._grid)) for robot, cell in enumerate(cells))


def _trace(node: _Node) -> list[Configuration]:
    steps = []
    reached: _Node | None = node
    while reached is not None:
        steps.append(reached.cells)
        reached = reached.parent
    return steps[::-1]


def _straighten(steps: list[Configuration]) -> tuple[Configuration, ...]:
    """Replace loops by waiting: a robot waits in a cell that it would leave and come back to.

    PIBT moves robots that could stand still. If no other robot enters the cell meanwhile, waiting in it
    blocks none, so each such loop is cut out.
    """
    paths = [list(cells) for cells in zip(*steps, strict=True)]
    occupants: dict[int, dict[int, int]] = defaultdict(dict)
    for step, cells in enumerate(steps):
        for robot, cell in enumerate(cells):
            occupants[cell][step] = robot
    shortened = True
    while shortened:
        shortened = False
        for robot, path in enumerate(paths):
            shortened |= _cut_loop(robot, path, occupants)
    return tuple(zip(*paths, strict=True))


def _cut_loop(robot: int, path: list[int], occupants: dict[int, dict[int, int]]) -> bool:
    """Cut the longest loop of ``path`` from its earliest cell that allows one.

    Args:
        robot: Whose path it is.
        path: Its cell at every step; changed.
        occupants: For every cell the robot that is in it, by step; changed.
    """
    last = {cell: step for step, cell in enumerate(path)}
    for step, cell in enumerate(path[:-1]):
        if path[step + 1] == cell:
            continue
        back = last[cell]
        robots = occupants[cell]
        while back > step + 1:
            if path[back] == cell and all(robots.get(at, robot) == robot for at in range(step + 1, back)):
                for at in range(step, back):
                    del occupants[path[at]][at]
                    robots[at] = robot
                path[step:back] = [cell] * (back - step)
                return True
            back -= 1
    return False
