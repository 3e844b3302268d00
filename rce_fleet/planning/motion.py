"""How real robots move: turning takes time, and so do stopping and starting.

In a joint plan each move takes one step, whatever the robot's heading. With a :class:`Motion` the planner
prefers paths with few turns, so that robots need less time to carry the plan out (``execution``).

Costs with turns are found on the line graph: its nodes are the edges of the graph, and going on from one edge
to the next one costs the move and the turn between them. So the distance fields of ``fields`` serve here too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import floor, inf, isfinite, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import PlanningError
from rce_fleet.planning.fields import UNREACHABLE, distance_fields
from rce_fleet.planning.graph import MAX_COST, PlanningGraph
from rce_fleet.planning.guidance import DOWN, LEFT, RIGHT, UP

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Ints = NDArray[np.int32]
    Table = NDArray[np.int16] | NDArray[np.int32]

UNITS = 4
"""Units of cost in one step: turns are counted in quarters of a step."""
_FAR = 2**26
"""Cost of a way at most, so that sums in units fit into 32 bits."""
UNKNOWN = 4
"""An unknown heading: the first move needs no turn. Headings are ``DOWN``, ``LEFT``, ``RIGHT``, ``UP``."""
_COUNTER_CLOCKWISE = (RIGHT, UP, LEFT, DOWN)
QUARTERS = np.zeros((UNKNOWN + 1, 4), np.int32)
"""Quarter turns from each heading to each direction."""
for _before in range(4):
    for _after in range(4):
        _apart = abs(_COUNTER_CLOCKWISE.index(_before) - _COUNTER_CLOCKWISE.index(_after))
        QUARTERS[_before, _after] = min(_apart, 4 - _apart)


@dataclass(frozen=True, slots=True)
class Motion:
    """What robots lose by turning and stopping, in steps: the times that a moving robot takes for one cell.

    Attributes:
        quarter_turn: A turn on the spot by 90 degrees.
        stop: Braking to a stop and accelerating again, over driving on.
        headings: Heading of each robot at its start; none: not known.
    """

    quarter_turn: float = 0.0
    stop: float = 0.0
    headings: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name, value in (("quarter_turn", self.quarter_turn), ("stop", self.stop)):
            if not (isfinite(value) and value >= 0):
                raise PlanningError(f"{name} must be a number of steps, 0 or more, not {value}")
        for robot, heading in enumerate(self.headings):
            if not 0 <= heading <= UNKNOWN:
                raise PlanningError(
                    f"the heading of robot {robot} must be within 0 .. {UNKNOWN}, not {heading}"
                )

    @classmethod
    def of_robot(
        cls,
        *,
        cell_size: float,
        speed: float,
        turn_rate: float,
        acceleration: float = inf,
        turn_acceleration: float = inf,
        headings: tuple[int, ...] = (),
    ) -> Motion:
        """Return the motion of a differential drive.

        A robot that brakes from the speed v to a stop and starts again, both with the acceleration a, needs
        v / a longer than one that drives through. A turn begins and ends at rest.

        Args:
            cell_size: Distance of two cells, metres.
            speed: Of driving straight, metres per second.
            turn_rate: Of turning on the spot, radians per second.
            acceleration: Metres per second squared.
            turn_acceleration: Radians per second squared.
            headings: See the class.
        """
        step, quarter = cell_size / speed, pi / 2
        if turn_rate**2 < quarter * turn_acceleration:
            turn = quarter / turn_rate + turn_rate / turn_acceleration
        else:  # It brakes before it has its highest rate.
            turn = 2 * sqrt(quarter / turn_acceleration)
        return cls(turn / step, speed / acceleration / step, headings)

    def heading(self, robot: int) -> int:
        """Return the heading of a robot at its start."""
        return self.headings[robot] if self.headings else UNKNOWN

    @property
    def costs(self) -> Ints:
        """Cost of turning from each heading to each direction, units, shape (5, 4), with a stop each."""
        return np.asarray(np.minimum(np.rint(self.turn_steps * UNITS), MAX_COST // 4), dtype=np.int32)

    @property
    def turn_steps(self) -> NDArray[np.float64]:
        """Steps of turning from each heading to each direction, shape (5, 4), with a stop each."""
        return QUARTERS * self.quarter_turn + (QUARTERS > 0) * self.stop


def heading_of(yaw: float) -> int:
    """Return the heading nearest to a yaw, radians from the direction of growing columns; NaN: unknown."""
    if not isfinite(yaw):
        return UNKNOWN
    return _COUNTER_CLOCKWISE[floor(yaw / (pi / 2) + 0.5) % 4]


def direction_of(offset: int, columns: int) -> int:
    """Return the direction of a move to the cell beside with a number greater by ``offset``."""
    if offset == columns:
        return UP
    if offset == -columns:
        return DOWN
    return RIGHT if offset == 1 else LEFT


def edge_directions(graph: PlanningGraph) -> Ints:
    """Return the direction of each edge of a grid's graph, shape (edges,).

    Raises:
        PlanningError: The graph was not made from a grid, so that it has no directions.
    """
    if not graph.columns:
        raise PlanningError("turns can be planned on grids only; this graph has edges without directions")
    offsets = graph.neighbours - np.repeat(np.arange(len(graph)), np.diff(graph.indptr))
    found = np.select(
        [offsets == graph.columns, offsets == -graph.columns, offsets == 1], [UP, DOWN, RIGHT], LEFT
    )
    return found.astype(np.int32)


def turns_on(
    graph: PlanningGraph, motion: Motion | None, robots: int
) -> tuple[Ints, NDArray[np.float64], Ints]:
    """Return what a search with turns needs; without a motion, turns cost nothing.

    Args:
        graph: Where robots drive.
        motion: What turns cost.
        robots: Number of robots.

    Returns:
        Direction of each edge; steps of turning from each heading to each direction, shape (5, 4); heading of
        each robot.
    """
    if motion is None or not motion.turn_steps.any():
        none = np.zeros(len(graph.neighbours), np.int32)
        return none, np.zeros((UNKNOWN + 1, 4)), np.full(robots, UNKNOWN, np.int32)
    headings = np.array([motion.heading(robot) for robot in range(robots)], np.int32)
    return edge_directions(graph), motion.turn_steps.astype(np.float64), headings


@dataclass(frozen=True, eq=False)
class Turning:
    """What PIBT needs to choose moves by their turns.

    Attributes:
        active: 1 for robots that are guided by it, shape (robots,); the others go by their distances.
        table: Cost of each edge and of the way from its end to each robot's goal, with the turns after it,
            units, shape (robots, edges).
        directions: Direction of each edge, shape (edges,).
        costs: See :attr:`Motion.costs`.
        headings: Heading of each robot at its start, shape (robots,).
    """

    active: Ints
    table: Ints
    directions: Ints
    costs: Ints
    headings: Ints
    arrays: tuple[Ints, Ints, Ints, Ints] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "arrays", (self.active, self.table, self.directions, self.costs))

    @classmethod
    def none(cls, robots: int) -> Turning:
        """Return what stands for no regard to turns."""
        costs = np.zeros((UNKNOWN + 1, 4), np.int32)
        zeros = np.zeros(robots, np.int32)
        return cls(zeros, np.zeros((0, 0), np.int32), np.zeros(0, np.int32), costs, zeros)

    @classmethod
    def without_turns(cls, graph: PlanningGraph, table: Table, own_costs: Mapping[int, Ints]) -> Turning:
        """Return what makes PIBT count the cost of the next edge, which distances of nodes do not have.

        Args:
            graph: Where robots drive.
            table: Distances to the goals, shape (robots, nodes).
            own_costs: Costs of all edges for some robots, by the robot's index.
        """
        aims = np.minimum(table[:, graph.neighbours].astype(np.int32), _FAR) + graph.costs
        for robot, costs in own_costs.items():
            aims[robot] += costs - graph.costs
        robots, edges = aims.shape
        turns, directions = np.zeros((UNKNOWN + 1, 4), np.int32), np.zeros(edges, np.int32)
        aims = np.ascontiguousarray(np.minimum(aims, _FAR) * UNITS)
        return cls(np.ones(robots, np.int32), aims, directions, turns, np.zeros(robots, np.int32))

    @classmethod
    def of(
        cls,
        graph: PlanningGraph,
        directions: Ints,
        goals: Ints,
        motion: Motion,
        forbidden: Mapping[int, frozenset[int]] | None = None,
        own_costs: Mapping[int, Ints] | None = None,
    ) -> Turning:
        """Compute the table.

        Args:
            graph: Where robots drive; its costs count beside the turns.
            directions: Direction of each edge.
            goals: Goal of each robot.
            motion: See there.
            forbidden: Nodes that some robots must not enter, by the robot's index.
            own_costs: Costs of all edges for some robots, by the robot's index.
        """
        barred = {
            robot: frozenset(np.flatnonzero(np.isin(graph.neighbours, list(nodes))).tolist())
            for robot, nodes in (forbidden or {}).items()
        }
        table = _edge_costs(graph, directions, goals, motion, barred)
        alike: dict[int, list[int]] = {}
        for robot, costs in (own_costs or {}).items():
            alike.setdefault(id(costs), []).append(robot)
        for robots in alike.values():
            other = graph.with_costs((own_costs or {})[robots[0]])
            shut = {row: barred[robot] for row, robot in enumerate(robots) if robot in barred}
            table[robots] = _edge_costs(other, directions, goals[robots], motion, shut)
        headings = [motion.heading(robot) for robot in range(len(goals))]
        active = np.ones(len(goals), np.int32)
        return cls(
            active, np.ascontiguousarray(table), directions, motion.costs, np.array(headings, np.int32)
        )


def _edge_costs(
    graph: PlanningGraph, directions: Ints, goals: Ints, motion: Motion, barred: Mapping[int, frozenset[int]]
) -> Ints:
    """Return the cost of each edge and of the way from there to each goal, units, shape (goals, edges)."""
    edges = len(directions)
    found = distance_fields(line_graph(graph, directions, motion.costs), goals + edges, barred)[:, :edges]
    # Of each distance one unit leads from the last edge to the goal's own node.
    own = np.minimum(graph.costs, MAX_COST // UNITS // 2) * UNITS - 1
    return np.where(found >= UNREACHABLE, UNREACHABLE, found + own).astype(np.int32)


def line_graph(graph: PlanningGraph, directions: Ints, turns: Ints) -> PlanningGraph:
    """Return the graph whose nodes are the edges of a graph, and behind them its nodes as ends of paths.

    Args:
        graph: Nodes and edges; costs are steps.
        directions: Direction of each edge.
        turns: See :attr:`Motion.costs`.
    """
    edges, ends = len(directions), graph.neighbours
    counts = np.diff(graph.indptr)[ends]
    indptr = np.concatenate(([0], np.cumsum(counts + 1)))
    rows = np.repeat(np.arange(edges), counts + 1)
    offsets = np.arange(len(rows)) - indptr[rows]
    is_end = offsets == counts[rows]
    after = np.where(is_end, 0, graph.indptr[ends[rows]] + offsets)
    costs = np.minimum(graph.costs, MAX_COST // UNITS // 2)[after] * UNITS
    costs += turns[directions[rows], directions[after]]
    return PlanningGraph(
        np.concatenate((indptr, np.full(len(graph), indptr[-1]))).astype(np.int32),
        np.where(is_end, edges + ends[rows], after).astype(np.int32),
        np.where(is_end, 1, costs).astype(np.int32),
    )
