"""One plan for all active robots, from the cells that they are committed to.

A plan is made in three steps, so that the long one can run in another process: :func:`request_plan` copies
its input from the fleet's state, :func:`compute_plan` uses only this copy, and
:class:`~rce_fleet.coordination.adoption.PlanAdoption` enters the result into the ledger, as far as the robots
are still where the plan begins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.coordination.improving import compute_improvement
from rce_fleet.coordination.own_planner import find_fault
from rce_fleet.coordination.rerouting import (
    MOST_TURNING,
    NO_CELL,
    LedgerCopy,
    Rerouting,
    compute_rerouting,
    copy_ledger,
    heading_at_start,
    motion_of,
    weighted_graph,
)
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.starvation import urgency_of
from rce_fleet.coordination.targets import assign_targets
from rce_fleet.coordination.zones import ZoneKind
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.planner import (
    BUILT_IN_PLANNERS,
    DEFAULT_PLANNER,
    PlanningProblem,
    load_planner,
)
from rce_fleet.planning.straightening import ends_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.settings import FleetSettings
    from rce_fleet.planning.planner import Planner

    Ints = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """The input of a plan.

    Attributes:
        number: Number of the request.
        rows, columns: Size of the map.
        blocked: Cells that no robot may enter, with those of robots that take no part.
        robots: Robots that take part.
        starts: Last granted cell of each robot.
        goals: Goal of each robot, or -1.
        rests: Cell that each robot returns to without a goal, or -1.
        seed: Breaks ties.
        effort: Work spent at most, see :class:`rce_fleet.planning.planner.PlanningProblem`.
        planner: Name of the planner.
        closed: Moves ``(from, to)`` that no robot may make.
        costs: ``(cell, cost of entering it)`` where it is not 1.
        move_costs: ``(from, to, cost of this move)`` where it is not 1: those of lanes.
        own_costs: ``(indexes of robots, costs)`` where single robots have other costs.
        forbidden: ``(index of a robot, cells that it may not enter)``.
        own_closed: ``(indexes of robots, moves that only they may not make)``.
        headings: Heading of each robot at its start, see :mod:`rce_fleet.planning.motion`.
        quarter_turn: Time of a quarter turn, in steps; 0: turns are not counted.
        stop: Time lost by stopping and starting, in steps; 0: not counted.
        urgency: How urgent each robot is, see :mod:`rce_fleet.coordination.starvation`.
        copy: Where only some robots need new paths: the paths of all; None: one plan is made for all.
        improve_seconds: Time in which better paths are looked for among those of the copy, none of which has
            to change; 0: the copy's members need new paths.
        search_seconds: Time in which the search for a plan for all is repeated if it does not bring all
            robots to their targets, see :mod:`rce_fleet.coordination.search_time`.
    """

    number: int
    rows: int
    columns: int
    blocked: tuple[int, ...]
    robots: tuple[str, ...]
    starts: tuple[int, ...]
    goals: tuple[int, ...]
    rests: tuple[int, ...]
    seed: int
    effort: int
    planner: str = DEFAULT_PLANNER
    closed: tuple[tuple[int, int], ...] = ()
    costs: tuple[tuple[int, int], ...] = ()
    move_costs: tuple[tuple[int, int, int], ...] = ()
    own_costs: tuple[tuple[tuple[int, ...], tuple[tuple[int, int], ...]], ...] = ()
    forbidden: tuple[tuple[int, tuple[int, ...]], ...] = ()
    own_closed: tuple[tuple[tuple[int, ...], tuple[tuple[int, int], ...]], ...] = ()
    headings: tuple[int, ...] = ()
    quarter_turn: float = 0.0
    stop: float = 0.0
    urgency: tuple[int, ...] = ()
    copy: LedgerCopy | None = None
    improve_seconds: float = 0.0
    search_seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class PlanResult:
    """A plan: which robot enters which cell, in order.

    Attributes:
        number: Number of the request.
        visitors: Robot of each visit of a cell, as an index of the request's ``robots``.
        cells: Cell of each visit.
        unreachable: Robots, as indexes of ``robots``, whose goal cannot be reached.
        complete: Whether the plan ends with all robots at their targets.
        steps: Step of each visit, from 1 on.
        ordered: Whether robots that keep the plan's order never wait for each other in a circle.
        rerouting: The new paths, where only some robots get new or better ones; then there are no visits.
        failure: Why a plan is missing: the planner's error, or what is wrong with its plan; then there are no
            visits.
        impossible: Whether it is known that no plan brings all robots to their targets.
    """

    number: int
    visitors: tuple[int, ...]
    cells: tuple[int, ...]
    unreachable: tuple[int, ...]
    complete: bool
    steps: tuple[int, ...] = ()
    ordered: bool = True
    rerouting: Rerouting | None = None
    failure: str = ""
    impossible: bool = False


def request_plan(
    state: FleetState,
    settings: FleetSettings,
    number: int,
    now: float,
    members: Sequence[str] = (),
    *,
    improve: bool = False,
    planner: str = DEFAULT_PLANNER,
    search_seconds: float = 0.0,
) -> PlanRequest:
    """Return the input of a plan from the fleet's state.

    Cells claimed by robots that are not active are obstacles. Cells granted already are driven through in any
    case, so the plan begins where they end.

    Args:
        state: The fleet; ``rest`` of robots without a target is set.
        settings: Seed and effort.
        number: Number of the plan; changes how ties are broken.
        now: Time, seconds.
        members: Robots that need new paths, the first ones first; none: one plan is made for all.
        improve: Look for better paths instead; no robot needs a new one.
        planner: Name of the planner that makes a plan for all.
        search_seconds: Time in which the search for such a plan is repeated.
    """
    for_all = not members and not improve
    # Better paths are compared by what they took when they were planned.
    moves = state.zones.move_costs if improve else state.move_costs()
    robots, starts, goals, rests = [], [], [], []
    blocked = set(state.shut)
    for record in state.robots.values():
        start = state.ledger.end_of_grant(record.id)
        if record.phase is not Phase.ACTIVE or start is None:
            blocked |= state.ledger.claims(record.id)
            continue
        if record.rest is None and record.goal is None:
            record.rest = start
        robots.append(record.id)
        starts.append(start)
        goals.append(NO_CELL if record.goal is None else record.goal)
        rests.append(NO_CELL if record.rest is None else record.rest)
    return PlanRequest(
        number=number,
        rows=state.grid.rows,
        columns=state.grid.columns,
        blocked=tuple(blocked),
        robots=tuple(robots),
        starts=tuple(starts),
        goals=tuple(goals),
        rests=tuple(rests),
        seed=settings.seed + number,
        effort=settings.effort,
        planner=planner,
        closed=tuple(sorted(state.zones.closed(state.grid))),
        costs=tuple(sorted(state.zones.costs().items())),
        move_costs=tuple((start, end, cost) for (start, end), cost in moves.items()),
        own_costs=_own_costs(state, robots),
        forbidden=tuple(_forbidden(state, robots)),
        own_closed=_own_closed(state, robots),
        headings=(
            tuple(heading_at_start(state, robot) for robot in robots)
            if settings.quarter_turn or settings.stop
            else ()
        ),
        quarter_turn=settings.quarter_turn,
        stop=settings.stop,
        urgency=(
            ()
            if members
            else tuple(urgency_of(state, state.robots[robot], settings, now) for robot in robots)
        ),
        copy=None if for_all else copy_ledger(state, robots, members),
        improve_seconds=settings.improve_seconds if improve else 0.0,
        search_seconds=search_seconds,
    )


def _own_costs(
    state: FleetState, robots: list[str]
) -> tuple[tuple[tuple[int, ...], tuple[tuple[int, int], ...]], ...]:
    """Return the costs of robots that have zones of their own, those with the same zones together."""
    common = state.zones.costs()
    alike: dict[int, tuple[list[int], Mapping[int, int]]] = {}
    for index, robot in enumerate(robots):
        costs = state.zones.costs_of(robot)
        if costs is not common:
            alike.setdefault(id(costs), ([], costs))[0].append(index)
    return tuple((tuple(indexes), tuple(sorted(costs.items()))) for indexes, costs in alike.values())


def _own_closed(
    state: FleetState, robots: list[str]
) -> tuple[tuple[tuple[int, ...], tuple[tuple[int, int], ...]], ...]:
    """Return the moves that only some robots may not make, robots with the same zones together."""
    alike: dict[frozenset[tuple[int, int]], list[int]] = {}
    for index, robot in enumerate(robots):
        closed = state.zones.closed_for(robot, state.grid)
        if closed:
            alike.setdefault(closed, []).append(index)
    return tuple((tuple(indexes), tuple(sorted(closed))) for closed, indexes in alike.items())


def _forbidden(state: FleetState, robots: list[str]) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the cells that single robots may not enter.

    Robots that claim cells of a limited zone are in it; then those with a goal in it are let in, as long as
    there is room, in the order of their names.
    """
    if not state.zones.zones:
        return
    full: dict[str, set[int]] = {}
    for zone in state.zones.of_kind(ZoneKind.LIMITED):
        cells = set(zone.cells)
        inside = {owner for cell in cells if (owner := state.ledger.owner(cell)) is not None}
        room = zone.capacity - sum(1 for robot in inside if zone.applies_to(robot))
        for robot in sorted(robots, key=lambda robot: (state.robots[robot].goal not in cells, robot)):
            if robot in inside or not zone.applies_to(robot):
                continue
            room -= 1
            if room < 0:
                full.setdefault(robot, set()).update(cells)
    for index, robot in enumerate(robots):
        barred = state.zones.forbidden(robot) | full.get(robot, set())
        if barred:
            yield index, tuple(sorted(barred))


