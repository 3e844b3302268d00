"""The planner ``lacam``: one plan for all robots, complete, and better with more time.

After Okumura, "LaCAM: Search-Based Algorithm for Quick Multi-Agent Pathfinding" (2023): a depth-first
search over configurations, which PIBT proposes. Every configuration has a tree of constraints, read breadth
first, that forces more and more robots to other nodes, so that in the end all successors are tried. Given
effort, it finds a plan whenever one exists; after that it returns the nearest configuration found so far.

Robots follow guidance in aisles as long as this brings them nearer. In the time that is left the plan is
improved by large-neighbourhood search.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rce_fleet.compiled import compile_kernels
from rce_fleet.planning.compaction import Compaction
from rce_fleet.planning.configurations import ConfigurationSearch
from rce_fleet.planning.execution import execute, execution_times
from rce_fleet.planning.fields import FIELD_KERNELS, distance_fields, field_table
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.guidance import guided
from rce_fleet.planning.improvement import Improver, enter_all, improve
from rce_fleet.planning.motion import Turning, edge_directions
from rce_fleet.planning.pibt import roll_out
from rce_fleet.planning.planner import JointPlan, PlanningProblem
from rce_fleet.planning.smoothing import smooth, smoothed
from rce_fleet.planning.straightening import ends_of, straighten

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.motion import Motion

    Ints = NDArray[np.int32]
    Table = NDArray[np.int16] | NDArray[np.int32]

DEFAULT_EFFORT = 40_000
"""How many single-robot moves :func:`plan` tries before it gives up."""
_MAX_IMPROVED = 150_000_000
"""Entries of the table of distances up to which a plan is improved; larger ones take too much memory."""
_MAX_STRAIGHTENED = 20_000_000
"""Steps times nodes up to which loops are cut out of a plan; four bytes each."""
_GUIDED_FROM = 0.005
"""Robots by node from which on the first plan follows guidance in aisles; a few robots have room anyway."""
_RESTARTS = 0.15
"""Share of the time in which first plans are made from other seeds, before the best of them is improved."""
_SMOOTHING = 1000
"""States of searches by robot, with which a plan is made straighter."""
_NEXT_SEED = 7919
"""Added to the seed for another search."""
_MOST_CONFIGURATIONS = 50_000
"""Of a search that is repeated in ``search_seconds``: each takes some kB of the planner's process."""
KERNELS = (*FIELD_KERNELS, roll_out, improve, enter_all, straighten, smooth, execute)


class _Found(NamedTuple):
    """What a search ended with."""

    cells: Ints
    """The configurations, shape (steps + 1, robots)."""
    complete: bool
    """Whether they end with the goals."""
    impossible: bool
    """Whether everything was tried."""


