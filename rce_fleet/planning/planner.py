"""The seam between planners and their users: a problem in, a joint plan out.

Planners are found by the entry point group ``rce.planners``; a package adds one with::

    [project.entry-points."rce.planners"]
    mine = "my_package.my_module:MyPlanner"

The object that it names is called without arguments and returns a :class:`Planner`::

    planner = load_planner("lacam")
    graph = PlanningGraph.from_grid(grid)
    joint = planner.plan(PlanningProblem.of(graph, starts=[0, 9], goals=[9, 0]))
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Protocol, cast, runtime_checkable

import numpy as np

from rce_fleet.exceptions import PlannerError, PlanningError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.graph import PlanningGraph
    from rce_fleet.planning.motion import Motion

    Ints = NDArray[np.int32]

PLANNER_ENTRY_POINTS = "rce.planners"
DEFAULT_PLANNER = "lacam"
INDEPENDENT = "dijkstra"
"""The planner that gives each robot its own shortest path, without regard to the others."""
BUILT_IN_PLANNERS = frozenset({DEFAULT_PLANNER, INDEPENDENT})
DEFAULT_EFFORT = 4_000_000
"""How many moves of single robots are tried before the search for a first plan gives up."""


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """What a planner is asked for.

    Attributes:
        graph: Where robots can be and drive.
        starts: Node of each robot, shape (robots,), all different.
        goals: Goal of each robot, shape (robots,), all different.
        seed: The same problem with the same seed and no ``seconds``, nor ``search_seconds``, gives the same
            plan.
        effort: Moves of single robots that are tried at most until the first plan is found; more
            while ``seconds`` are left.
        seconds: Time for the whole plan; what the first plan leaves is used to improve it.
        rotations: Whether robots may follow one another around in a circle, as in the classic model. Robots
            that enter a cell only when it has been left cannot do that.
        forbidden: For some robots the nodes that only these must not enter, by the robot's index.
        motion: What turns and stops cost the robots, on a grid; the plan is then made for the least time of
            real robots (see ``execution``) instead of the fewest steps.
        urgency: How long each robot has waited, in steps, shape (robots,): where robots are in each other's
            way, the most urgent one drives first. A planner may ignore it.
        lifelong: Whether robots get other goals where they arrive: then what follows a robot's first visit of
            its goal does not count, unless it starts there. A planner may ignore it.
        own_costs: For some robots the cost of every edge, shape (edges,), by the robot's index; the graph's
            costs are those of the others. Robots with the same costs share an array. A planner may ignore it.
        search_seconds: Time in which the search for a first plan is repeated with other seeds and more effort
            if it finds none; no plan is improved in it. A planner may ignore it.
    """

    graph: PlanningGraph
    starts: Ints
    goals: Ints
    seed: int = 0
    effort: int = DEFAULT_EFFORT
    seconds: float = 0.0
    rotations: bool = False
    forbidden: Mapping[int, frozenset[int]] | None = None
    motion: Motion | None = None
    urgency: Ints | None = None
    lifelong: bool = False
    own_costs: Mapping[int, Ints] | None = None
    search_seconds: float = 0.0

    @classmethod
    def of(
        cls,
        graph: PlanningGraph,
        starts: Sequence[int],
        goals: Sequence[int],
        *,
        seed: int = 0,
        effort: int = DEFAULT_EFFORT,
        seconds: float = 0.0,
        rotations: bool = False,
        forbidden: Mapping[int, frozenset[int]] | None = None,
        motion: Motion | None = None,
        urgency: Sequence[int] | None = None,
        lifelong: bool = False,
        own_costs: Mapping[int, Ints] | None = None,
        search_seconds: float = 0.0,
    ) -> PlanningProblem:
        """Return the problem with these starts and goals.

        Raises:
            PlanningError: Two robots have the same start or goal, one of them is not a node, or there is not
                one heading of the motion or one urgency for each robot, or one own cost for each edge.
        """
        if len(starts) != len(goals):
            raise PlanningError(f"{len(starts)} starts and {len(goals)} goals: each robot needs one of each")
        if urgency is not None and len(urgency) != len(starts):
            raise PlanningError(f"{len(urgency)} urgencies for {len(starts)} robots: give one for each robot")
        for robot, costs in (own_costs or {}).items():
            if len(costs) != len(graph.costs):
                raise PlanningError(f"robot {robot} has {len(costs)} own costs for {len(graph.costs)} edges")
        for what, cells in (("start", starts), ("goal", goals)):
            first: dict[int, int] = {}
            for robot, cell in enumerate(cells):
                if not 0 <= cell < len(graph):
                    raise PlanningError(
                        f"the {what} of robot {robot}, {cell}, is not within 0 .. {len(graph) - 1}"
                    )
                if cell in first:
                    raise PlanningError(
                        f"robots {first[cell]} and {robot} have the same {what}, cell {cell}; "
                        f"all {what}s must be different"
                    )
                first[cell] = robot
        if motion is not None and motion.headings and len(motion.headings) != len(starts):
            raise PlanningError(f"{len(motion.headings)} headings for {len(starts)} robots")
        return cls(
            graph,
            np.array(starts, dtype=np.int32),
            np.array(goals, dtype=np.int32),
            seed,
            effort,
            seconds,
            rotations,
            forbidden,
            motion,
            None if urgency is None else np.array(urgency, dtype=np.int32),
            lifelong,
            own_costs,
            search_seconds,
        )

    @cached_property
    def is_unweighted(self) -> bool:
        """Whether every move costs one step, for all robots."""
        return self.graph.is_unweighted and not self.own_costs

    def extra_cost(self, cells: Ints) -> int:
        """Return what the moves of a plan cost beyond their steps, summed over the robots.

        Args:
            cells: The plan, shape (steps + 1, robots); moves are edges of the graph.
        """
        if self.is_unweighted:
            return 0
        graph, nodes = self.graph, len(self.graph)
        sources = np.repeat(np.arange(nodes, dtype=np.int64), np.diff(graph.indptr))
        keys = sources * nodes + graph.neighbours
        order = np.argsort(keys, kind="stable")
        steps, robots = np.nonzero(cells[1:] != cells[:-1])
        moves = cells[steps, robots].astype(np.int64) * nodes + cells[steps + 1, robots]
        edges = order[np.searchsorted(keys, moves, sorter=order)]
        costs = graph.costs[edges]
        for robot, own in (self.own_costs or {}).items():
            costs[robots == robot] = own[edges[robots == robot]]
        return int(costs.sum(dtype=np.int64)) - len(costs)


@dataclass(frozen=True, eq=False)
class JointPlan:
    """The node of every robot at every step; in a step a robot stays or takes one edge.

    Attributes:
        cells: Nodes, shape (steps + 1, robots); row 0 are the starts.
        complete: Whether the last row is the goals; otherwise it is the nearest that was found.
        conflict_free: Whether no two robots are in one node or change places in one step. A planner that
            plans each robot alone cannot promise that: the code that carries out the plan keeps robots apart.
        lower_bound: Sum of the robots' shortest distances in steps; -1 if the planner does not know it.
        impossible: Whether everything was tried: no plan exists. False if the planner does not know.
    """

    cells: Ints
    complete: bool
    conflict_free: bool = True
    lower_bound: int = -1
    impossible: bool = False

    @classmethod
    def of(cls, steps: Sequence[Sequence[int]], *, complete: bool, conflict_free: bool = True) -> JointPlan:
        """Return the plan with these configurations, the starts first."""
        cells = np.array(steps, dtype=np.int32).reshape(len(steps), -1)
        return cls(cells, complete, conflict_free)

    @cached_property
    def steps(self) -> tuple[tuple[int, ...], ...]:
        """The configurations as tuples."""
        return tuple(map(tuple, self.cells.tolist()))

    @cached_property
    def arrivals(self) -> Ints:
        """The step from which on each robot stays where it ends, shape (robots,)."""
        moving = self.cells != self.cells[-1]
        return np.where(moving.any(axis=0), len(self.cells) - np.argmax(moving[::-1], axis=0), 0).astype(
            np.int32
        )

    @property
    def cost(self) -> int:
        """Sum of the steps at which the robots arrive."""
        return int(self.arrivals.sum())

    @property
    def makespan(self) -> int:
        """The step at which the last robot arrives."""
        return int(self.arrivals.max(initial=0))

    def path(self, robot: int) -> list[int]:
        """Return a robot's node at each step, from its start to its last arrival."""
        path: list[int] = self.cells[: self.arrivals[robot] + 1, robot].tolist()
        return path

    def route(self, robot: int) -> list[tuple[int, int]]:
        """``(step, node)`` of every node that a robot enters, the start with step 0 first."""
        path = self.path(robot)
        return [(step, cell) for step, cell in enumerate(path) if step == 0 or cell != path[step - 1]]

    def visits(self) -> tuple[Ints, Ints, Ints]:
        """Return steps, robots and nodes of all entries of nodes, ordered by step and robot."""
        steps, robots = np.nonzero(self.cells[1:] != self.cells[:-1])
        return (
            (steps + 1).astype(np.int32),
            robots.astype(np.int32),
            self.cells[steps + 1, robots],
        )


