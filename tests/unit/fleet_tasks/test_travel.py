"""Distances to many cells: both forms of the loop agree, and a new grid is measured a slice at a time."""

from __future__ import annotations

from dataclasses import replace
from math import inf, pi
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.compiled import is_available
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import Lane, LaneGraph
from rce_fleet.tasks import travel as travel_module
from rce_fleet.tasks.records import Zone
from rce_fleet.tasks.travel import CLOSES_MOVES, REFRESHED, TravelCosts
from rce_fleet.tasks.travel_loops import measure_ways

COST = {"ice": 2.5, "shut": inf}


def measured(seed: int, loop: Any, size: int = 6) -> list[Any]:
    """Return the distances to all cells of a random floor."""
    rng = Random(seed)
    grid = GridMap(size, size + 1, cell_size=0.1)
    cells = range(len(grid))
    zones = {name: Zone(name, "cost", tuple(rng.sample(cells, 6))) for name in COST}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(travel_module, "measure_ways", loop)
        travel = TravelCosts()
        travel.set_map(grid, frozenset(rng.sample(cells, 8)), zones, 0)
        travel.measure(list(cells), COST)
        assert travel.missing(cells, COST) == []
        return [travel.field(cell, COST).tolist() for cell in cells]


def test_a_zone_costs_a_robot_more() -> None:
    """The way through the zone is four metres long and counts ten; around it are six."""
    travel, grid = TravelCosts(), GridMap(2, 5)
    zone = {"ice": Zone("ice", "cost", (1, 2, 3))}
    travel.set_map(grid, frozenset(), zone, 0)
    assert travel.metres(0, 4) == 4.0
    assert travel.metres(0, 4, {"ice": 3.0}) == 6.0


def test_a_robot_may_leave_a_blocked_cell_but_not_enter_it() -> None:
    travel, grid = TravelCosts(), GridMap(1, 3)
    travel.set_map(grid, frozenset({1}), {}, 0)
    assert travel.metres(1, 2) == 1.0
    assert travel.metres(2, 1) == float("inf")
    assert travel.metres(0, 2) == float("inf")


def test_ways_do_not_lead_against_zones() -> None:
    """On a floor of two rows the lower one leads to the right; back is along the upper one."""
    travel, grid = TravelCosts(), GridMap(2, 5)
    zone = Zone("aisle", "one_way", (1, 2, 3), 0.0)
    travel.set_map(grid, frozenset(), {"aisle": zone}, 0)
    assert (travel.metres(0, 4), travel.metres(4, 0)) == (4.0, 6.0)
    travel.set_map(grid, frozenset(), {"aisle": replace(zone, value=pi)}, 0)
    assert (travel.metres(0, 4), travel.metres(4, 0)) == (6.0, 4.0)
    travel.set_map(grid, frozenset(), {"gate": Zone("gate", "blocked", (), edges=((1, 2), (2, 99)))}, 0)
    assert (travel.metres(0, 4), travel.metres(4, 0)) == (6.0, 4.0)
    travel.set_map(grid, frozenset(range(5, 10)), {"aisle": zone}, 0)
    assert (travel.metres(0, 4), travel.metres(4, 0)) == (4.0, inf)


def test_moves_that_are_closed_to_one_robot_are_open_to_others() -> None:
    travel, grid = TravelCosts(), GridMap(2, 5)
    zone = Zone("aisle", "one_way", (1, 2, 3), 0.0, robots=("Robot1",))
    travel.set_map(grid, frozenset(), {"aisle": zone}, 0)
    assert (travel.metres(4, 0), travel.metres(4, 0, {"aisle": CLOSES_MOVES})) == (4.0, 6.0)
    assert travel.metres(4, 0, {"aisle": 2.0}) == 6.0, "metres count twice, and around it is nearer"


def test_ways_follow_lanes() -> None:
    """There along the slow lane, back around; other lanes are another map."""
    travel, floor = TravelCosts(), GridMap(2, 5, cell_size=0.5)
    lanes = LaneGraph(
        (
            Lane("out", (0, 1, 2, 3, 4), one_way=True, speed=0.25),
            Lane("back", (4, 9, 8, 7, 6, 5, 0), one_way=True, speed=0.5),
        )
    )
    grid = lanes.restrict(floor)
    travel.set_map(grid, frozenset(), {}, 0, lanes)
    assert travel.metres(0, 4) == 4.0
    assert travel.metres(4, 0) == 3.0
    assert travel.metres(2, 1) == 2.0 + 3.0 + 1.0
    travel.set_map(grid, frozenset(), {}, 0)
    assert travel.metres(2, 1) == 0.5


