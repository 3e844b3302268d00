"""One plan for all active robots, from the cells that they are committed to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.targets import assign_targets
from rce_fleet.planning.lacam import JointPlan, plan

if TYPE_CHECKING:
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.settings import FleetSettings


def plan_together(books: FleetState, settings: FleetSettings, attempt: int) -> JointPlan:
    """Plan for all active robots and enter the routes into the ledger.

    Cells claimed by robots that are not active are obstacles. Cells granted already are driven through in any
    case, so the plan begins where they end.

    Args:
        books: The fleet; its ledger and the robots' ``rest`` and ``unreachable`` are changed.
        settings: Seed and effort.
        attempt: Number of the plan; breaks ties in another way each time.
    """
    active = books.in_phase(Phase.ACTIVE)
    standing = [record for record in books.robots.values() if record.phase is not Phase.ACTIVE]
    grid = books.grid.with_blocked(
        books.shut.union(*(books.ledger.claims(record.id) for record in standing)),
    )
    starts = {record.id: books.ledger.granted(record.id)[-1] for record in active}
    for record in active:
        if record.rest is None and record.goal is None:
            record.rest = starts[record.id]
    targets = assign_targets(
        grid,
        starts,
        goals={record.id: record.goal for record in active if record.goal is not None},
        rests={record.id: record.rest for record in active if record.rest is not None},
    )
    joint = plan(
        grid,
        list(starts.values()),
        [targets.cells[robot] for robot in starts],
        seed=settings.seed + attempt,
        effort=settings.effort,
    )
    books.ledger.adopt({robot: joint.route(index) for index, robot in enumerate(starts)})
    for record in active:
        record.unreachable = record.id in targets.unreachable
    return joint
