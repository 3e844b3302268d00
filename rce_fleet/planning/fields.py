"""Distance fields: the cost of the cheapest path to a goal, from every node.

A field is found by searching backwards from its goal: breadth first if every edge costs 1, and otherwise by
Dijkstra's algorithm. Fields of many goals are found side by side, :data:`LANES` at a time, by sweeps over all
nodes: an edge lowers the distances to all these goals at once, with a few instructions of the processor.

Fields of many goals are one table, a row for each goal. A table holds 16-bit numbers where they suffice: with
thousands of robots most of a planner's memory is this table.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from rce_fleet.compiled import helper, kernel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph

    Ints = NDArray[np.int32]
    Table = NDArray[np.int16] | NDArray[np.int32]

UNREACHABLE = np.int32(2**30)
"""Distance of nodes from which no path leads to the goal; two of them can be added."""
FAR_16 = 32_000
"""The same in a table of 16 bits."""
MAX_BUCKETS = 16
"""Largest cost of an edge for which open nodes are kept by distance in a circle of buckets."""
LANES = 32
"""Fields that are found side by side."""
_TOGETHER_FROM = 12
"""Goals from which on fields are found side by side."""
_MAX_EXACT = 2**24
"""Whole numbers up to this are exact in 32-bit floating point."""
_THREADS_FROM = 2_000_000
"""Entries of a table from which on two threads fill it."""


def distance_fields(
    graph: PlanningGraph,
    goals: Sequence[int] | Ints,
    forbidden: Mapping[int, frozenset[int]] | None = None,
    starts: Sequence[int] | Ints = (),
    own_costs: Mapping[int, Ints] | None = None,
) -> Ints:
    """Return the distance to each goal, shape (goals, nodes); :data:`UNREACHABLE` where there is no path.

    Args:
        graph: Nodes and edges.
        goals: Nodes where the paths end.
        forbidden: Nodes that cannot be entered for some of the goals, by their index.
        starts: Nodes that paths to each goal begin at; such a node has a distance even if it is forbidden.
        own_costs: Costs of all edges for some of the goals, by their index.
    """
    table = np.empty((len(goals), len(graph)), dtype=np.int32)
    fill_fields(graph, np.asarray(goals, np.int32), table)
    own, barred = own_costs or {}, forbidden or {}
    alike: dict[tuple[frozenset[int], int], list[int]] = {}
    for index in {**barred, **own}:
        key = barred.get(index, frozenset()), id(own.get(index, graph.costs))
        alike.setdefault(key, []).append(index)
    for (closed, _), indices in alike.items():
        other = graph.with_costs(own.get(indices[0], graph.costs))
        table[indices] = _fields_around(other, np.asarray(goals, np.int32)[indices], closed)
    for index, closed in (forbidden or {}).items():
        kept = [node for node in closed if index >= len(starts) or node != starts[index]]
        table[index, kept] = UNREACHABLE
    return table


def far_of(table: Table) -> int:
    """Return the number that means in a table that no path exists."""
    return FAR_16 if table.dtype == np.int16 else int(UNREACHABLE)


def field_table(graph: PlanningGraph, goals: Ints) -> Table:
    """Return the distance to each goal, shape (goals, nodes), in 16 bits if all distances fit."""
    longest = len(graph) * int(graph.costs.max(initial=1))
    if longest >= FAR_16 and len(goals) and graph.is_symmetric:
        probe = np.empty((1, len(graph)), np.int32)
        fill_fields(graph, goals[:1], probe)
        # In one connected part no distance is over twice the largest one from any node; others are not known.
        if (probe < UNREACHABLE).sum() > len(graph) - np.count_nonzero(np.diff(graph.indptr) == 0) - 1:
            longest = 2 * int(probe[probe < UNREACHABLE].max(initial=0))
    table = np.empty((len(goals), len(graph)), np.int16 if longest < FAR_16 else np.int32)
    fill_fields(graph, goals, table)
    return table


def fill_fields(graph: PlanningGraph, goals: Ints, table: Table) -> None:
    """Write the distances to each goal into ``table``, shape (goals, nodes)."""
    reverse, far = graph.reverse, far_of(table)
    is_exact = len(graph) * int(graph.costs.max(initial=1)) < _MAX_EXACT
    together = len(goals) >= _TOGETHER_FROM and is_exact

    def fill(part: slice) -> None:
        if together:
            spread_together(reverse.indptr, reverse.neighbours, reverse.costs, goals[part], far, table[part])
        elif graph.is_unweighted:
            spread(reverse.indptr, reverse.neighbours, goals[part], far, table[part])
        elif reverse.costs.max() <= MAX_BUCKETS:
            spread_in_buckets(
                reverse.indptr, reverse.neighbours, reverse.costs, goals[part], far, table[part]
            )
        else:
            relax(reverse.indptr, reverse.neighbours, reverse.costs, goals[part], far, table[part])

    if table.size < _THREADS_FROM:
        fill(slice(None))
        return
    half = len(goals) // 2
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(fill, slice(half, None))
        fill(slice(half))
        other.result()


def _fields_around(graph: PlanningGraph, goals: Ints, closed: frozenset[int]) -> Ints:
    """Return fields in which ``closed`` nodes are not entered; they have distances for a robot in them."""
    kept = ~np.isin(graph.neighbours, list(closed))
    counts = np.add.reduceat(np.append(kept, False), graph.indptr[:-1])
    counts[np.diff(graph.indptr) == 0] = 0
    indptr = np.concatenate(([0], np.cumsum(counts))).astype(np.int32)
    part = type(graph)(indptr, graph.neighbours[kept], graph.costs[kept], graph.columns)
    fields = np.empty((len(goals), len(graph)), np.int32)
    fill_fields(part, goals, fields)
    return fields


def _spread_numpy(indptr: Ints, neighbours: Ints, goals: Ints, far: int, table: Table) -> None:
    _relax_numpy(indptr, neighbours, np.ones_like(neighbours), goals, far, table)


def _relax_numpy(indptr: Ints, neighbours: Ints, costs: Ints, goals: Ints, far: int, table: Table) -> None:
    """Lower distances along all edges of the nodes that were lowered last, of all goals at once."""
    table[:] = far
    nodes = len(indptr) - 1
    flat: NDArray[Any] = table.reshape(-1)
    front = np.arange(len(goals), dtype=np.int64) * nodes + goals
    flat[front] = 0
    while len(front):
        row, node = np.divmod(front, nodes)
        begins = indptr[node]
        counts = indptr[node + 1] - begins
        ends = np.cumsum(counts)
        edges = np.repeat(begins - ends + counts, counts) + np.arange(ends[-1])
        reached = np.repeat(row * nodes, counts) + neighbours[edges]
        through = (np.repeat(flat[front], counts) + costs[edges]).astype(table.dtype)
        better = through < flat[reached]
        reached, through = reached[better], through[better]
        np.minimum.at(flat, reached, through)
        front = np.unique(reached)


_WEIGHTED = (
    "void(int32[::1], int32[::1], int32[::1], int32[::1], int64, int16[:, ::1])",
    "void(int32[::1], int32[::1], int32[::1], int32[::1], int64, int32[:, ::1])",
)


@kernel(
    "void(int32[::1], int32[::1], int32[::1], int64, int16[:, ::1])",
    "void(int32[::1], int32[::1], int32[::1], int64, int32[:, ::1])",
    numpy=_spread_numpy,
)
def spread(indptr: Ints, neighbours: Ints, goals: Ints, far: int, table: Table) -> None:
    """Fill a table by breadth-first search from each goal.

    Args:
        indptr: The reversed graph, with its neighbours.
        neighbours: See above.
        goals: Goal of each row, shape (goals,).
        far: Value of nodes without a path.
        table: Distances, shape (goals, nodes); written.
    """
    queue = np.empty(len(indptr), np.int32)
    for row in range(len(goals)):
        field = table[row]
        field[:] = far
        field[goals[row]] = 0
        queue[0] = goals[row]
        first, end = 0, 1
        while first < end:
            node = queue[first]
            first += 1
            through = field[node] + 1
            for edge in range(indptr[node], indptr[node + 1]):
                other = neighbours[edge]
                if field[other] > through:
                    field[other] = through
                    queue[end] = other
                    end += 1


@kernel(*_WEIGHTED, numpy=_relax_numpy)
def spread_in_buckets(
    indptr: Ints, neighbours: Ints, costs: Ints, goals: Ints, far: int, table: Table
) -> None:
    """Fill a table by Dijkstra's algorithm with buckets (Dial, 1969), for small costs; see :func:`spread`."""
    circle = 1
    for edge in range(len(costs)):
        circle = max(circle, costs[edge] + 1)
    size = len(indptr)
    buckets = np.empty((circle, size), np.int32)
    counts = np.zeros(circle, np.int32)
    for row in range(len(goals)):
        field = table[row]
        field[:] = far
        field[goals[row]] = 0
        buckets[0, 0] = goals[row]
        counts[0] = 1
        left = 1
        cost, now = 0, 0
        while left > 0:
            left -= counts[now]
            for place in range(counts[now]):
                node = buckets[now, place]
                if field[node] != cost:
                    continue
                for edge in range(indptr[node], indptr[node + 1]):
                    other = neighbours[edge]
                    through = cost + costs[edge]
                    if through < field[other]:
                        field[other] = through
                        slot = now + costs[edge]
                        if slot >= circle:
                            slot -= circle
                        buckets[slot, counts[slot]] = other
                        counts[slot] += 1
                        left += 1
            counts[now] = 0
            cost += 1
            now += 1
            if now == circle:
                now = 0


