"""The search of LaCAM: depth first over the configurations that PIBT proposes; see ``lacam``."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.planning.fields import far_of, fill_fields
from rce_fleet.planning.motion import Turning
from rce_fleet.planning.pibt import ROTATIONS, roll_out
from rce_fleet.planning.swap import OPEN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph

    Ints = NDArray[np.int32]
    Table = NDArray[np.int16] | NDArray[np.int32]

_CHUNK = 32
"""Steps that are made before the configurations are looked up."""
_PATIENCE = 20
"""Steps without a robot more at its goal, after which robots drive without weights and regard to turns."""


@dataclass(slots=True)
class _Node:
    """A configuration.

    Attributes:
        cells: Node of each robot.
        urgency: Steps since each robot was at its goal last.
        facing: Heading of each robot.
        parent: The configuration before; None for the start.
        constraints: What is still to be tried from here: nodes of some robots; None if nothing was tried yet.
        focus: Robots in the order in which they are constrained.
    """

    cells: Ints
    urgency: Ints
    facing: Ints
    parent: _Node | None
    constraints: deque[tuple[tuple[int, int], ...]] | None = None
    focus: Ints | None = None


class ConfigurationSearch:
    """Searches for a sequence of configurations that ends with the goals.

    Args:
        graph: Where robots drive.
        table: Distances to the goals, shape (robots, nodes). Rows of a weighted graph are replaced by
            distances in steps when the search gets no nearer with them: the swap rule is made for steps.
        goals: Goal of each robot.
        rotations: See :class:`~rce_fleet.planning.planner.PlanningProblem`.
        seed: Of the random numbers.
        turning: For moves with few turns, likewise until the search gets no nearer with it.
        keeps_weights: Whether weights are more than guidance: they are kept as long as the robots get nearer
            with them, and not only as long as more and more robots arrive.
    """

    def __init__(
        self,
        graph: PlanningGraph,
        table: Table,
        goals: Ints,
        *,
        rotations: bool,
        seed: int,
        turning: Turning | None = None,
        keeps_weights: bool = False,
    ) -> None:
        self._keeps_weights, self._least = keeps_weights, -1
        self._graph, self._goals = graph, goals
        self._table = table
        given = turning or Turning.none(len(goals))
        self._turning = replace(given, active=given.active.copy())
        self._weighted = np.full(len(goals), turning is not None or not graph.is_unweighted)
        self._flags = ROTATIONS if rotations else 0
        self._random = np.array([(seed * 2654435761 + 12345) & 0x7FFFFFFF], np.int64)
        self._rng = np.random.default_rng(seed)
        self._robots = np.arange(len(goals))
        self._free = np.full(len(goals), OPEN, np.int32)
        self._rows = np.zeros((_CHUNK + 1, len(goals)), np.int32)
        self._urgency = np.zeros((_CHUNK + 1, len(goals)), np.int32)
        self._facing = np.zeros((_CHUNK + 1, len(goals)), np.int32)
        self._fewest, self._since = len(goals) + 1, 0
        self.exhausted = False
        """Whether everything was tried: no plan exists."""

    def run(self, starts: Ints, rounds: int, urgency: Ints | None = None) -> tuple[Ints, bool]:
        """Return the configurations, shape (steps + 1, robots), and whether they end with the goals.

        Args:
            starts: The first configuration.
            rounds: Configurations to make at most.
            urgency: Steps that each robot has waited before; none if it is not given.
        """
        waited = np.zeros_like(starts) if urgency is None else urgency
        root = _Node(starts, waited, self._turning.headings, None)
        away = self._away(starts[None])[0]
        self._order = np.argsort(-away, kind="stable").astype(np.int32)
        known = {starts.tobytes(): root}
        stack = [root]
        best, best_rest = root, int(away.sum())
        while rounds > 0 and stack:
            node = stack[-1]
            if np.array_equal(node.cells, self._goals):
                return _trace(node), True
            count = self._step_from(node)
            rounds -= max(count, 1)
            if count < 0:  # nothing left to try
                stack.pop()
            if count <= 0:
                continue
            rests = self._away(self._rows[1 : count + 1]).sum(axis=1)
            for row in range(1, count + 1):
                key = self._rows[row].tobytes()
                reached = known.get(key)
                if reached is not None:
                    stack.append(reached)
                    break
                reached = _Node(
                    self._rows[row].copy(), self._urgency[row].copy(), self._facing[row].copy(), stack[-1]
                )
                if row < count:
                    reached.constraints = deque(self._children(()))
                known[key] = reached
                stack.append(reached)
                if rests[row - 1] < best_rest:
                    best, best_rest = reached, int(rests[row - 1])
        self.exhausted = not stack
        return _trace(best), np.array_equal(best.cells, self._goals)

    def _away(self, rows: Ints) -> NDArray[np.int64]:
        """Return the steps of each robot to its goal, shape as ``rows``."""
        away = self._table[self._robots, rows].astype(np.int64)
        return np.minimum(away, len(self._graph) * 16)

    def _step_from(self, node: _Node) -> int:
        """Try what comes next from a node; return the number of configurations made, -1 if all were tried."""
        self._rows[0], self._urgency[0], self._facing[0] = node.cells, node.urgency, node.facing
        if node.constraints is None:
            node.constraints = deque(self._children(()))
            count = self._roll_out(self._free, _CHUNK)
            self._drop_weights(count)
            return count
        if not node.constraints:
            return -1
        constraint = node.constraints.popleft()
        fixed = self._free.copy()
        if node.focus is None:
            node.focus = self._focus(node)
        for place, choice in constraint:
            robot = int(node.focus[place])
            ways = self._ways(robot, int(node.cells[robot]))
            if choice >= len(ways):
                return 0
            fixed[robot] = ways[choice]
        if len(constraint) < len(node.cells):
            node.constraints.extend(self._children(constraint))
        return max(self._roll_out(fixed, 1), 0)

    def _children(self, constraint: tuple[tuple[int, int], ...]) -> list[tuple[tuple[int, int], ...]]:
        """Return the constraints below one: the next robot with each of its choices, in random order."""
        most = int(np.diff(self._graph.indptr).max(initial=0)) + 1
        return [(*constraint, (len(constraint), int(choice))) for choice in self._rng.permutation(most)]

    def _ways(self, robot: int, node: int) -> list[int]:
        """Return the nodes that a robot can be in next: those from which it reaches its goal, and its own."""
        ways = self._graph.edges_from(node)
        return [*ways[self._table[robot, ways] < far_of(self._table)].tolist(), node]

    def _focus(self, node: _Node) -> Ints:
        """Order robots to be constrained: those away from their goals, then those near to them.

        Where robots block each other, it is mostly one of these that has to step aside. Nearness is the
        distance to the goal of the most urgent robot, whose way is blocked.
        """
        away = self._away(node.cells[None])[0]
        urgent = int(np.argmax(np.where(away > 0, node.urgency, -1)))
        near = np.abs(self._table[urgent, node.cells].astype(np.int64) - int(away[urgent]))
        return np.lexsort((near, -node.urgency, away == 0)).astype(np.int32)

    def _roll_out(self, fixed: Ints, steps: int) -> int:
        table = self._table
        return roll_out(
            self._graph.indptr, self._graph.neighbours, table, far_of(table), self._goals, fixed,
            self._rows[: steps + 1], self._urgency[: steps + 1], self._order, self._flags,
            self._facing[: steps + 1], *self._turning.arrays, self._random,
        )  # fmt: skip

    def _drop_weights(self, count: int) -> None:
        """Count steps for robots away from their goals if no more of them reach these with weights."""
        if count <= 0 or not self._weighted.any():
            return
        away = self._rows[1 : count + 1] != self._goals
        fewest = int(away.sum(axis=1).min())
        self._since = 0 if fewest < self._fewest else self._since + count
        self._fewest = min(fewest, self._fewest)
        if self._keeps_weights:
            least = int(self._away(self._rows[1 : count + 1]).sum(axis=1).min())
            if self._least < 0 or least < self._least:
                self._least, self._since = least, 0
        if self._since < _PATIENCE:
            return
        self._since = 0
        chosen = np.flatnonzero(away[-1] & self._weighted)
        self._weighted[chosen] = False
        self._turning.active[chosen] = 0
        if self._graph.is_unweighted:
            return
        rows = np.empty((len(chosen), len(self._graph)), self._table.dtype)
        fill_fields(self._graph.unweighted, self._goals[chosen], rows)
        # Nodes that are forbidden for a robot stay so.
        self._table[chosen] = np.where(self._table[chosen] >= far_of(rows), far_of(rows), rows)


def _trace(node: _Node) -> Ints:
    steps = []
    reached: _Node | None = node
    while reached is not None:
        steps.append(reached.cells)
        reached = reached.parent
    return np.stack(steps[::-1])
