"""Which cell is blocked under way, and whether that took effect."""

from __future__ import annotations

import pytest
from support.fleet_states import fleet, robot

from rce_fleet.demo.blocking import EFFECT_TIMEOUT, REPLAN_TIMEOUT, BlockAction, CellBlocker
from rce_fleet.planning.grid import GridMap

GRID = GridMap(rows=4, columns=4)
ROW = [0, 1, 2, 3]


def test_the_middle_of_the_path_is_blocked_and_its_effect_seen() -> None:
    block = CellBlocker(GRID, {"a": 3})
    assert block.update(fleet(robot("a", cell=0, goal=3, plan=ROW)), (), 0.0) is BlockAction.BLOCK
    assert block.cell in (1, 2)
    assert block.in_progress
    cell = block.cell
    around = robot("a", cell=0, goal=3, plan=[0, 4, 5, 6, 7, 3], replans=1)
    assert block.update(fleet(around, pending=[cell]), (), 0.5) is BlockAction.NOTHING
    assert block.update(fleet(around, blocked=[cell]), (), 0.7) is BlockAction.NOTHING
    assert not block.done, "the box is not there yet"
    assert block.update(fleet(around, blocked=[cell]), (cell,), 0.9) is BlockAction.NOTHING
    assert (block.done, block.in_progress) == ([cell], False)
    assert block.update(fleet(robot("a", cell=0, goal=3, plan=ROW)), (), 9.0) is BlockAction.NOTHING


def test_cells_that_were_granted_are_left_alone_if_possible() -> None:
    block = CellBlocker(GRID, {"a": 3})
    assert (
        block.update(fleet(robot("a", cell=0, goal=3, plan=ROW, granted=[0, 1])), (), 0.0)
        is BlockAction.BLOCK
    )
    assert block.cell == 2
    block = CellBlocker(GRID, {"a": 3})
    assert (
        block.update(fleet(robot("a", cell=0, goal=3, plan=ROW, granted=ROW)), (), 0.0) is BlockAction.BLOCK
    )
    assert block.cell == 2


def test_cell_that_cuts_off_a_goal_is_not_blocked() -> None:
    corridor = GridMap(rows=1, columns=6)
    block = CellBlocker(corridor, {"a": 5})
    assert (
        block.update(fleet(robot("a", cell=0, goal=5, plan=[0, 1, 2, 3, 4, 5])), (), 0.0)
        is BlockAction.NOTHING
    )
    assert not block.in_progress


def test_nothing_is_blocked_while_a_robot_has_no_place() -> None:
    block = CellBlocker(GRID, {"a": 3, "b": 12})
    lost = robot("b", state="joining")
    assert block.update(fleet(robot("a", cell=0, goal=3, plan=ROW), lost), (), 0.0) is BlockAction.NOTHING


def test_cell_without_effect_is_freed() -> None:
    block = CellBlocker(GRID, {"a": 3})
    block.update(fleet(robot("a", cell=0, goal=3, plan=ROW)), (), 0.0)
    cell = block.cell
    past = fleet(robot("a", cell=3, goal=3), blocked=[cell])
    assert block.update(past, (cell,), REPLAN_TIMEOUT) is BlockAction.NOTHING
    assert block.update(past, (cell,), REPLAN_TIMEOUT + 0.1) is BlockAction.FREE
    assert block.cell == cell
    assert not block.in_progress


def test_cell_that_stays_pending_is_freed() -> None:
    block = CellBlocker(GRID, {"a": 3})
    block.update(fleet(robot("a", cell=0, goal=3, plan=ROW)), (), 0.0)
    held = fleet(robot("a", cell=0, goal=3, replans=1), pending=[block.cell])
    assert block.update(held, (), EFFECT_TIMEOUT - 0.1) is BlockAction.NOTHING
    assert block.update(held, (), EFFECT_TIMEOUT + 0.1) is BlockAction.FREE


def test_after_a_refusal_a_cell_is_chosen_again() -> None:
    block = CellBlocker(GRID, {"a": 3})
    driving = fleet(robot("a", cell=0, goal=3, plan=ROW))
    assert block.update(driving, (), 0.0) is BlockAction.BLOCK
    block.on_refused()
    assert not block.in_progress
    assert block.update(driving, (), 0.2) is BlockAction.BLOCK


RING = GridMap(rows=3, columns=5, blocked=frozenset({6, 7, 8}))
"""One lane around a wall; with a cell of it blocked, robots cannot pass one another any more."""


@pytest.mark.slow
def test_cell_needed_to_pass_each_other_is_not_blocked() -> None:
    block = CellBlocker(RING, {"a": 14, "b": 0})
    driving = fleet(
        robot("a", cell=0, goal=14, plan=[0, 1, 2, 3, 4, 9, 14]),
        robot("b", cell=14, goal=0, plan=[14, 13, 12, 11, 10, 5, 0]),
    )
    assert block.update(driving, (), 0.0) is BlockAction.NOTHING
    alone = CellBlocker(RING, {"a": 14})
    assert (
        alone.update(fleet(robot("a", cell=0, goal=14, plan=[0, 1, 2, 3, 4, 9, 14])), (), 0.0)
        is BlockAction.BLOCK
    )


def test_cell_that_cuts_off_a_goal_later_is_freed() -> None:
    block = CellBlocker(RING, {"a": 4, "b": 3})
    driving = (
        robot("a", cell=0, goal=4, plan=[0, 1, 2, 3, 4], granted=[0]),
        robot("b", cell=10, goal=3, plan=[10, 5, 0, 1, 2, 3], granted=[10]),
    )
    assert block.update(fleet(*driving), (), 0.0) is BlockAction.BLOCK
    cell = block.cell
    crossed = (
        robot("a", cell=4, goal=4, plan=[], replans=1),
        robot("b", cell=13, goal=3, plan=[], replans=1),
    )
    assert block.update(fleet(*crossed, blocked=[cell]), (cell,), 1.0) is BlockAction.FREE
    assert block.cell == cell
    assert block.done == []


def test_several_cells_are_blocked_one_after_another() -> None:
    block = CellBlocker(GRID, {"a": 3}, count=2)
    assert block.update(fleet(robot("a", cell=0, goal=3, plan=ROW)), (), 0.0) is BlockAction.BLOCK
    first = block.cell
    around = robot("a", cell=0, goal=3, plan=[0, 4, 5, 6, 7, 3], replans=1)
    block.update(fleet(around, blocked=[first]), (first,), 0.5)
    assert block.update(fleet(around, blocked=[first]), (first,), 0.6) is BlockAction.BLOCK
    second = block.cell
    assert second != first
    further = robot("a", cell=0, goal=3, plan=[0, 4, 8, 9, 10, 11, 7, 3], replans=2)
    block.update(fleet(further, blocked=[first, second]), (first, second), 0.9)
    assert block.done == [first, second]
    assert block.update(fleet(further, blocked=[first, second]), (first, second), 1.0) is BlockAction.NOTHING