@kernel(*_WEIGHTED, numpy=_relax_numpy)
def relax(indptr: Ints, neighbours: Ints, costs: Ints, goals: Ints, far: int, table: Table) -> None:
    """Fill a table by Dijkstra's algorithm from each goal, with a binary heap; see :func:`spread`."""
    size = len(neighbours) + 2
    heap_cost = np.empty(size, np.int64)
    heap_node = np.empty(size, np.int32)
    for row in range(len(goals)):
        field = table[row]
        field[:] = far
        field[goals[row]] = 0
        heap_cost[0] = 0
        heap_node[0] = goals[row]
        count = 1
        while count > 0:
            cost, node = heap_cost[0], heap_node[0]
            count -= 1
            last_cost, last_node = heap_cost[count], heap_node[count]
            place = 0
            while 2 * place + 1 < count:
                child = 2 * place + 1
                if child + 1 < count and heap_cost[child + 1] < heap_cost[child]:
                    child += 1
                if heap_cost[child] >= last_cost:
                    break
                heap_cost[place] = heap_cost[child]
                heap_node[place] = heap_node[child]
                place = child
            heap_cost[place] = last_cost
            heap_node[place] = last_node
            if cost > field[node]:
                continue
            for edge in range(indptr[node], indptr[node + 1]):
                other = neighbours[edge]
                through = cost + costs[edge]
                if through < field[other]:
                    field[other] = through
                    place = count
                    count += 1
                    while place > 0 and heap_cost[(place - 1) // 2] > through:
                        heap_cost[place] = heap_cost[(place - 1) // 2]
                        heap_node[place] = heap_node[(place - 1) // 2]
                        place = (place - 1) // 2
                    heap_cost[place] = through
                    heap_node[place] = other


@helper
def _sweep(
    indptr: Ints,
    neighbours: Ints,
    costs: Ints,
    block: NDArray[np.float32],
    lowered: NDArray[np.uint8],
    forwards: bool,
) -> bool:
    """Lower distances along the edges of the nodes that were lowered; return whether a node was."""
    nodes = len(indptr) - 1
    is_open = False
    for place in range(nodes):
        node = place if forwards else nodes - 1 - place
        if not lowered[node]:
            continue
        lowered[node] = 0
        here = block[node]
        for edge in range(indptr[node], indptr[node + 1]):
            there = block[neighbours[edge]]
            cost = np.float32(costs[edge])
            better = np.int32(0)
            for lane in range(LANES):
                through, now = here[lane] + cost, there[lane]
                there[lane] = through if through < now else now  # noqa: FURB136 - min() is not vectorized
                better |= np.int32(through < now)
            if better:
                lowered[neighbours[edge]] = 1
                is_open = True
    return is_open


@kernel(*_WEIGHTED, numpy=_relax_numpy)
def spread_together(indptr: Ints, neighbours: Ints, costs: Ints, goals: Ints, far: int, table: Table) -> None:
    """Fill a table by sweeps over all nodes, for many goals at once; see :func:`spread`.

    Sweeps go through the nodes forwards and backwards in turn, from those whose distances were lowered, until
    there are none. On a grid most paths go in few directions, so a few sweeps suffice.
    """
    nodes = len(indptr) - 1
    block = np.empty((nodes, LANES), np.float32)
    lowered = np.zeros(nodes, np.uint8)
    for first in range(0, len(goals), LANES):
        count = min(LANES, len(goals) - first)
        block[:] = np.float32(far)
        for lane in range(count):
            block[goals[first + lane], lane] = np.float32(0)
            lowered[goals[first + lane]] = 1
        forwards = True
        while _sweep(indptr, neighbours, costs, block, lowered, forwards):
            forwards = not forwards
        for begin in range(0, nodes, LANES):
            for lane in range(count):
                for node in range(begin, min(begin + LANES, nodes)):
                    table[first + lane, node] = int(block[node, lane])


FIELD_KERNELS = (spread, spread_in_buckets, relax, spread_together)
