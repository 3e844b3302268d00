"""Large-neighbourhood search: make a joint plan better in the time that is left.

After Li et al., "Anytime Multi-Agent Path Finding via Large Neighborhood Search" (2021): again and again a
few robots are planned anew among all others, and the result is kept if it is not worse.
"""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel
from rce_fleet.planning.pibt import ROTATIONS
from rce_fleet.planning.spacetime import add_visits, find_path, occupant_at, remove_visits
from rce_fleet.planning.swap import draw

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph

    Ints = NDArray[np.int32]

GROUP = 32
"""Most robots of a group."""
_WAYS, _BY_WAY, _BY_PLACE = 8, 5, 2
"""Of so many groups, how many are found by a robot's shorter ways, and by a place; the others are drawn."""
_LOOK = 0.02
"""Seconds between two looks at the clock, about."""
_ATTEMPTS = 24
"""Walks to find the robots of a group."""
_MAX_STATES = 8_000
"""States of one search at most; each takes 20 bytes."""


@helper
def _add(robot: int, members: Ints, count: int, inside: Ints, stamp: int) -> int:
    """Add a robot to the group if it is not in it; return the group's size."""
    if robot < 0 or inside[robot] == stamp:
        return count
    inside[robot] = stamp
    members[count] = robot
    return count + 1


@helper
def _choose_group(
    indptr: Ints,
    neighbours: Ints,
    table: Ints,
    paths: Ints,
    arrivals: Ints,
    lower: Ints,
    counts: Ints,
    visits: Ints,
    members: Ints,
    inside: Ints,
    stamp: int,
    size: int,
    random: NDArray[np.int64],
) -> int:
    """Choose robots to plan anew; return their number.

    After Li et al., "Anytime Multi-Agent Path Finding via Large Neighborhood Search" (2021, section 4): a
    robot with much delay and those that are on shorter ways of it; robots that use one place; or any robots.
    """
    robots = len(arrivals)
    worst = draw(random) % robots
    for _ in range(8):
        other = draw(random) % robots
        if arrivals[other] - lower[other] > arrivals[worst] - lower[worst]:
            worst = other
    count = _add(worst, members, 0, inside, stamp)
    choice = draw(random) % _WAYS
    for attempt in range(_ATTEMPTS):
        if count >= size:
            break
        if choice < _BY_WAY:
            robot = worst if attempt < _ATTEMPTS // 2 else members[draw(random) % count]
            step = draw(random) % max(int(arrivals[robot]), 1)
            if attempt == 0:
                step = 0
            here = paths[robot, step]
            while count < size and step + 1 < paths.shape[1]:
                first, degree = indptr[here], indptr[here + 1] - indptr[here]
                turn = draw(random) % (degree + 1)
                there = -1
                for index in range(degree + 1):
                    place = (index + turn) % (degree + 1)
                    node = here if place == degree else neighbours[first + place]
                    if step + 1 + table[robot, node] < arrivals[robot]:
                        there = node
                        break
                if there < 0:
                    break
                count = _add(occupant_at(step + 1, there, counts, visits), members, count, inside, stamp)
                other = occupant_at(step, there, counts, visits)
                if count < size and other >= 0 and paths[other, step + 1] == here:
                    count = _add(other, members, count, inside, stamp)
                here = there
                step += 1
        elif choice < _BY_WAY + _BY_PLACE:
            step = draw(random) % (arrivals[worst] + 1)
            node = paths[worst, step]
            for _ in range(attempt):
                degree = indptr[node + 1] - indptr[node]
                if degree > 0:
                    node = neighbours[indptr[node] + draw(random) % degree]
            for later in range(max(step - 8, 0), min(step + 9, paths.shape[1])):
                if count < size:
                    count = _add(occupant_at(later, node, counts, visits), members, count, inside, stamp)
        else:
            count = _add(draw(random) % robots, members, count, inside, stamp)
    return count


def _improve(
    indptr: Ints,
    neighbours: Ints,
    table: Ints,
    goals: Ints,
    paths: Ints,
    arrivals: Ints,
    lower: Ints,
    flags: int,
    tries: int,
    counts: Ints,
    visits: Ints,
    best: NDArray[np.int64],
    pool: Ints,
    heads: Ints,
    old: Ints,
    inside: Ints,
    counters: NDArray[np.int64],
    random: NDArray[np.int64],
) -> int:
    """Plan groups of robots anew, and keep what is not worse.

    Args:
        indptr: The graph.
        neighbours: The graph.
        table: Distances, shape (robots, nodes).
        goals: Goal of each robot.
        paths: Node of each robot at each step, shape (robots, steps); changed.
        arrivals: Arrival of each robot; changed.
        lower: Distance of each robot's start from its goal.
        flags: See :mod:`~rce_fleet.planning.pibt`.
        tries: Number of groups.
        counts: See :mod:`~rce_fleet.planning.spacetime`; changed.
        visits: See there; changed.
        best: Scratch, see there.
        pool: Scratch, see there.
        heads: Scratch, see there.
        old: Scratch, shape (GROUP, steps).
        inside: Scratch, shape (robots,): stamp of the last group that a robot was in.
        counters: Groups and searches so far, shape (2,).
        random: State of the random numbers.

    Returns:
        By how many steps the sum of arrivals became smaller.
    """
    members = np.zeros(GROUP, np.int32)
    fresh = np.zeros(GROUP, np.int32)
    gain = 0
    for _ in range(tries):
        counters[0] += 1
        size = 2 + draw(random) % 10
        if draw(random) % 8 == 0:
            size = 1
        count = _choose_group(
            indptr, neighbours, table, paths, arrivals, lower, counts, visits, members, inside, counters[0],
            min(size, len(arrivals)), random,
        )  # fmt: skip
        before, rest = 0, 0
        for index in range(count):
            other = draw(random) % (index + 1)
            robot = members[index]
            members[index] = members[other]
            members[other] = robot
            before += arrivals[robot]
            rest += lower[robot]
        if before == rest:
            continue
        for index in range(count):
            robot = members[index]
            old[index] = paths[robot]
            remove_visits(paths[robot], counts, visits)
        total, planned = 0, 0
        while planned < count:
            robot = members[planned]
            rest -= lower[robot]
            counters[1] += 1
            arrival = find_path(
                indptr, neighbours, table[robot], old[planned, 0], goals[robot], before - total - rest, flags,
                paths, counts, visits, best, counters[1], pool, heads, random, paths[robot],
            )  # fmt: skip
            if arrival < 0:
                break
            total += arrival
            fresh[planned] = arrival
            add_visits(robot, paths[robot], counts, visits)
            planned += 1
        if planned == count:
            gain += before - total
            for index in range(count):
                arrivals[members[index]] = fresh[index]
            continue
        for index in range(planned):
            remove_visits(paths[members[index]], counts, visits)
        for index in range(count):
            robot = members[index]
            paths[robot] = old[index]
            add_visits(robot, paths[robot], counts, visits)
    return gain