@settings(max_examples=15)
@given(st.integers(0, 2**32))
def test_loop_and_scipy_measure_the_same(seed: int) -> None:
    assert measured(seed, measure_ways.loop, 4) == measured(seed, measure_ways.numpy, 4)


def test_compiled_loop_and_scipy_measure_the_same() -> None:
    if not is_available():
        pytest.skip("numba is not installed")
    for seed in range(20):
        assert measured(seed, measure_ways.compile()) == measured(seed, measure_ways.numpy)


def test_a_factor_that_shortens_ways_is_not_used() -> None:
    """Ways through a zone with a negative factor would grow shorter with each round."""
    grid = GridMap(3, 3)
    loops = [measure_ways.loop, measure_ways.numpy]
    for loop in [*loops, measure_ways.compile()] if is_available() else loops:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(travel_module, "measure_ways", loop)
            travel = TravelCosts()
            travel.set_map(grid, frozenset(), {"z": Zone("z", "cost", (1, 2))}, 0)
            assert travel.field(0, {"z": -2.0})[[0, 1, 2]].tolist() == pytest.approx([0.0, 0.505, 0.515])


def test_together_and_alone_are_the_same() -> None:
    grid = GridMap(5, 9)
    both = []
    for together in (True, False):
        travel = TravelCosts()
        travel.set_map(grid, frozenset({3, 12, 13}), {}, 0)
        if together:
            travel.measure([0, 3, 44])
        both.append([travel.field(cell) for cell in (0, 3, 44)])
    np.testing.assert_array_equal(both[0], both[1])


def test_a_changed_map_is_measured_in_slices() -> None:
    """After a cell is blocked, distances follow a few at a time; to a blocked cell no way leads at once."""
    travel, grid = TravelCosts(), GridMap(3, 40)
    travel.set_map(grid, frozenset(), {}, 0)
    goals = range(80, 120)
    before = [travel.metres(0, goal) for goal in goals]
    shut = frozenset({1, 40, 119})
    travel.set_map(grid, shut, {}, 1)
    travel.begin_step()
    first = [travel.metres(0, goal) for goal in goals]
    assert sum(way == inf for way in first) == REFRESHED + 1
    assert all(now in (way, inf) for way, now in zip(before, first, strict=True))
    for _ in range(3):
        travel.begin_step()
        last = [travel.metres(0, goal) for goal in goals]
    assert last == [inf] * len(goals)


def test_new_grid_is_measured_in_slices(floor: Any) -> None:
    """No slice measures more than a few cells, and a step after them measures none."""
    floor.grid = floor.facts.grid = floor.book.grid = GridMap(10, 30)
    rng = Random(1)
    for number, cell in enumerate(rng.sample(range(300), 40)):
        floor.add(f"Robot{number}", cell)
    pairs = list(zip(range(0, 300, 3), range(1, 300, 3), strict=True))
    for source, target in pairs:
        floor.deliver(source, target)
    travel = floor.dispatcher._travel
    most, slices = 0, 0
    known = 0
    is_behind = True
    while is_behind:
        is_behind = floor.dispatcher.measure(floor.facts)
        slices, most, known = slices + 1, max(most, len(travel._fields) - known), len(travel._fields)
    assert most <= travel.at_once + 1
    assert known == 2 * len(pairs)
    assert slices >= known / (travel.at_once + 1)
    floor.run(1)
    assert len(travel._fields) == known
    assert not floor.dispatcher.measure(floor.facts)


