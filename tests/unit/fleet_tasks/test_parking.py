"""Where idle robots wait: parking places, and cells where they are in the way of others or of tasks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks import parking as parking_module
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.parking import keeps_clear, place_to_wait
from rce_fleet.tasks.records import Places, Zone

from .conftest import Floor


def test_a_robot_in_a_corridor_is_in_the_way() -> None:
    """A corridor one cell wide between two rooms; a niche in a room's corner is not in the way."""
    grid = GridMap(3, 7, blocked=frozenset({2, 3, 4, 16, 17, 18}))
    assert not keeps_clear(grid, grid.blocked, 10)
    assert keeps_clear(grid, grid.blocked, 0)
    assert place_to_wait(grid, grid.blocked, 10, set()) not in (9, 10, 11)


def test_an_idle_robot_leaves_the_cell_of_a_task(floor: Floor) -> None:
    robot = floor.add("Robot1", 20)
    floor.go(20, earliest_start=floor.now + 1e6)
    floor.run(20)
    assert robot.cell != 20


@pytest.mark.parametrize("parking", [(), (20,), (20, 6)])
def test_an_idle_robot_leaves_the_path_of_another_one(floor: Floor, parking: tuple[int, ...]) -> None:
    """The planner ``dijkstra`` only tells who waits for it. A parking place can be on a path too."""
    floor.book.emit(Places(parking=parking), "places", floor.now)
    robot, other = floor.add("Robot1", 20), floor.add("Robot2", 16)
    floor.go(23, robot="Robot2")
    floor.stuck.add("Robot2")
    floor.run(10)
    assert robot.cell == 20
    other.barred_by = 20
    floor.run(20)
    assert robot.cell == 6 if 6 in parking else robot.cell != 20


@pytest.mark.parametrize("closes", ["cells", "edges"])
def test_an_idle_robot_waits_where_no_own_zone_bars_it(floor: Floor, closes: str) -> None:
    """The planner would refuse the nearest cell in each step, and the robot stay in the way."""
    cells = (11, 12, 13, 19, 21, 27)
    edges = tuple((beside, cell) for cell in (12, 19, 21) for beside in floor.grid.around(cell))
    zone = Zone("own", "blocked", cells) if closes == "cells" else Zone("own", "blocked", (), edges=edges)
    floor.book.emit(replace(zone, robots=("Robot1",)), "zone", floor.now)
    floor.add("Robot1", 20)
    floor.go(20, earliest_start=floor.now + 1e6)
    goals = set()
    for _ in range(15):
        floor.run(1)
        goals |= {goal for goal in floor.dispatcher.goals().values() if goal is not None}
    assert goals == {28}


@pytest.mark.parametrize(
    ("capacity", "robots", "moves"), [(1, (), True), (1, ("Robot2",), False), (2, (), False)]
)
def test_an_idle_robot_leaves_a_full_zone_of_tasks(
    floor: Floor, capacity: int, robots: tuple[str, ...], moves: bool
) -> None:
    """It stays while the zone has room, is for other robots, or has no cell of a task."""
    lift = (18, 19, 20, 26, 27, 28)
    floor.book.emit(Zone("lift", "limited", lift, float(capacity), robots=robots), "zone", floor.now)
    robot = floor.add("Robot1", 19)
    floor.run(20)
    assert robot.cell == 19
    floor.go(28, earliest_start=floor.now + 1e6)
    floor.run(20)
    assert (robot.cell not in lift) is moves


def test_robots_without_a_place_to_wait_hold_no_step_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """In aisles one cell wide there is none: the search for 300 robots took two seconds of each step."""
    walls = frozenset(cell for cell in range(200) if cell // 20 % 2 and cell % 20 not in (0, 19))
    floor = Floor(grid=GridMap(10, 20, blocked=walls))
    cells = [cell for cell in range(1, 200, 2) if cell not in walls and cell // 20 % 2 == 0][:40]
    for number, cell in enumerate(cells):
        floor.add(f"Robot{number}", cell)
        floor.go(cell, earliest_start=floor.now + 1e6)
    searched: list[int] = []
    search = parking_module.place_to_wait

    def noted(grid: GridMap, shut: Any, start: int, avoided: Any, closed: Any) -> int | None:
        searched.append(start)
        return search(grid, shut, start, avoided, closed)

    monkeypatch.setattr(parking_module, "place_to_wait", noted)
    counts = []
    for _ in range(30):
        before = len(searched)
        floor.run(1)
        counts.append(len(searched) - before)
    assert 0 < max(counts) <= 4
    assert set(searched) == set(cells), "for some robots no place was searched"


def test_many_robots_leave_the_cells_of_tasks(floor: Floor) -> None:
    """A few in each step."""
    cells = range(0, 64, 3)
    robots = [floor.add(f"Robot{cell}", cell) for cell in cells]
    for cell in cells:
        floor.go(cell, earliest_start=floor.now + 1e6)
    floor.run(30)
    assert sum(robot.cell in cells for robot in robots) == 0


def test_idle_robots_wait_at_parking_places(floor: Floor) -> None:
    floor.book.emit(Places(parking=(6, 7)), "places", floor.now)
    robots = [floor.add(f"Robot{number}", cell) for number, cell in enumerate((20, 21, 22), 1)]
    floor.run(30)
    assert {6, 7} <= {robot.cell for robot in robots}


@pytest.mark.parametrize("why", ["dead", "shut", "removed", "taken"])
def test_a_parking_place_that_is_lost_is_given_up(floor: Floor, why: str) -> None:
    floor.book.emit(Places(parking=(6, 56)), "places", floor.now)
    robot = floor.add("Robot1", 3)
    floor.run(7)
    assert floor.dispatcher.goals() == {"Robot1": 6}
    if why == "dead":
        floor.let_die(floor.add("Robot2", 6))
    elif why == "shut":
        floor.facts.shut, floor.facts.map_revision = frozenset({6}), 1
    elif why == "removed":
        floor.book.emit(Places(parking=(56,)), "places", floor.now)
    else:
        floor.book.create(Order((Stop(Action.GO, (6,), 60.0),), robot="Robot2"), floor.now)
        floor.add("Robot2", 7)
    floor.run(20)
    assert robot.cell == 56


def test_a_parked_robot_leaves_the_cell_of_a_task(floor: Floor) -> None:
    """It waits there since before the task came."""
    floor.add("Robot1", 20)
    floor.book.emit(Places(chargers=(20,)), "places", floor.now)
    floor.run(10)
    place = floor.dispatcher.goals()["Robot1"]
    assert place is not None
    floor.go(place, robot="Robot2")
    floor.add("Robot2", 63)
    floor.run(10)
    assert floor.dispatcher.goals()["Robot1"] != place


class CountedRobots(dict[str, RobotFacts]):
    """Robots by name; counts how often one looks at all of them."""

    looks = 0

    def values(self) -> Any:
        self.looks += 1
        return super().values()


def test_a_step_looks_at_all_robots_a_few_times(floor: Floor) -> None:
    """However many are idle: it does not compare each robot with all others."""
    robots = floor.facts.robots = CountedRobots()
    for number in range(40):
        floor.add(f"Robot{number}", number)
    floor.run(10)
    robots.looks = 0
    floor.dispatcher.update(floor.now, floor.facts)
    assert robots.looks < 20
