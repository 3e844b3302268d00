"""Targets of robots: all different, also if a robot cannot leave its cell."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.coordination.targets import assign_targets
from rce_fleet.planning.grid import GridMap


def test_a_goal_in_the_cell_of_an_enclosed_robot_is_unreachable() -> None:
    grid = GridMap(1, 4)
    own = {"a": frozenset({0, 1, 2, 3})}
    found = assign_targets(grid, {"a": 0, "b": 2}, {"b": 0}, {}, forbidden=own)
    assert found.cells["a"] == 0
    assert found.cells["b"] != 0
    assert found.unreachable == {"b"}


def test_two_idle_robots_stay_where_a_cell_is_blocked_under_one() -> None:
    grid = GridMap(1, 2, blocked=frozenset({1}))
    found = assign_targets(grid, {"b": 1, "a": 0}, {}, {})
    assert found.cells == {"a": 0, "b": 1}
    assert not found.unreachable


def test_a_robot_at_the_end_of_a_one_way_lane_keeps_its_cell() -> None:
    grid = GridMap(1, 3)
    found = assign_targets(grid, {"idle": 2, "sent": 0}, {"sent": 2}, {}, closed=frozenset({(1, 0), (2, 1)}))
    assert found.cells["idle"] == 2
    assert found.cells["sent"] in (0, 1)
    assert found.unreachable == {"sent"}


@given(st.data())
def test_targets_are_all_different(data: st.DataObject) -> None:
    rows, columns = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 4))
    cells = st.integers(0, rows * columns - 1)
    grid = GridMap(rows, columns, blocked=data.draw(st.frozensets(cells)))
    starts = data.draw(st.lists(cells, unique=True))
    robots = [f"r{number}" for number in range(len(starts))]
    goals = data.draw(st.lists(cells, unique=True, max_size=len(starts)))
    own = data.draw(st.lists(st.frozensets(cells), min_size=len(starts), max_size=len(starts)))
    closed = data.draw(st.frozensets(st.tuples(cells, cells)))
    found = assign_targets(
        grid,
        dict(zip(robots, starts, strict=True)),
        dict(zip(robots, goals, strict=False)),
        {},
        closed=closed,
        forbidden=dict(zip(robots, own, strict=True)),
    )
    assert sorted(found.cells) == sorted(robots)
    assert len(set(found.cells.values())) == len(robots)


@given(st.data())
def test_targets_can_be_reached_over_open_moves(data: st.DataObject) -> None:
    """Whatever moves are closed; robots without a reachable goal are told."""
    rows, columns = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 4))
    cells = st.integers(0, rows * columns - 1)
    grid = GridMap(rows, columns, blocked=data.draw(st.frozensets(cells, max_size=3)))
    moves = [(cell, other) for cell in range(len(grid)) for other in grid.around(cell)]
    closed = data.draw(st.frozensets(st.sampled_from(moves))) if moves else frozenset()
    starts = dict(enumerate(data.draw(st.lists(cells, unique=True, max_size=5))))
    goals = dict(zip(starts, data.draw(st.lists(cells, unique=True, max_size=len(starts))), strict=False))
    named = {f"R{robot}": cell for robot, cell in starts.items()}
    wanted = {f"R{robot}": cell for robot, cell in goals.items()}
    found = assign_targets(grid, named, wanted, {}, closed=closed)
    for robot, start in named.items():
        seen, rest = {start}, [start]
        while rest:
            cell = rest.pop()
            for other in grid.neighbours[cell]:
                if other not in seen and (cell, other) not in closed:
                    seen.add(other)
                    rest.append(other)
        assert found.cells[robot] in seen
        goal = wanted.get(robot)
        if goal is not None and (goal not in seen or goal in grid.blocked):
            assert robot in found.unreachable
