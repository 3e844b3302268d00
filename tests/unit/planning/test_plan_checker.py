"""The checker finds each kind of fault, and nothing in right plans."""

from __future__ import annotations

import pytest

from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.grid import GridMap

GRID = GridMap(3, 3, blocked=frozenset({8}))


@pytest.mark.parametrize(
    ("paths", "more", "said"),
    [
        ([[0, 1], [2, 1]], {}, "step 1: robots 0 and 1 are both in cell 1"),
        ([[0, 1], [1, 0]], {}, "step 1: robots 0 and 1 exchange cells 0 and 1"),
        ([[0, 4]], {}, "step 1: robot 0 goes from cell 0 to 4, which is not beside it"),
        ([[2, 3]], {}, "step 1: robot 0 goes from cell 2 to 3, which is not beside it"),
        ([[5, 8]], {}, "step 1: robot 0 is in the blocked cell 8"),
        ([[6, 9]], {}, "step 1: robot 0 is outside the map, in cell 9"),
        ([[0, 1]], {"one_way": [(0, 1)]}, "step 1: robot 0 goes from cell 0 to 1 against a one-way edge"),
        ([[0, 1]], {"goals": [2]}, "step 1: the path of robot 0 ends in cell 1 instead of 2"),
        ([[0, 1]], {"starts": [2]}, "step 0: the path of robot 0 begins in cell 0 instead of 2"),
        ([[0, 1], []], {}, "step 0: robot 1 has no path"),
        ([[0]], {"goals": [0, 1]}, "step 0: 1 paths for 2 robots"),
        (
            [[0, 1], [1, 4], [4, 3], [3, 0]],
            {"rotations": False},
            "step 1: robots (0, 1, 2, 3) follow one another around in a circle",
        ),
        ([[0, 1], [1, 2]], {"following": 1}, "step 1: robot 0 enters cell 1 0 steps after robot 1 left it"),
        (
            [[0, 0, 1], [1, 2, 2]],
            {"following": 2},
            "step 2: robot 0 enters cell 1 1 steps after robot 1 left it",
        ),
    ],
)
def test_a_fault_is_found(paths: list[list[int]], more: dict[str, object], said: str) -> None:
    assert said in map(str, check_plan(GRID, paths, **more))  # type: ignore[arg-type]  # by name


@pytest.mark.parametrize(
    ("paths", "more"),
    [
        ([[0, 1], [1, 2]], {}),
        ([[0, 1], [1, 4], [4, 3], [3, 0]], {}),
        ([[0, 0, 0, 1], [1, 2]], {"following": 2}),
        ([[0, 1, 0, 1]], {"following": 3}),
        ([[8, 5, 4]], {"goals": [4]}),
        ([], {}),
    ],
)
def test_a_right_plan_has_no_fault(paths: list[list[int]], more: dict[str, object]) -> None:
    assert check_plan(GRID, paths, **more) == []  # type: ignore[arg-type]  # by name


def test_a_robot_stays_where_its_path_ends() -> None:
    faults = check_plan(GRID, [[0, 1], [4, 4, 1]])
    assert [str(fault) for fault in faults] == ["step 2: robots 0 and 1 are both in cell 1"]