def compute_plan(request: PlanRequest, planner: Planner | None = None) -> PlanResult:
    """Return the plan. The same request to a new planner gives the same plan, unless its time is over first.

    Args:
        request: What to plan.
        planner: Makes the plan; by default a new one of the request's name.

    Raises:
        PlannerError: There is no planner of this name.
    """
    if request.copy is not None:
        rerouting = compute_improvement(request) if request.improve_seconds else compute_rerouting(request)
        return PlanResult(request.number, (), (), (), complete=True, rerouting=rerouting)
    if not request.robots:
        return PlanResult(request.number, (), (), (), complete=True)
    grid = GridMap(request.rows, request.columns, blocked=frozenset(request.blocked))
    forbidden = {index: frozenset(cells) for index, cells in request.forbidden}
    starts = dict(zip(request.robots, request.starts, strict=True))
    targets = assign_targets(
        grid,
        starts,
        goals={robot: cell for robot, cell in zip(request.robots, request.goals, strict=True) if cell >= 0},
        rests={robot: cell for robot, cell in zip(request.robots, request.rests, strict=True) if cell >= 0},
        closed=frozenset(request.closed),
        forbidden={request.robots[index]: cells for index, cells in forbidden.items()},
        own_closed={
            request.robots[index]: frozenset(moves)
            for indexes, moves in request.own_closed
            for index in indexes
        },
    )
    graph, own_costs = weighted_graph(request, grid)
    problem = PlanningProblem.of(
        graph,
        request.starts,
        [targets.cells[robot] for robot in request.robots],
        seed=request.seed,
        effort=request.effort,
        forbidden=forbidden or None,
        motion=motion_of(request) if len(request.robots) <= MOST_TURNING else None,
        urgency=request.urgency or None,
        lifelong=True,
        own_costs=own_costs,
        search_seconds=request.search_seconds,
    )
    joint = (planner or load_planner(request.planner)).plan(problem)
    if request.planner not in BUILT_IN_PLANNERS:
        fault = find_fault(joint, problem, grid, request.robots)
        if fault:
            return PlanResult(request.number, (), (), (), complete=False, failure=fault)
    steps, visitors, cells = joint.visits()
    # Robots that have arrived soon have another goal: the others wait for that, and not they for the others.
    ends = ends_of(joint.cells, np.array(request.goals, np.int32), lifelong=True)
    counts = steps <= ends[visitors]
    steps, visitors, cells = steps[counts], visitors[counts], cells[counts]
    kept = _allowed(request, visitors, cells)
    is_cut = not kept.all()
    if is_cut:
        steps, visitors, cells = steps[kept], visitors[kept], cells[kept]
    return PlanResult(
        number=request.number,
        visitors=tuple(visitors.tolist()),
        cells=tuple(cells.tolist()),
        steps=tuple(steps.tolist()),
        unreachable=tuple(
            index for index, robot in enumerate(request.robots) if robot in targets.unreachable
        ),
        complete=joint.complete and not is_cut,
        ordered=joint.conflict_free,
        impossible=joint.impossible,
    )