_ROW, _TABLE, _LONG = "int32[::1]", "int32[:, ::1]", "int64[::1]"
improve = kernel(
    f"int64({_ROW}, {_ROW}, {_TABLE}, {_ROW}, {_TABLE}, {_ROW}, {_ROW}, int64, int64, {_ROW}, "
    f"int32[:, :, ::1], int64[:, ::1], {_TABLE}, {_ROW}, {_TABLE}, {_ROW}, {_LONG}, {_LONG})",
    numpy=_improve,
)(_improve)


def _enter_all(paths: Ints, counts: Ints, visits: Ints) -> None:
    """Enter all paths into empty lists of visits."""
    for robot in range(len(paths)):
        add_visits(robot, paths[robot], counts, visits)


enter_all = kernel(f"void({_TABLE}, {_ROW}, int32[:, :, ::1])", numpy=_enter_all)(_enter_all)


class Improver:
    """Improves a complete joint plan.

    Args:
        graph: Where robots drive.
        table: Distances to the goals, shape (robots, nodes).
        cells: The plan, shape (steps + 1, robots).
        goals: Goal of each robot.
        rotations: See :class:`~rce_fleet.planning.planner.PlanningProblem`.
        seed: Of the random numbers.
    """

    def __init__(
        self, graph: PlanningGraph, table: Ints, cells: Ints, goals: Ints, *, rotations: bool, seed: int
    ) -> None:
        self._graph, self._table, self._goals = graph, table, goals
        self._flags = ROTATIONS if rotations else 0
        self._random = np.array([(seed * 2654435761 + 97) & 0x7FFFFFFF], np.int64)
        robots = cells.shape[1]
        self._lower = np.ascontiguousarray(table[np.arange(robots), cells[0]])
        self._paths = np.ascontiguousarray(cells.T)
        moving = self._paths != self._goals[:, None]
        self._arrivals = np.where(
            moving.any(axis=1), cells.shape[0] - np.argmax(moving[:, ::-1], axis=1), 0
        ).astype(np.int32)
        self._inside = np.zeros(robots, np.int32)
        self.counters = np.zeros(2, np.int64)
        self._pool = np.empty((_MAX_STATES, 5), np.int32)
        self._fit()

    @property
    def cost(self) -> int:
        """Sum of the arrivals."""
        return int(self._arrivals.sum())

    @property
    def lower_bound(self) -> int:
        """Sum of the robots' distances from start to goal, steps."""
        return int(self._lower.sum())

    @property
    def cells(self) -> Ints:
        """The plan, shape (steps + 1, robots)."""
        return np.ascontiguousarray(self._paths[:, : int(self._arrivals.max(initial=0)) + 1].T)

    def _fit(self) -> None:
        """Make the arrays as long as the plan, with room for some later arrivals."""
        last = int(self._arrivals.max(initial=0))
        steps = last + 2 + last // 16
        robots, nodes = len(self._goals), len(self._graph)
        paths = np.empty((robots, steps), np.int32)
        kept = min(steps, self._paths.shape[1])
        paths[:, :kept] = self._paths[:, :kept]
        paths[:, kept:] = self._goals[:, None]
        self._paths = paths
        self._heads = np.empty(steps + 1, np.int32)
        self._old = np.empty((GROUP, steps), np.int32)
        self._best = np.zeros((nodes, steps + 1), np.int64)
        self._counts = np.zeros(nodes, np.int32)
        self._visits = np.empty((nodes, steps + 1, 3), np.int32)
        enter_all(self._paths, self._counts, self._visits)

    def improve(self, tries: int) -> None:
        """Plan ``tries`` groups of robots anew."""
        graph = self._graph
        improve(
            graph.indptr, graph.neighbours, self._table, self._goals, self._paths, self._arrivals,
            self._lower, self._flags, tries, self._counts, self._visits, self._best, self._pool,
            self._heads, self._old, self._inside, self.counters, self._random,
        )  # fmt: skip

    def run(self, deadline: float) -> None:
        """Improve the plan until ``deadline``, of :func:`time.perf_counter`."""
        tries = 1
        while perf_counter() < deadline and self.cost > int(self._lower.sum()):
            began = perf_counter()
            self.improve(tries)
            if perf_counter() - began < _LOOK:
                tries = min(2 * tries, 1024)
            elif tries > 1:
                tries //= 2