@runtime_checkable
class Planner(Protocol):
    """Makes joint plans. It may keep results between calls, such as distances on the same graph."""

    def plan(self, problem: PlanningProblem) -> JointPlan:
        """Return a plan; if none is found with the problem's effort, an incomplete one."""


def planner_names() -> list[str]:
    """Return the names of the installed planners."""
    return sorted({point.name for point in entry_points(group=PLANNER_ENTRY_POINTS)})


def load_planner(name: str = DEFAULT_PLANNER) -> Planner:
    """Return a planner by its name.

    Compiled planners compile here, so that the first plan is as quick as the others.

    Raises:
        PlannerError: There is no planner of this name, or it cannot be loaded.
    """
    points = [point for point in entry_points(group=PLANNER_ENTRY_POINTS) if point.name == name]
    if not points:
        raise PlannerError(
            f"there is no planner {name!r}; installed are {', '.join(planner_names()) or 'none'}"
        )
    try:
        made: object = cast("Callable[[], object]", points[0].load())()
    except Exception as error:
        raise PlannerError(f"the planner {name!r} ({points[0].value}) cannot be loaded: {error}") from error
    if not isinstance(made, Planner):
        raise PlannerError(f"the planner {name!r} ({points[0].value}) has no method 'plan'")
    return made
