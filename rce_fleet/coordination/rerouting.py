"""New paths for the robots that need some, made by the planner's process; the others keep theirs.

Like a plan for all (see :mod:`rce_fleet.coordination.replanning`) it is made in three steps:
:func:`copy_ledger` copies all visits of the ledger to flat arrays, :func:`compute_rerouting` finds paths
between them (see :mod:`rce_fleet.planning.rerouting`), and :func:`adopt_rerouting` enters these into the
ledger. All visits stay in one order of steps, so no robots wait for each other in a circle.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.coordination.full_zones import note_unreachable
from rce_fleet.coordination.ledger_view import CELLS, STEPS
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.zone_rules import ZoneRules
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import move_costs
from rce_fleet.planning.motion import Motion, direction_of, heading_of
from rce_fleet.planning.rerouting import RoutedRobots, reroute

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.replanning import PlanRequest

NO_CELL = -1
"""In a request: the robot has no such cell."""
CLOSED = 10_000
"""Cost of a move that a robot may not make: more than any way around."""
MOST_TURNING = 100
"""Robots up to which new paths and plans for all count turns: for 1000 it would take seconds."""
_MOVE = 2
"""Cells of a move."""
_MOST_EFFORT = 150_000
"""Work after which a plan for all is made instead: it takes no longer."""


@dataclass(frozen=True, slots=True)
class LedgerCopy:
    """What :class:`~rce_fleet.coordination.replanning.PlanRequest` adds for new paths of some robots.

    Arrays are the bytes of 32-bit integers and of 64-bit floating-point numbers.

    Attributes:
        members: Robots that need new paths, the first ones first, as indexes of the request's ``robots``.
        begins: Step of each robot's last granted cell.
        lengths: Number of cells of each robot's path after it.
        cells: These cells, one robot's after another's.
        steps: Their steps.
        granted: Granted cells before the last one of each robot.
        leaves: Steps at which these are left.
        clock: The ledger's clock.
    """

    members: tuple[int, ...]
    begins: bytes
    lengths: bytes
    cells: bytes
    steps: bytes
    granted: bytes
    leaves: bytes
    clock: float


@dataclass(frozen=True, slots=True)
class Rerouting:
    """New paths of some robots.

    Attributes:
        found: Whether all of them have one; if not, one plan has to be made for all.
        robots: The robots, as indexes of the request's ``robots``.
        paths: Cells and steps of each.
        unreachable: Those of them whose goal cannot be reached.
    """

    found: bool
    robots: tuple[int, ...] = ()
    paths: tuple[tuple[tuple[int, float], ...], ...] = ()
    unreachable: frozenset[int] = frozenset()


def copy_ledger(state: FleetState, robots: Sequence[str], members: Sequence[str]) -> LedgerCopy:
    """Return a copy of the visits of the active robots.

    Args:
        state: The fleet.
        robots: The active robots.
        members: Those of them that need new paths, in order.
    """
    places = {robot: index for index, robot in enumerate(robots)}
    begins, lengths = list[float](), list[int]()
    cells, steps = array(CELLS), array(STEPS)
    granted, leaves = array(CELLS), array(STEPS)
    for robot in robots:
        account = state.ledger.account(robot)
        end = account.granted
        begins.append(account.steps[end - 1])
        lengths.append(len(account.route) - end)
        cells.extend(account.route[end:])  # Bytes are copied: the planner stands meanwhile.
        steps.extend(account.steps[end:])
        granted.extend(account.route[: end - 1])
        leaves.extend(account.steps[1:end])
    return LedgerCopy(
        members=tuple(places[robot] for robot in members),
        begins=array(STEPS, begins).tobytes(),
        lengths=array(CELLS, lengths).tobytes(),
        cells=cells.tobytes(),
        steps=steps.tobytes(),
        granted=granted.tobytes(),
        leaves=leaves.tobytes(),
        clock=state.ledger.clock,
    )


def compute_rerouting(request: PlanRequest) -> Rerouting:
    """Return new paths for the members of the request's copy; the same request gives the same paths.

    Large fleets' turns are not counted: with them searches are so much longer that in dense traffic they find
    nothing in the time that everyone waits for. Searches for better paths follow, which count them.
    """
    copy = request.copy
    assert copy is not None
    grid = GridMap(request.rows, request.columns, blocked=frozenset(request.blocked))
    graph, own_costs = weighted_graph(request, grid)
    found = reroute(
        graph,
        copied_robots(request, copy),
        copy.members,
        effort=min(request.effort, _MOST_EFFORT),
        seed=request.seed,
        motion=motion_of(request) if len(request.robots) <= MOST_TURNING else None,
        forbidden={index: frozenset(cells) for index, cells in request.forbidden} or None,
        own_costs=own_costs,
    )
    if found is None:
        return Rerouting(found=False)
    return Rerouting(
        True,
        tuple(found.paths),
        paths_as_tuples(found.paths),
        found.unreachable,
    )


def copied_robots(request: PlanRequest, copy: LedgerCopy) -> RoutedRobots:
    """Return the robots of a request with the paths that its copy of the ledger holds."""
    return RoutedRobots(
        starts=np.array(request.starts, np.int32),
        begins=_floats(copy.begins),
        goals=np.array(request.goals, np.int32),
        rests=np.array(request.rests, np.int32),
        lengths=_ints(copy.lengths),
        nodes=_ints(copy.cells),
        steps=_floats(copy.steps),
        fixed=(_ints(copy.granted), _floats(copy.leaves)),
        clock=copy.clock,
    )


def paths_as_tuples(
    paths: Mapping[int, tuple[NDArray[np.int32], NDArray[np.float64]]],
) -> tuple[tuple[tuple[int, float], ...], ...]:
    """Return cells and steps of each path, in the order of the robots."""
    return tuple(tuple(zip(cells.tolist(), at.tolist(), strict=True)) for cells, at in paths.values())


def heading_at_start(state: FleetState, robot: str) -> int:
    """Return the heading that a robot has at the end of its granted cells, where its new path begins."""
    account, columns = state.ledger.account(robot), state.grid.columns
    if account.granted < _MOVE:
        return heading_of(state.robots[robot].yaw - state.grid.yaw)
    before, last = account.route[account.granted - _MOVE : account.granted]
    return direction_of(last - before, columns)


def motion_of(request: PlanRequest) -> Motion | None:
    """Return what turns and stops cost the robots of a request; None: nothing."""
    if not request.quarter_turn and not request.stop:
        return None
    return Motion(request.quarter_turn, request.stop, request.headings)


def weighted_graph(
    request: PlanRequest, grid: GridMap
) -> tuple[PlanningGraph, dict[int, NDArray[np.int32]] | None]:
    """Return the graph of a request, and the costs of its edges for robots that have their own, by index."""
    moves = {(start, end): cost for start, end, cost in request.move_costs}
    costs = _costs(request.costs, moves, grid)
    graph = PlanningGraph.from_grid(grid, costs=costs, closed=request.closed)
    own: dict[int, NDArray[np.int32]] = {}
    for robots, pairs in request.own_costs:
        costs = _costs(pairs, moves, grid)
        own |= dict.fromkeys(robots, PlanningGraph.from_grid(grid, costs=costs, closed=request.closed).costs)
    for robots, closed in request.own_closed:
        sources = np.repeat(np.arange(len(graph)), np.diff(graph.indptr))
        shut = np.isin(sources * len(graph) + graph.neighbours, [a * len(graph) + b for a, b in closed])
        dear: dict[int, NDArray[np.int32]] = {}
        for robot in robots:
            before = own.get(robot, graph.costs)
            if id(before) not in dear:
                dear[id(before)] = np.where(shut, CLOSED, before).astype(np.int32)
            own[robot] = dear[id(before)]
    return graph, own or None


def _costs(
    pairs: Sequence[tuple[int, int]], moves: Mapping[tuple[int, int], int], grid: GridMap
) -> NDArray[np.int32]:
    """Return the costs of entering cells, or, with lanes, of moves."""
    costs = np.ones(len(grid), dtype=np.int32)
    for cell, cost in pairs:
        costs[cell] = cost
    return move_costs(costs, moves, grid) if moves else costs


def _ints(stored: bytes) -> NDArray[np.int32]:
    return np.frombuffer(stored, np.int32).copy()  # Compiled loops do not take arrays of constant bytes.


def _floats(stored: bytes) -> NDArray[np.float64]:
    return np.frombuffer(stored, np.float64).copy()


def adopt_rerouting(
    state: FleetState, request: PlanRequest, rerouting: Rerouting, versions: Mapping[str, int]
) -> set[str]:
    """Enter new paths into the ledger.

    Robots that are not where their path begins any more, or that have another goal, get none, and a path
    ends before a cell that the robot may not enter any more.

    Args:
        state: The fleet; its ledger and the robots' ``unreachable``, ``full_zone`` and ``rest`` are changed.
        request: The request; no cells were granted since then.
        rerouting: The paths.
        versions: The ledger's versions of the robots at the time of the request.

    Returns:
        Robots that still need new paths.
    """
    left: set[str] = set()
    present = []
    for index, path in zip(rerouting.robots, rerouting.paths, strict=True):
        robot = request.robots[index]
        record = state.robots.get(robot)
        if record is None or record.phase is not Phase.ACTIVE:
            continue  # It has no path, and is looked at when it is active again.
        goal = NO_CELL if record.goal is None else record.goal
        if state.ledger.version(robot) == versions[robot] and goal == request.goals[index]:
            present.append((index, record, path))
        else:
            left.add(robot)
        # All of them first: where one has its old path, another may have its new one.
        state.ledger.truncate(robot)
    rules, shut, forbidden = ZoneRules(state), state.shut, dict(request.forbidden)
    for index, record, path in present:
        possible = list(_possible(record.id, request.starts[index], path, shut, rules))
        if len(possible) < len(path):
            left.add(record.id)
        state.ledger.insert(record.id, possible)
        is_unreachable = index in rerouting.unreachable
        has_goal = record.goal is not None and not is_unreachable
        record.rest = None if has_goal else state.ledger.route(record.id)[-1]
        barred = forbidden.get(index, ())
        note_unreachable(state, record, is_unreachable=is_unreachable, barred=barred)
    return left


def _possible(
    robot: str, start: int, path: Sequence[tuple[int, float]], shut: frozenset[int], rules: ZoneRules
) -> Iterator[tuple[int, float]]:
    """Yield the visits of a path up to the first one that is not allowed any more."""
    before = start
    for visit in path:
        cell, _ = visit
        if cell in shut or not rules.admit(robot, before, cell):
            return
        yield visit
        before = cell