def _allowed(request: PlanRequest, visitors: Ints, cells: Ints) -> NDArray[np.bool_]:
    """Return which visits are kept: a route ends before the first move that its robot may not make.

    A planner may not know one-way moves. Moves that are closed for single robots cost these so much that they
    find other ways; but in a plan others may push them there.

    Args:
        request: The plan's request.
        visitors: Robot of each visit, in order, shape (visits,).
        cells: Cell of each visit, shape (visits,).
    """
    kept = np.ones(len(cells), dtype=bool)
    if not request.closed and not request.own_closed:
        return kept
    size = request.rows * request.columns
    order = np.argsort(visitors, kind="stable")
    robots, ends = visitors[order], cells[order].astype(np.int64)
    is_first = np.append(True, robots[1:] != robots[:-1])[: len(robots)]
    begins = np.where(is_first, np.array(request.starts, np.int64)[robots], np.roll(ends, 1))
    moves = begins * size + ends
    wrong = np.isin(moves, [start * size + end for start, end in request.closed])
    for members, closed in request.own_closed:
        own = np.isin(moves, [start * size + end for start, end in closed])
        wrong |= own & np.isin(robots, members)
    ended = np.cumsum(wrong)
    before = np.where(is_first, ended - wrong, 0)
    kept[order] = ended == np.maximum.accumulate(before)
    return kept
