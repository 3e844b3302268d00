"""Who blocked a cell, why, since when and until when: by people one by one, and by robots' sensors."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from types import SimpleNamespace
from typing import Any

import pytest

from rce_fleet.coordination.cell_blocks import CellBlock
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellFreed,
    ObstacleGone,
    ObstacleSeen,
    PoseSeen,
    Tick,
    ZonesSet,
)
from rce_fleet.coordination.grid_change import next_planner
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.zones import Zone, ZoneKind
from rce_fleet.nodes.block_messages import block_fields, read_cell_request
from rce_fleet.planning.grid import GridMap

SPILL = CellBlocked(5, by="ann", reason="spill", expires=60.0)


def make(settings: FleetSettings | None = None) -> FleetPlanner:
    """Return a planner with two robots that can see all cells."""
    made = FleetPlanner(GridMap(4, 4), settings)
    made.handle(PoseSeen("Robot1", 0.5, 0.5, 0.0), 0.0)
    made.handle(PoseSeen("Robot2", 3.5, 3.5, 0.0), 0.0)
    made.take_changes()
    return made


def told(planner: FleetPlanner) -> tuple[tuple[tuple[int, CellBlock], ...], tuple[int, ...]]:
    """Return what changed of the blocks since the last call, and check the records."""
    planner.validate()
    changes = planner.take_changes()
    return ((), ()) if changes is None else (changes.blocks, changes.removed_blocks)


def test_a_request_tells_who_why_and_until_when() -> None:
    planner = make()
    planner.handle(SPILL, 1.0)
    block = CellBlock("ann", 1.0, "spill", 60.0)
    assert told(planner) == (((5, block),), ())
    assert planner.snapshot().blocks == ((5, block),)
    assert told(planner) == ((), ()), "it is told once"
    planner.handle(CellFreed(5), 2.0)
    assert told(planner) == ((), (5,))
    assert planner.snapshot().blocks == ()


def test_a_requested_cell_is_free_when_its_time_has_come() -> None:
    planner = make()
    planner.handle(SPILL, 1.0)
    planner.handle(CellBlocked(6), 1.0)
    told(planner)
    planner.handle(Tick(), 59.9)
    assert planner.state.blocked == {5, 6}
    assert BlockedChanged((6,)) in planner.handle(Tick(), 60.0)
    assert told(planner) == ((), (5,))
    planner.handle(replace(SPILL, expires=80.0), 70.0)
    planner.handle(Tick(), 80.0)
    assert planner.state.blocked == {6}


def test_the_newest_request_counts_with_its_end() -> None:
    """For the same user and reason the cell has been blocked since the first one."""
    planner = make()
    planner.handle(SPILL, 1.0)
    planner.handle(replace(SPILL, expires=90.0), 2.0)
    assert told(planner)[0] == ((5, CellBlock("ann", 1.0, "spill", 90.0)),)
    planner.handle(Tick(), 60.0)
    planner.handle(CellBlocked(5, by="bob"), 61.0)
    assert told(planner)[0] == ((5, CellBlock("bob", 61.0)),)
    planner.handle(Tick(), 90.0)
    assert planner.state.blocked == {5}


def test_a_zone_keeps_a_cell_blocked_that_a_person_blocked() -> None:
    """It leaves the list of requested cells, which is published with the blocked ones."""
    planner = make()
    planner.handle(SPILL, 1.0)
    planner.handle(ZonesSet((Zone("gate", ZoneKind.BLOCKED, (5,)),)), 1.0)
    told(planner)
    assert BlockedChanged((5,)) in planner.handle(Tick(), 60.0)
    assert (planner.state.blocked, planner.state.requested) == ({5}, {})
    assert told(planner) == ((), (5,))


def test_a_sensed_cell_tells_which_robot_saw_it_first() -> None:
    """It is not told again each time a robot sees it; a person may take it over."""
    planner = make()
    planner.handle(ObstacleSeen("Robot1", (5,)), 1.0)
    assert told(planner)[0] == ((5, CellBlock("Robot1", 1.0, sensed=True)),)
    planner.handle(ObstacleSeen("Robot2", (5,)), 2.0)
    assert told(planner) == ((), ())
    planner.handle(CellBlocked(5, by="ann"), 3.0)
    assert told(planner)[0] == ((5, CellBlock("ann", 3.0)),)
    planner.handle(ObstacleGone("Robot1", (5,)), 4.0)
    assert planner.state.blocked == {5}


@pytest.mark.parametrize(("lifetime", "left"), [(0.0, {5, 6}), (100.0, {5})])
def test_a_sensed_cell_is_free_some_time_after_it_was_seen(lifetime: float, left: set[int]) -> None:
    """If the parameter says so: each robot that sees it puts that off."""
    planner = make(FleetSettings(sensed_lifetime=lifetime))
    planner.handle(ObstacleSeen("Robot1", (5, 6)), 1.0)
    planner.handle(Tick(), 2.0)
    planner.handle(ObstacleSeen("Robot2", (5,)), 50.0)
    planner.handle(Tick(), 100.9)
    assert planner.state.blocked == {5, 6}
    planner.handle(Tick(), 101.0)
    assert planner.state.blocked == left
    told(planner)
    planner.handle(Tick(), 150.0)
    assert planner.state.blocked == (left if not lifetime else set())
    told(planner)


def test_another_grid_keeps_who_blocked_cells_and_their_ends() -> None:
    """Where a new cell overlaps several old ones, it is blocked until the last of them is free."""
    planner = make()
    planner.handle(SPILL, 1.0)
    planner.handle(replace(SPILL, cell=6, reason="oil", expires=90.0), 1.0)
    planner.handle(ObstacleSeen("Robot1", (10,)), 1.0)
    moved, _ = next_planner(planner, GridMap(4, 4, origin=(0.25, 0.0)), 2.0)
    spill, oil = (moved.state.requested[cell] for cell in (4, 5))
    assert (spill.reason, oil.reason, oil.by, oil.since, oil.expires) == ("spill", "oil", "ann", 1.0, 90.0)
    assert {block.by for block in moved.state.sensed.values()} == {"Robot1"}
    moved.handle(Tick(), 60.0)
    assert set(moved.state.requested) == {5, 6}
    moved.validate()


def request(**fields: Any) -> Any:
    """Return a ``fleet/BlockCell`` request as a node reads it: fields that were not sent have defaults."""
    default = {"cell": 5, "blocked": True, "reason": "", "by": "", "age": 0.0, "lifetime": 0.0}
    return SimpleNamespace(**{**default, **fields})


def test_times_in_messages_are_from_now_on() -> None:
    asked = read_cell_request(request(by="ann", reason="spill", age=20.0, lifetime=40.0), 100.0)
    assert asked == CellBlocked(5, "ann", "spill", since=80.0, expires=140.0)
    assert read_cell_request(request(), 100.0) == CellBlocked(5, since=100.0)
    assert read_cell_request(request(blocked=False), 100.0) == CellFreed(5)
    fields = block_fields(5, CellBlock("ann", 80.0, "spill", 140.0), 110.0)
    assert fields == {
        "cell": 5,
        "sensed": False,
        "by": "ann",
        "reason": "spill",
        "age": 30.0,
        "lifetime": 30.0,
    }
    assert block_fields(5, CellBlock("Robot1", 80.0, sensed=True), 110.0)["lifetime"] == 0.0
    late = block_fields(5, CellBlock("ann", 80.0, expires=100.0), 110.0)
    assert late["lifetime"] > 0, "0: it stays blocked"


@pytest.mark.parametrize("field", ["age", "lifetime"])
@pytest.mark.parametrize("seconds", [-1.0, inf, nan])
def test_times_that_cannot_be_are_refused(field: str, seconds: float) -> None:
    with pytest.raises(ValueError, match=f"cell 5: its {field} must be 0 .. 1e.10 s"):
        read_cell_request(request(**{field: seconds}), 100.0)