def test_distances_are_measured_ahead_however_many_tasks_there_were(
    floor: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After as many tasks as distances are kept, each step measured them alone, and stopped for it."""
    floor.grid = floor.facts.grid = floor.book.grid = GridMap(10, 30)
    monkeypatch.setattr(travel_module, "MOST_BYTES", 20 * 4 * 300)
    floor.add("Robot1", 0)
    for cell in range(30):
        task = floor.go(cell)
        floor.dispatcher.measure(floor.facts)
        floor.book.cancel(task.id, floor.now)
    floor.go(299)
    floor.dispatcher.measure(floor.facts)
    assert floor.dispatcher._travel.missing([299]) == []


def no_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(travel_module, "REFRESHED", 0)
    monkeypatch.setattr(travel_module, "CELLS_PER_STEP", 0)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 2**32))
def test_estimates_know_exactly_where_no_way_leads(seed: int) -> None:
    """An estimate lacks a detour at most; where a robot has none, it says so."""
    rng = Random(seed)
    grid = GridMap(5, 6)
    cells = range(len(grid))
    zones = {
        name: Zone(name, kind, tuple(rng.sample(cells, 5)))
        for name, kind in (("ice", "cost"), ("shut", "blocked"))
    }
    shut = frozenset(rng.sample(cells, 8))
    for costs in ({"shut": inf}, {"ice": 2.5, "shut": inf}, {"ice": 2.5}):
        exact, estimated = TravelCosts(), TravelCosts()
        for travel in (exact, estimated):
            travel.set_map(grid, shut, zones, 0)
        with pytest.MonkeyPatch.context() as patch:
            no_budget(patch)
            estimated.begin_step()
            for goal in cells:
                found, right = estimated.field(goal, costs), exact.field(goal, costs)
                np.testing.assert_array_equal(np.isinf(found), np.isinf(right))
                assert np.all(found <= right)
                assert [estimated.metres(cell, goal, costs) for cell in cells] == found.tolist()
                out = np.empty(len(grid), np.float32)
                estimated.write_metres(np.arange(len(grid)), goal, costs, out)
                np.testing.assert_array_equal(out, found)


def test_estimates_become_distances_in_later_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = GridMap(5, 6)
    travel = TravelCosts()
    travel.set_map(grid, frozenset(), {"z": Zone("z", "blocked", (8, 9, 10))}, 0)
    monkeypatch.setattr(travel_module, "CELLS_PER_STEP", 0)
    monkeypatch.setattr(travel_module, "REFRESHED", 1)
    travel.begin_step()
    before = [travel.metres(3, goal, {"z": inf}) for goal in (15, 16)]
    travel.begin_step()
    after = [travel.metres(3, goal, {"z": inf}) for goal in (15, 16)]
    assert before[0] == after[0]
    assert before[1] < after[1] == travel.metres(3, 16, {"z": inf})


@pytest.mark.slow
def test_many_zones_for_some_robots_take_bounded_steps(floor: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred robots with a zone each have a hundred times as many distances; a step computed them all."""
    floor.grid = floor.facts.grid = floor.book.grid = GridMap(30, 30)
    monkeypatch.setattr(travel_module, "CELLS_PER_STEP", 20 * 900)
    rng = Random(2)
    cells = rng.sample(range(900), 700)
    for number in range(100):
        floor.add(f"Robot{number}", cells.pop())
        floor.book.zones[f"z{number}"] = Zone(
            f"z{number}", "blocked", (cells.pop(), cells.pop()), robots=(f"Robot{number}",)
        )
    for _ in range(150):
        floor.deliver(cells.pop(), cells.pop())
    computed: list[tuple[int, bool]] = []
    compute = TravelCosts._compute

    def counting(self: TravelCosts, grid: GridMap, goals: Any, costs: Any) -> Any:
        computed.append((len(goals), bool(costs)))
        return compute(self, grid, goals, costs)

    monkeypatch.setattr(TravelCosts, "_compute", counting)
    while floor.dispatcher.measure(floor.facts):
        assert sum(count for count, _ in computed) <= 150 * 2
    for _ in range(8):
        computed.clear()
        floor.run(1)
        assert sum(count for count, is_own in computed if is_own) <= 20
        assert len([task for task in floor.book.active_tasks() if task.robot]) > 0
    assert len({task.robot for task in floor.book.active_tasks()}) == 100


def test_no_task_behind_a_cell_that_is_blocked_for_the_robot(
    floor: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even before the distances of its own zones are computed."""
    no_budget(monkeypatch)
    floor.grid = floor.facts.grid = floor.book.grid = GridMap(1, 9)
    floor.add("Near", 4)
    floor.add("Far", 0)
    floor.book.zones["z"] = Zone("z", "blocked", (5,), robots=("Near",))
    task = floor.go(8)
    floor.run(1)
    assert floor.task(task).robot == "Far"


def test_a_task_is_given_to_the_robot_that_may_drive_the_nearest_way(floor: Any) -> None:
    """Behind a one-way aisle is farther than before it."""
    floor.grid = floor.facts.grid = floor.book.grid = GridMap(2, 9)
    floor.add("Behind", 5)
    floor.add("Before", 0)
    floor.book.zones["aisle"] = Zone("aisle", "one_way", tuple(range(1, 8)), 0.0)
    task = floor.go(3)
    floor.run(1)
    assert floor.task(task).robot == "Before"
