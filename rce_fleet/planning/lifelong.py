"""Lifelong planning: robots that get a new goal when they reach one.

Each step, PIBT with swap makes the last step of a window, so that there always is a plan without conflicts;
then robots and groups of robots are planned anew within the window, as in Li et al., "Lifelong Multi-Agent
Path Finding in Large-Scale Warehouses" (2021), but by large-neighbourhood search. Then robots step.

The robot whose last goal is longest ago is the most urgent one. PIBT moves it first, and planning anew never
makes it later at its goal. So it arrives, another one is the most urgent, and every robot is in its turn, if
every edge is on a circle (Okumura et al. 2022) and the swap rule does not have it make way in a passage.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import PlanningError
from rce_fleet.planning.fields import FIELD_KERNELS, UNREACHABLE, fill_fields
from rce_fleet.planning.motion import Turning
from rce_fleet.planning.pibt import ROTATIONS, roll_out
from rce_fleet.planning.swap import OPEN, draw
from rce_fleet.planning.window import improve_window

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph

    Ints = NDArray[np.int32]

LIFELONG_KERNELS = (*FIELD_KERNELS, roll_out, improve_window)
_PARTS = 4
"""With limited time, the clock is read so often while each robot is planned alone."""
KNOWN = 3
"""Goals of each robot that are known ahead, with the one that it drives to."""
FARTHEST = int(UNREACHABLE) // 2
"""Cost of a way over goals that are out of reach; with the way to the first goal the sum fits in an int32."""


@dataclass(frozen=True, slots=True)
class LifelongSettings:
    """Parameters of lifelong planning.

    Attributes:
        window: Steps that are planned ahead.
        tries: Groups of robots that are planned anew in each step, by robot.
        seconds: Time of a step at most, about; 0: not limited. Without a limit the same seed gives the same
            run. What keeps robots apart is done in any case.
        rotations: See :class:`~rce_fleet.planning.planner.PlanningProblem`.
    """

    window: int = 20
    tries: int = 8
    seconds: float = 0.0
    rotations: bool = True


class LifelongPlanner:
    """Steps robots towards goals that never end.

    Args:
        graph: Where robots drive; its costs are guidance.
        starts: Node of each robot, all different.
        next_goal: Returns a robot's next goal, by its index and the goal before it.
        seed: Of the random numbers.
        settings: See there.

    Attributes:
        cells: Node of each robot, shape (robots,).
        goals: Goals that each robot has reached, in order.
    """

    def __init__(
        self,
        graph: PlanningGraph,
        starts: Ints,
        next_goal: Callable[[int, int], int],
        *,
        seed: int = 0,
        settings: LifelongSettings | None = None,
    ) -> None:
        self._settings = settings or LifelongSettings()
        self._graph = graph
        self._next_goal = next_goal
        self._flags = ROTATIONS if self._settings.rotations else 0
        self._random = np.array([(seed * 2654435761 + 4711) & 0x7FFFFFFF], np.int64)
        robots = len(starts)
        self.cells = starts.copy()
        self.goals: list[list[int]] = [[] for _ in range(robots)]
        self._known = np.zeros((robots, KNOWN), np.int32)
        self._table = np.zeros((robots * KNOWN, len(graph)), np.int32)
        self._base = np.zeros((robots, KNOWN), np.int32)
        for robot in range(robots):
            before = int(starts[robot])
            for place in range(KNOWN):
                before = self._known[robot, place] = next_goal(robot, before)
        fill_fields(graph, self._known.reshape(-1), self._table)
        unreachable = np.flatnonzero(self._table[::KNOWN][np.arange(robots), starts] >= UNREACHABLE)
        if len(unreachable):
            robot = int(unreachable[0])
            raise PlanningError(
                f"robot {robot} cannot reach its goal {self._known[robot, 0]} from its start {starts[robot]}"
            )
        self._use(graph)
        self._turning = Turning.none(robots)
        self._paid = np.zeros(robots, np.int32)
        self._paths = np.repeat(starts[:, None], self._settings.window + 1, axis=1)
        self._urgency = np.zeros(robots, np.int32)
        self._order = np.arange(robots, dtype=np.int32)

    def step(self) -> int:
        """Move all robots by one step; return the number of goals that were reached."""
        began = perf_counter()
        urgent = int(np.argmax(self._urgency))
        self._extend(urgent)
        robots = len(self.cells)
        turn = draw(self._random) % robots
        groups = robots * (1 + self._settings.tries)
        limit = self._settings.seconds
        part = max(robots // _PARTS, 1) if limit else groups
        done = 0
        while done < groups and not (limit and perf_counter() - began >= limit):
            self._improve(urgent, turn, done, min(done + part, groups))
            done += part
        self.cells = self._paths[:, 1].copy()
        self._paths = np.ascontiguousarray(np.concatenate((self._paths[:, 1:], self._paths[:, -1:]), axis=1))
        self._urgency += 1
        arrived = np.flatnonzero(self.cells == self._known[:, 0])
        for robot in arrived.tolist():
            self._arrive(robot)
        return len(arrived)

    def target(self, robot: int) -> int:
        """Return the goal that a robot drives to."""
        return int(self._known[robot, 0])

    def guide(self, graph: PlanningGraph) -> None:
        """Drive by other costs from now on, such as those of ``congestion``.

        Args:
            graph: The same nodes and edges.
        """
        if not np.array_equal(graph.neighbours, self._graph.neighbours):
            raise PlanningError("the graph with other costs must have the same nodes and edges")
        fill_fields(graph, self._known.reshape(-1), self._table)
        self._use(graph)

    def waiting(self) -> tuple[Ints, Ints]:
        """Return the nodes in which robots are about to wait, and the node that each wants to enter."""
        known = self._known[:, 0]
        chosen = np.flatnonzero((self._paths[:, 0] == self._paths[:, 1]) & (self._paths[:, 0] != known))
        here = self._paths[chosen, 0]
        wanted = here.copy()
        for index, (robot, node) in enumerate(zip(chosen.tolist(), here.tolist(), strict=True)):
            ways = self._graph.edges_from(node)
            first = self._graph.indptr[node]
            costs = self._graph.costs[first : first + len(ways)] + self._table[robot * KNOWN, ways]
            wanted[index] = ways[int(np.argmin(costs))]
        return here, wanted

    def _use(self, graph: PlanningGraph) -> None:
        """Take over a graph's costs."""
        self._graph = graph
        wait = int(np.median(graph.costs)) if len(graph.costs) else 1
        self._costs = np.concatenate(([wait], graph.costs)).astype(np.int32)
        for robot in range(len(self.cells)):
            self._sum_up(robot)

    def _improve(self, urgent: int, turn: int, begin: int, end: int) -> None:
        """Plan groups of robots anew; see :func:`~rce_fleet.planning.window.improve_window`."""
        graph = self._graph
        improve_window(
            graph.indptr, graph.neighbours, self._costs, self._table, self._base, self._known,
            int(UNREACHABLE), self._flags, urgent, turn, begin, end, self._paths, self._paid, self._random,
        )  # fmt: skip

    def _extend(self, urgent: int) -> None:
        """Make the last step of the window by PIBT, from the configuration before it.

        The robot that has been without a goal for longest is the first one, so it gets nearer.
        """
        before = self._paths[:, -2]
        reached = np.zeros(len(before), np.int64)
        waited = self._urgency.copy()
        for step in range(1, self._paths.shape[1] - 1):
            at = np.minimum(reached, KNOWN - 1)
            arrives = (self._known[np.arange(len(before)), at] == self._paths[:, step]) & (reached < KNOWN)
            reached += arrives
            waited = np.where(arrives, 0, waited + 1)
        if not reached[urgent]:
            waited[urgent] += 1  # before others that have waited as long
        reached = np.minimum(reached, KNOWN - 1)
        robots = np.arange(len(before))
        rows = np.zeros((2, len(before)), np.int32)
        rows[0] = before
        urgency = np.zeros((2, len(before)), np.int32)
        urgency[0] = waited
        table = np.ascontiguousarray(self._table[robots * KNOWN + reached])
        roll_out(
            self._graph.indptr, self._graph.neighbours, table, int(UNREACHABLE), self._known[robots, reached],
            np.full(len(before), OPEN, np.int32), rows, urgency, self._order, self._flags,
            np.zeros_like(rows), *self._turning.arrays, self._random,
        )  # fmt: skip
        self._paths[:, -1] = rows[1]

    def _arrive(self, robot: int) -> None:
        """Give a robot its next goal."""
        self._urgency[robot] = 0
        self.goals[robot].append(int(self._known[robot, 0]))
        rows = slice(robot * KNOWN, (robot + 1) * KNOWN)
        table = self._table[rows]
        table[:-1] = table[1:].copy()
        self._known[robot, :-1] = self._known[robot, 1:].copy()
        self._known[robot, -1] = self._next_goal(robot, int(self._known[robot, -2]))
        fill_fields(self._graph, self._known[robot, -1:], table[-1:])
        self._sum_up(robot)

    def _sum_up(self, robot: int) -> None:
        """Write the costs from each known goal over the later ones."""
        total = 0
        for place in range(KNOWN - 1, 0, -1):
            self._base[robot, place] = total
            way = int(self._table[robot * KNOWN + place, self._known[robot, place - 1]])
            total = min(total + way, FARTHEST)
        self._base[robot, 0] = total
