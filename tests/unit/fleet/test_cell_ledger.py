"""Claims and turns."""

from __future__ import annotations

import pytest

from rce_fleet.coordination.ledger import CellLedger
from rce_fleet.exceptions import InvariantError


def ledger_of(**places: int) -> CellLedger:
    ledger = CellLedger()
    for robot, cell in places.items():
        ledger.place(robot, cell)
    return ledger


def adopt(ledger: CellLedger, routes: dict[str, list[tuple[int, int]]]) -> None:
    """Adopt a plan given as ``(step, cell)`` for each robot, its last granted cell first."""
    visits = sorted((step, robot, cell) for robot, route in routes.items() for step, cell in route[1:])
    starts = {robot: route[0][1] for robot, route in routes.items()}
    ledger.begin_plan(starts)
    ledger.extend_plan((robot, cell, step) for step, robot, cell in visits)


def test_a_cell_is_granted_in_the_order_of_the_plan() -> None:
    ledger = ledger_of(a=0, b=8)
    adopt(ledger, {"a": [(0, 0), (1, 1), (2, 2)], "b": [(0, 8), (2, 0), (3, 1)]})
    assert not ledger.grant("b", 4), "a is still in cell 0"
    assert ledger.grant("a", 4)
    assert ledger.granted("a") == [0, 1, 2]
    ledger.arrive("a", 1)
    assert ledger.grant("b", 4)
    assert ledger.granted("b") == [8, 0]
    ledger.arrive("a", 1)
    assert ledger.grant("b", 4)
    assert ledger.granted("b") == [8, 0, 1]
    ledger.validate()


def test_robot_first_in_plan_gets_the_cell_first() -> None:
    ledger = ledger_of(a=0, b=3)
    adopt(ledger, {"a": [(0, 0), (1, 1), (2, 2), (3, 10)], "b": [(0, 3), (9, 2)]})
    assert not ledger.grant("b", 4)
    ledger.grant("a", 4)
    ledger.arrive("a", 3)
    assert ledger.grant("b", 4)


def test_grants_are_limited_to_the_given_number() -> None:
    ledger = ledger_of(a=0)
    adopt(ledger, {"a": [(step, step) for step in range(8)]})
    ledger.grant("a", 2)
    assert ledger.granted("a") == [0, 1, 2]
    assert not ledger.grant("a", 2)


def test_overlapped_cells_are_claimed_until_arrival() -> None:
    """Overlapped cells are claimed until the robot has arrived."""
    ledger = ledger_of(a=0, b=2)
    ledger.place("a", 0, {0, 1})
    adopt(ledger, {"b": [(0, 2), (1, 1)]})
    assert not ledger.grant("b", 4)
    ledger.arrive("a", 0)
    assert ledger.grant("b", 4)


def test_a_new_plan_begins_where_granted_cells_end() -> None:
    ledger = ledger_of(a=0)
    adopt(ledger, {"a": [(0, 0), (1, 1), (2, 2)]})
    ledger.grant("a", 1)
    adopt(ledger, {"a": [(0, 1), (1, 9)]})
    assert ledger.route("a") == [0, 1, 9]
    with pytest.raises(InvariantError, match="begin"):
        adopt(ledger, {"a": [(0, 0), (1, 8)]})


def test_a_robot_cannot_be_placed_in_claimed_cells() -> None:
    ledger = ledger_of(a=0)
    with pytest.raises(InvariantError, match="cells"):
        ledger.place("b", 0)
    with pytest.raises(InvariantError):
        ledger.place("b", 1, {0, 1})
    assert ledger.claims("b") == frozenset()
    ledger.validate()


def test_a_robot_cannot_arrive_where_it_was_not_granted() -> None:
    ledger = ledger_of(a=0)
    adopt(ledger, {"a": [(0, 0), (1, 1)]})
    with pytest.raises(InvariantError, match="not granted"):
        ledger.arrive("a", 1)


def test_new_robot_claims_unclaimed_cells() -> None:
    ledger = ledger_of(a=0)
    ledger.overlap("b", {0, 1})
    assert ledger.claims("b") == {1}
    ledger.overlap("b", {2})
    assert ledger.owner(1) is None
    ledger.remove("b")
    assert ledger.owner(2) is None
    ledger.validate()


def test_removed_robot_frees_its_cells_for_others() -> None:
    ledger = ledger_of(a=0, b=2)
    adopt(ledger, {"a": [(0, 0), (1, 1)], "b": [(0, 2), (2, 1), (3, 0)]})
    ledger.remove("a")
    assert ledger.grant("b", 4)
    assert ledger.granted("b") == [2, 1, 0]
    ledger.validate()