class LacamPlanner:
    """Plans all robots together; see the module.

    Args:
        compiled: Compile the inner loops now if numba is installed.
        on_first: Called with the first complete plan, before it is improved.
    """

    def __init__(self, *, compiled: bool = True, on_first: Callable[[JointPlan], None] | None = None) -> None:
        if compiled:
            compile_kernels(KERNELS)
        self._on_first = on_first

    def plan(self, problem: PlanningProblem) -> JointPlan:
        """Return a plan without conflicts; an incomplete one if none is found with the problem's effort."""
        began = perf_counter()
        if not len(problem.starts):
            return JointPlan.of([[]], complete=True)
        part = Compaction(problem)
        steps = part.graph.unweighted
        guide = part.graph
        if len(part.starts) >= _GUIDED_FROM * len(guide):
            guide = part.compact(guided(problem.graph))
        if problem.motion is not None:
            return self._plan_in_motion(part, problem, problem.motion, guide, began)
        deadline = began + problem.seconds
        cells, complete, impossible = _first(part, problem, guide, began)
        if not problem.rotations:
            _cut_loops(part, problem, cells)
        joint = JointPlan(part.original(cells), complete, impossible=impossible)
        if self._on_first is not None and complete:
            self._on_first(joint)
        if not complete or perf_counter() >= deadline or not can_improve(problem):
            return joint
        seed = problem.seed
        while perf_counter() < began + _RESTARTS * problem.seconds:
            seed += _NEXT_SEED
            cells = _another(part, problem, guide, cells, seed)
        distances = _table(part, steps, {}).astype(np.int32, copy=False)
        improver = Improver(
            steps, distances, cells, part.goals, rotations=problem.rotations, seed=problem.seed
        )
        improver.run(deadline)
        improved = JointPlan(part.original(improver.cells), complete, lower_bound=improver.lower_bound)
        # The search counts steps: with weights a plan that it made shorter may lead over dear edges.
        is_better = problem.is_unweighted or _cost(problem, improved) <= _cost(problem, joint)
        return improved if is_better else replace(joint, lower_bound=improver.lower_bound)

    def _plan_in_motion(
        self,
        part: Compaction,
        problem: PlanningProblem,
        motion: Motion,
        guide: PlanningGraph,
        began: float,
    ) -> JointPlan:
        """Return the plan that real robots carry out soonest, of those with and without regard to turns."""
        directions = part.edges(edge_directions(problem.graph))
        turning = Turning.of(part.graph.unweighted, directions, part.goals, motion, part.forbidden)
        guided_turning = turning
        if guide is not part.graph or part.own_costs:
            own_costs = part.own_costs_on(guide)
            guided_turning = Turning.of(guide, directions, part.goals, motion, part.forbidden, own_costs)
        best, least = JointPlan(part.original(part.starts[None]), complete=False), (0, float("inf"))
        seed, effort = problem.seed, problem.effort
        while True:
            before = perf_counter()
            for choice in (guided_turning, None):
                found = _search(part, problem, guide, seed, choice, effort)
                for cells in _straighter(part, problem, found, turning, motion, seed):
                    joint = JointPlan(part.original(cells), found.complete)
                    took = float(execution_times(joint.cells, problem.graph.columns, motion).sum())
                    took += problem.extra_cost(joint.cells)
                    if (-_at_goals(part, cells), took) < least:
                        if self._on_first is not None and found.complete and not best.complete:
                            self._on_first(joint)
                        best, least = joint, (-_at_goals(part, cells), took)
                if found.impossible:
                    return replace(best, impossible=True)
            now, deadline = perf_counter(), began + _time_for(problem, found=best.complete)
            if now >= deadline:
                return best
            seed += _NEXT_SEED
            if not best.complete:
                effort = _grown(problem, effort, now - before, deadline - now)


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

    Raises:
        PlanningError: Starts or goals are not all different, or not as many.
    """
    graph = PlanningGraph.from_grid(grid)
    return LacamPlanner(compiled=False).plan(
        PlanningProblem.of(graph, starts, goals, seed=seed, effort=effort)
    )


def can_improve(problem: PlanningProblem) -> bool:
    """Return whether a plan is improved in the time that is left, as tables of distances are small enough."""
    return len(problem.starts) * len(np.unique(problem.graph.neighbours)) <= _MAX_IMPROVED


def _cost(problem: PlanningProblem, joint: JointPlan) -> int:
    return joint.cost + problem.extra_cost(joint.cells)


def _table(part: Compaction, graph: PlanningGraph, own_costs: Mapping[int, Ints]) -> Table:
    if part.forbidden or own_costs:
        return distance_fields(graph, part.goals, part.forbidden, part.starts, own_costs)
    return field_table(graph, part.goals)


def _cut_loops(part: Compaction, problem: PlanningProblem, cells: Ints) -> None:
    """Cut loops out of a plan, unless that takes too much time or memory: it is right with them too."""
    nodes = len(part.graph)
    if cells.size * nodes < _MAX_IMPROVED * 16 and len(cells) * nodes <= _MAX_STRAIGHTENED:
        straighten(cells, nodes, ends_of(cells, part.goals, lifelong=problem.lifelong))


def _first(part: Compaction, problem: PlanningProblem, graph: PlanningGraph, began: float) -> _Found:
    """Search with the problem's effort, then with other seeds and more effort while time is left.

    Returns:
        The plan; of plans that are not complete the one with most robots at their goals.
    """
    seed, effort, deadline = problem.seed, problem.effort, began + _time_for(problem, found=False)
    best: _Found | None = None
    while True:
        before = perf_counter()
        found = _search(part, problem, graph, seed, effort=effort)
        now = perf_counter()
        if best is None or found.complete or _at_goals(part, found.cells) > _at_goals(part, best.cells):
            best = found
        if found.complete or found.impossible or now >= deadline:
            return best._replace(impossible=found.impossible)
        seed += _NEXT_SEED
        effort = _grown(problem, effort, now - before, deadline - now)


def _straighter(
    part: Compaction, problem: PlanningProblem, found: _Found, turning: Turning, motion: Motion, seed: int
) -> Iterator[Ints]:
    """Yield a plan, and if it is complete another one in which robots are planned anew, with turns."""
    if not problem.rotations:
        _cut_loops(part, problem, found.cells)
    yield found.cells
    if found.complete:
        yield smoothed(
            part.graph.unweighted, found.cells, part.goals, turning, stop=motion.stop,
            rotations=problem.rotations, effort=min(problem.effort, _SMOOTHING * len(part.starts)), seed=seed,
        )  # fmt: skip


def _time_for(problem: PlanningProblem, *, found: bool) -> float:
    """Return how many seconds a plan may take, if a complete one is found, or is not."""
    return problem.seconds if found else max(problem.seconds, problem.search_seconds)


def _grown(problem: PlanningProblem, effort: int, took: float, left: float) -> int:
    """Return the effort of the next search.

    Args:
        problem: What is asked for.
        effort: The effort of the search that found no complete plan.
        took: What that took, seconds.
        left: Seconds that are left.
    """
    grown = int(effort * min(2.0, left / took)) + len(problem.starts)
    if problem.seconds:
        return grown
    return min(grown, max(problem.effort, _MOST_CONFIGURATIONS * len(problem.starts)))


def _at_goals(part: Compaction, cells: Ints) -> int:
    """Return how many robots are at their goals at the end of a plan."""
    return int((cells[-1] == part.goals).sum())


def _search(
    part: Compaction,
    problem: PlanningProblem,
    graph: PlanningGraph,
    seed: int,
    turning: Turning | None = None,
    effort: int = 0,
) -> _Found:
    own_costs = part.own_costs_on(graph)
    table = _table(part, graph, own_costs)
    if turning is None and not problem.is_unweighted:
        turning = Turning.without_turns(graph, table, own_costs)
    search = ConfigurationSearch(
        graph,
        table,
        part.goals,
        rotations=problem.rotations,
        seed=seed,
        turning=turning,
        keeps_weights=not problem.is_unweighted,
    )
    rounds = (effort or problem.effort) // len(part.starts)
    cells, complete = search.run(part.starts, rounds, problem.urgency)
    return _Found(cells, complete, search.exhausted)


def _another(
    part: Compaction, problem: PlanningProblem, graph: PlanningGraph, cells: Ints, seed: int
) -> Ints:
    """Return a plan from another seed, or ``cells`` if it is not better."""
    other, complete, _ = _search(part, problem, graph, seed)
    return other if complete and JointPlan(other, complete).cost < JointPlan(cells, complete).cost else cells
