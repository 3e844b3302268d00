"""The graph that robots are planned on: cells of a grid, or any nodes and edges.

A graph is three arrays in compressed rows (CSR): the nodes that can be entered from node ``v`` are
``neighbours[indptr[v]:indptr[v + 1]]``, and entering them costs ``costs[indptr[v]:indptr[v + 1]]``.
Edges are directed: a one-way aisle is an edge without its opposite.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from rce_fleet.planning.grid import GridMap

    Ints = NDArray[np.int32]

MAX_COST = 1_000_000
"""Maximum cost of an edge: the longest path of a large map must fit into 32 bits."""


@dataclass(frozen=True, slots=True)
class Edge:
    """A directed edge of a graph that is not a grid.

    Attributes:
        start: Node that it leaves.
        end: Node that it enters.
        cost: What driving it costs, a whole number of at least 1, for example tenths of a second.
    """

    start: int
    end: int
    cost: int = 1


@dataclass(frozen=True, eq=False)
class PlanningGraph:
    """Nodes and directed, weighted edges. The arrays must not be changed.

    Attributes:
        indptr: Where each node's edges begin, shape (nodes + 1,).
        neighbours: Node that each edge enters, shape (edges,).
        costs: Cost of each edge, shape (edges,), at least 1. Costs choose among paths; in a joint plan each
            move takes one step, whatever it costs.
        columns: Columns of the grid that the graph was made from; 0 if it is not a grid.
    """

    indptr: Ints
    neighbours: Ints
    costs: Ints
    columns: int = 0

    def __post_init__(self) -> None:
        if len(self.neighbours) != len(self.costs) or self.indptr[-1] != len(self.neighbours):
            raise ValueError("indptr, neighbours and costs do not describe the same edges")
        if len(self.costs) and not 1 <= self.costs.min() <= self.costs.max() <= MAX_COST:
            raise ValueError(f"costs must be within 1 .. {MAX_COST}")
        if len(self.neighbours) and not 0 <= self.neighbours.min() <= self.neighbours.max() < len(self):
            raise ValueError(f"an edge leads to a node outside 0 .. {len(self) - 1}")

    def __len__(self) -> int:
        return len(self.indptr) - 1

    @classmethod
    def from_grid(
        cls,
        grid: GridMap,
        *,
        costs: NDArray[np.integer] | None = None,
        closed: Iterable[tuple[int, int]] = (),
    ) -> PlanningGraph:
        """Return the graph of a grid's cells, numbered as in the grid.

        A blocked cell can be left, for a robot that stands in it, and not entered.

        Args:
            grid: The map.
            costs: Cost of entering each cell, shape (cells,), or of leaving each cell down (row - 1), left
                (column - 1), right and up (row + 1), shape (cells, 4); 1 by default. Slow zones and guidance
                are costs.
            closed: Moves ``(from, to)`` of neighbours that are not allowed, for one-way aisles.
        """
        rows, columns = grid.rows, grid.columns
        cells = np.arange(rows * columns, dtype=np.int32)
        row, column = np.divmod(cells, columns)
        enterable = np.ones(rows * columns, dtype=bool)
        enterable[list(grid.blocked)] = False
        targets = np.stack([cells - columns, cells - 1, cells + 1, cells + columns], axis=1)
        inside = np.stack([row > 0, column > 0, column < columns - 1, row < rows - 1], axis=1)
        kept = inside & enterable[np.where(inside, targets, 0)]
        shut = np.array(list(closed), dtype=np.int32).reshape(-1, 2)
        which, direction = np.nonzero(targets[shut[:, 0]] == shut[:, 1:])
        kept[shut[which, 0], direction] = False
        weights = np.ones(targets.shape, dtype=np.int32)
        if costs is not None:
            given = np.asarray(costs, dtype=np.int32)
            weights = given if given.ndim > 1 else given[np.where(inside, targets, 0)]
        indptr = np.zeros(rows * columns + 1, dtype=np.int32)
        indptr[1:] = np.cumsum(kept.sum(axis=1))
        return cls(indptr, targets[kept].astype(np.int32), weights[kept].astype(np.int32), columns)

    @classmethod
    def from_edges(cls, nodes: int, edges: Iterable[Edge]) -> PlanningGraph:
        """Return a graph of ``nodes`` nodes, numbered from 0, and directed edges.

        Raises:
            ValueError: An edge leads to a node that does not exist, or from a node to itself.
        """
        listed = sorted({(edge.start, edge.end): edge.cost for edge in edges}.items())
        for (start, end), _ in listed:
            if start == end or not (0 <= start < nodes and 0 <= end < nodes):
                raise ValueError(
                    f"an edge from {start} to {end}: it must join two of the nodes 0 .. {nodes - 1}"
                )
        indptr = np.zeros(nodes + 1, dtype=np.int32)
        np.add.at(indptr, [start + 1 for (start, _), _ in listed], 1)
        return cls(
            np.cumsum(indptr, dtype=np.int32),
            np.array([end for (_, end), _ in listed], dtype=np.int32),
            np.array([cost for _, cost in listed], dtype=np.int32),
        )

    @cached_property
    def is_unweighted(self) -> bool:
        """Whether every edge costs 1, so that costs are steps."""
        return bool((self.costs == 1).all())

    @cached_property
    def is_symmetric(self) -> bool:
        """Whether every edge has its opposite with the same cost."""
        reverse = self.reverse
        if not np.array_equal(self.indptr, reverse.indptr):
            return False
        # Rows of the reverse are sorted by node; rows of this graph need not be.
        rows = np.repeat(np.arange(len(self)), np.diff(self.indptr))
        order = np.lexsort((self.neighbours, rows))
        return np.array_equal(self.neighbours[order], reverse.neighbours) and np.array_equal(
            self.costs[order], reverse.costs
        )

    @cached_property
    def reverse(self) -> PlanningGraph:
        """The same nodes with every edge turned round, to search from goals."""
        sources = np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.indptr))
        order = np.argsort(self.neighbours, kind="stable")
        indptr = np.zeros(len(self) + 1, dtype=np.int32)
        indptr[1:] = np.cumsum(np.bincount(self.neighbours, minlength=len(self)))
        return PlanningGraph(indptr, sources[order], self.costs[order], self.columns)

    @cached_property
    def unweighted(self) -> PlanningGraph:
        """The same edges, each with cost 1."""
        if self.is_unweighted:
            return self
        return self.with_costs(np.ones_like(self.costs))

    def with_costs(self, costs: Ints) -> PlanningGraph:
        """Return the same edges with other costs, shape (edges,)."""
        return PlanningGraph(self.indptr, self.neighbours, costs, self.columns)

    def edges_from(self, node: int) -> Ints:
        """Return the nodes that can be entered from ``node``."""
        return self.neighbours[self.indptr[node] : self.indptr[node + 1]]
