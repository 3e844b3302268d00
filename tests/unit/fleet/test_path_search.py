"""The search for one path costs what the settings say, however many robots pass through each cell."""

from __future__ import annotations

from itertools import chain, count
from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.ledger import CellLedger
from rce_fleet.coordination.path_search import Roads, Turns, find_path, moves_to
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.guidance import RIGHT, UP
from rce_fleet.planning.motion import Motion

if TYPE_CHECKING:
    from collections.abc import Sequence

_SIZE, _ROUNDS, _EFFORT = 12, 8, 120


class _Neighbours(list["Sequence[int]"]):
    """The neighbours of each cell; counts how often they are asked for."""

    asked = 0

    def __getitem__(self, cell: int) -> Sequence[int]:  # type: ignore[override]
        self.asked += 1
        return super().__getitem__(cell)


def busy_ledger(rows: range) -> CellLedger:
    """Return a ledger in which a robot drives each row up and down several times, and one more waits."""
    ledger = CellLedger()
    ledger.place("Robot", 0)
    there, back = range(_SIZE - 3, 1, -1), range(2, _SIZE - 1)
    for row in rows:
        robot, first = f"Other{row}", row * _SIZE
        ledger.place(robot, first + _SIZE - 1)
        columns = chain(*((1, *back, *there) for _ in range(_ROUNDS)))
        path = [*range(_SIZE - 2, 1, -1), *columns]
        ledger.insert(robot, zip((first + column for column in path), count(1.0)))
    return ledger


def expansions(rows: range) -> tuple[int, bool]:
    """Return how many cells a search expanded, and whether it found a path."""
    grid = GridMap(_SIZE, _SIZE)
    goal = 6 * _SIZE + 6
    neighbours = _Neighbours(grid.neighbours)
    roads = Roads(neighbours, set(), frozenset(), {}, frozenset({goal}), {})
    field = moves_to(goal, grid.neighbours, set(), frozenset())
    found = find_path(roads, busy_ledger(rows), "Robot", goal, field, _EFFORT)
    return neighbours.asked, found is not None


def test_effort_of_a_search_counts_each_interval() -> None:
    """In heavy traffic each cell has many intervals, so a search ends after fewer cells."""
    asked, is_found = expansions(range(1, _SIZE))
    assert not is_found
    assert 0 < asked < _EFFORT // 3


def test_effort_suffices_where_no_robot_drives() -> None:
    assert expansions(range(0))[1]


def test_moves_up_to_a_start_are_those_of_the_whole_map() -> None:
    grid = GridMap(6, 7, blocked=frozenset({9, 16, 23, 30}))
    whole = moves_to(0, grid.neighbours, set(), frozenset())
    for start in grid.free:
        assert moves_to(0, grid.neighbours, set(), frozenset(), start)[start] == whole[start]


@pytest.mark.parametrize(("facing", "corner"), [(RIGHT, 5), (UP, 24)])
def test_path_has_few_turns(facing: int, corner: int) -> None:
    """Of all shortest paths the one that begins where the robot faces, with one turn."""
    grid = GridMap(5, 6)
    turns = Turns(facing, 6, Motion(quarter_turn=1.0, stop=0.5).turn_steps.tolist())
    roads = Roads(grid.neighbours, set(), frozenset(), {}, frozenset({29}), {}, turns)
    ledger = CellLedger()
    ledger.place("Robot", 0)
    found = find_path(roads, ledger, "Robot", 29, moves_to(29, grid.neighbours, set(), frozenset()), 10_000)
    assert found is not None
    _, path = found
    assert corner in [cell for cell, _ in path]
    assert len(path) == 9
    assert path[-1][1] - path[0][1] == pytest.approx(8 + 1.5)


def test_path_is_longer_to_save_turns() -> None:
    """A zigzag of 8 moves with seven turns; around it 10 moves with two."""
    zigzag = [0, 1, 7, 8, 14, 15, 21, 22, 28]
    around = [0, 6, 12, 18, 24, 30, 31, 32, 33, 34, 28]
    grid = GridMap(6, 6, blocked=frozenset(range(36)) - {*zigzag, *around})
    turns = Turns(RIGHT, 6, Motion(quarter_turn=1.0, stop=0.5).turn_steps.tolist())
    field = moves_to(28, grid.neighbours, set(), frozenset())
    for chosen, expected in ((None, zigzag), (turns, around)):
        ledger = CellLedger()
        ledger.place("Robot", 0)
        roads = Roads(grid.neighbours, set(), frozenset(), {}, frozenset({28}), {}, chosen)
        found = find_path(roads, ledger, "Robot", 28, field, 10_000)
        assert found is not None
        assert [cell for cell, _ in found[1]] == expected[1:]
