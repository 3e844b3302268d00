"""What the planner keeps, and searches in its event loop, on maps of many cells."""

from __future__ import annotations

import tracemalloc
from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import GoalSet, MakePlan, Tick
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients


@pytest.mark.parametrize(("budget", "most"), [(32_000_000, 1_200_000), (100_000, 300_000)])
def test_distances_to_many_goals_take_limited_memory(
    make_fleet: type[SimulatedClients], monkeypatch: pytest.MonkeyPatch, budget: int, most: int
) -> None:
    """Each of 20 robots has another goal; four bytes for a cell and goal are 40 kB."""
    monkeypatch.setattr("rce_fleet.coordination.repair._FIELD_BYTES", budget)
    fleet = make_fleet(FleetPlanner(GridMap(100, 100)), list(range(0, 100, 5)), 1, loss=0.0)
    fleet.send([])
    assert len(fleet.grid.neighbours) == 10_000  # These are kept in any case.
    tracemalloc.start()
    try:
        for robot in range(20):
            assert fleet.ask(GoalSet(f"Robot{robot + 1}", 100 + 5 * robot)).ok
            fleet.tell(Tick())
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert kept < most
    assert all(robot.plan[-1] == robot.plan[0] + 100 for robot in fleet.planner.snapshot().robots)


def test_the_process_finds_single_paths_on_large_maps(
    make_fleet: type[SimulatedClients], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A search of the whole map in the event loop would take longer than a tick."""
    monkeypatch.setattr("rce_fleet.coordination.path_supply._REPAIR_CELLS", 63)
    fleet = make_fleet(FleetPlanner(GridMap()), [0], 1, loss=0.0)
    fleet.send([])
    fleet.ask(GoalSet("Robot1", 63))
    (request,) = [done.request for done in fleet.tell(Tick()) if isinstance(done, MakePlan)]
    assert request.copy is not None
    fleet.run(fleet.all_arrived)
