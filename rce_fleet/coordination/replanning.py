"""One plan for all active robots, from the cells that they are committed to.

A plan is made in three steps, so that the long one can run in another process: :func:`request_plan` copies
its input from the fleet's state, :func:`compute_plan` uses only this copy, and :class:`PlanAdoption` enters
the result into the ledger, as far as the robots are still where the plan begins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.targets import assign_targets
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lacam import plan

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.settings import FleetSettings

NO_CELL = -1
"""In a request: the robot has no such cell."""


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
        effort: Work spent at most, see :func:`rce_fleet.planning.lacam.plan`.
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


@dataclass(frozen=True, slots=True)
class PlanResult:
    """A plan: which robot enters which cell, in order.

    Attributes:
        number: Number of the request.
        visitors: Robot of each visit of a cell, as an index of the request's ``robots``.
        cells: Cell of each visit.
        unreachable: Robots, as indexes of ``robots``, whose goal cannot be reached.
        complete: Whether the plan ends with all robots at their targets.
    """

    number: int
    visitors: tuple[int, ...]
    cells: tuple[int, ...]
    unreachable: tuple[int, ...]
    complete: bool


def request_plan(state: FleetState, settings: FleetSettings, number: int) -> PlanRequest:
    """Return the input of a plan from the fleet's state.

    Cells claimed by robots that are not active are obstacles. Cells granted already are driven through in any
    case, so the plan begins where they end.

    Args:
        state: The fleet; ``rest`` of robots without a target is set.
        settings: Seed and effort.
        number: Number of the plan; changes how ties are broken.
    """
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
    )


def compute_plan(request: PlanRequest) -> PlanResult:
    """Return the plan. The same request always gives the same plan."""
    grid = GridMap(request.rows, request.columns, blocked=frozenset(request.blocked))
    starts = dict(zip(request.robots, request.starts, strict=True))
    targets = assign_targets(
        grid,
        starts,
        goals={robot: cell for robot, cell in zip(request.robots, request.goals, strict=True) if cell >= 0},
        rests={robot: cell for robot, cell in zip(request.robots, request.rests, strict=True) if cell >= 0},
    )
    joint = plan(
        grid,
        request.starts,
        [targets.cells[robot] for robot in request.robots],
        seed=request.seed,
        effort=request.effort,
    )
    visits = sorted(
        (step, request.robots[index], index, cell)
        for index in range(len(request.robots))
        for step, cell in joint.route(index)[1:]
    )
    return PlanResult(
        number=request.number,
        visitors=tuple(index for _, _, index, _ in visits),
        cells=tuple(cell for *_, cell in visits),
        unreachable=tuple(
            index for index, robot in enumerate(request.robots) if robot in targets.unreachable
        ),
        complete=joint.complete,
    )


class PlanAdoption:
    """Enters a plan's routes into the ledger, a part at a time.

    The state may have changed since the request, and may change between two parts. A robot that is not active
    any more, was granted other cells or has another goal gets no route, or no more of it, and a route ends
    before a cell that no robot may enter any more. That is safe, because robots drive only on granted cells,
    and the ledger checks each grant; but robots may not reach their goals, so another plan has to follow.

    Args:
        state: The fleet; its ledger and the robots' ``unreachable`` are changed.
        request: The plan's request.
        result: The plan.
    """

    def __init__(self, state: FleetState, request: PlanRequest, result: PlanResult) -> None:
        self._state = state
        self._request = request
        self._result = result
        self._next = 0
        self._present: list[str | None] = []
        unreachable = frozenset(result.unreachable)
        starts = {}
        for index, robot in enumerate(request.robots):
            is_present = self._wants(index) and state.ledger.end_of_grant(robot) == request.starts[index]
            self._present.append(robot if is_present else None)
            if not is_present:
                continue
            starts[robot] = request.starts[index]
            record = state.robots[robot]
            if record.unreachable != (index in unreachable):
                record.unreachable = index in unreachable
                state.touch(record)
        state.ledger.begin_plan(starts)
        self._versions = [state.ledger.version(robot) for robot in request.robots]

    def step(self, visits: int) -> bool:
        """Enter the next ``visits`` visits; return whether these were the last ones."""
        begin, end = self._next, self._next + visits
        self._next = end
        for index, robot in enumerate(self._present):
            if robot is not None and not self._is_on_plan(index):
                self._present[index] = None
        self._state.ledger.extend_plan(self._visits(begin, end))
        return end >= len(self._result.cells)

    def _wants(self, index: int) -> bool:
        """Return whether a robot still takes part, with the goal that was planned for."""
        record = self._state.robots.get(self._request.robots[index])
        if record is None or record.phase is not Phase.ACTIVE:
            return False
        return (NO_CELL if record.goal is None else record.goal) == self._request.goals[index]

    def _is_on_plan(self, index: int) -> bool:
        robot = self._request.robots[index]
        return self._wants(index) and self._state.ledger.version(robot) == self._versions[index]

    def _visits(self, begin: int, end: int) -> Iterator[tuple[str, int]]:
        """Yield visits in order, as far as they are still possible."""
        shut, present, result = self._state.shut, self._present, self._result
        for index, cell in zip(result.visitors[begin:end], result.cells[begin:end], strict=True):
            robot = present[index]
            if robot is not None and cell in shut:
                present[index] = robot = None  # Its route ends here.
            if robot is not None:
                yield robot, cell
