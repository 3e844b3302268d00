"""Batteries, chargers and parking places."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import pytest

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks import parking as parking_module
from rce_fleet.tasks.assignment import Assigner, AssignmentRules, FreeRobot
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.energy import BatteryLevels, effort_of, share_needed
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.parking import keeps_clear, place_to_wait
from rce_fleet.tasks.queueing import Queues, RobotQueue
from rce_fleet.tasks.records import Places, RobotEntry, RobotProfile, Zone
from rce_fleet.tasks.task import Task, TaskState
from rce_fleet.tasks.travel import REFRESHED, TravelCosts

from .conftest import Floor

HUNGRY = RobotProfile(capacity=1.0, drive=0.01, idle=0.0, acting=0.0)
"""A robot that takes 1 % of its battery for each metre."""


@pytest.fixture
def hungry() -> Floor:
    floor = Floor(rules=TaskRules(profile=HUNGRY), drain=0.01)
    floor.book.emit(Places(chargers=(56,)), "places", floor.now)
    return floor


def test_a_task_takes_what_its_way_takes() -> None:
    """Two metres to the first stop, five between the stops, three to the charger: 10 % of 1 Wh."""
    travel, grid = TravelCosts(), GridMap()
    travel.set_map(grid, frozenset(), {}, 0)
    task = Task(1, Order((Stop(Action.PICK, (2,)), Stop(Action.DELIVER, (7,)))), "", "", 0.0, 0.0)
    effort = effort_of(task, 0, travel, HUNGRY)
    assert (effort.first, effort.metres, effort.end) == (2.0, 5.0, 7)
    assert share_needed(effort, HUNGRY, 3.0) == pytest.approx(0.10)


def test_no_task_without_energy_for_the_way_back(hungry: Floor) -> None:
    """Cell 7 is 7 m away, and 14 m from the charger: 21 % and the critical 15 %."""
    hungry.add("Robot1", 0, battery=0.35)
    task = hungry.go(7)
    hungry.dispatcher.update(hungry.now, hungry.facts)
    assert hungry.task(task).state is TaskState.QUEUED
    assert "enough energy for it now" in hungry.task(task).reason
    hungry.add("Robot2", 0, battery=0.37)
    hungry.dispatcher.update(hungry.now + 1, hungry.facts)
    assert (hungry.task(task).state, hungry.task(task).robot) == (TaskState.RUNNING, "Robot2")


def test_a_blocked_charger_stops_no_task(hungry: Floor) -> None:
    """While none can be driven to, the way there does not count, also for a task that runs."""
    hungry.add("Robot1", 0, battery=0.9)
    hungry.facts.shut, hungry.facts.map_revision = frozenset({56}), 1
    first = hungry.go(3, 7)
    hungry.run(2)
    assert hungry.task(first).state is TaskState.RUNNING
    hungry.run(40)
    assert hungry.task(first).state is TaskState.DONE


def test_a_task_beyond_all_chargers_says_so(hungry: Floor) -> None:
    """The charger is not blocked, but no path leads to it: a robot would end there with an empty battery."""
    hungry.add("Robot1", 0, battery=0.9)
    hungry.facts.shut, hungry.facts.map_revision = frozenset({48, 57}), 1
    task = hungry.go(7)
    hungry.run(15)
    assert hungry.task(task).state is TaskState.QUEUED
    assert hungry.task(task).reason == "no path leads from its last stop to a charger (cells 56)"


def test_energy_is_checked_before_each_further_stop(hungry: Floor) -> None:
    """The battery turns out to be worse than it was at the start: another robot makes the second stop."""
    robot = hungry.add("Robot1", 0, battery=0.9)
    task = hungry.go(3, 7)
    hungry.run(1)
    robot.battery = 0.3
    hungry.run(4)
    assert "its battery has" in next(e.text for e in hungry.events if e.name == "released")
    hungry.add("Robot2", 6, battery=0.9)
    hungry.run_until_ended(task)
    assert [visit.robot for visit in hungry.task(task).visits] == ["Robot1", "Robot2"]
    hungry.run(30)
    assert robot.cell == 56


def test_a_loaded_robot_with_a_low_battery_goes_on(hungry: Floor) -> None:
    """Its load cannot be left behind: people are told, once, before the stop."""
    robot = hungry.add("Robot1", 0, battery=0.9)
    task = hungry.deliver(3, 7)
    hungry.run(1)
    robot.battery = 0.3
    hungry.run_until_ended(task)
    assert hungry.task(task).state is TaskState.DONE
    assert [event.name for event in hungry.events].count("low battery") == 1


def test_an_idle_robot_charges_until_full(hungry: Floor) -> None:
    robot = hungry.add("Robot1", 0, battery=0.45)
    hungry.run(10)
    assert robot.cell == 56
    robot.battery = 0.9
    hungry.run(3)
    assert hungry.dispatcher.activity("Robot1") == "charging"
    robot.battery = 0.96
    hungry.run(10)
    assert hungry.dispatcher.activity("Robot1") == "parking"
    assert robot.cell != 56, "it stays at the charger although it is full"


def test_a_robot_with_a_sufficient_battery_leaves_its_charger_for_a_task(hungry: Floor) -> None:
    robot = hungry.add("Robot1", 56, battery=0.3)
    hungry.run(2)
    task = hungry.go(58)
    hungry.run(2)
    assert hungry.task(task).state is TaskState.QUEUED
    robot.battery = 0.41
    hungry.run_until_ended(task)


def test_chargers_are_given_to_the_emptiest_first(hungry: Floor) -> None:
    hungry.add("Robot1", 0, battery=0.3)
    hungry.add("Robot2", 7, battery=0.1)
    third = hungry.add("Robot3", 63, battery=0.25)
    hungry.run(1)
    assert hungry.dispatcher.chargers.charging == {"Robot2": 56}
    assert list(hungry.dispatcher.chargers.waiting) == ["Robot3", "Robot1"]
    hungry.facts.robots["Robot2"].battery = 0.97
    hungry.run(1)
    assert hungry.dispatcher.chargers.charging == {third.id: 56}


def test_a_charge_stop_goes_to_a_charger(hungry: Floor) -> None:
    robot = hungry.add("Robot1", 0, battery=0.2)
    task = hungry.book.create(Order((Stop(Action.CHARGE), Stop(Action.GO, (5,)))), hungry.now)
    hungry.run(12)
    assert (robot.cell, hungry.task(task).target) == (56, 56)
    robot.battery = 0.97
    hungry.run_until_ended(task)


@pytest.mark.parametrize("cells", [(), (56,)])
@pytest.mark.parametrize("is_restarted", [False, True])
def test_a_charge_stop_waits_for_a_robot_that_charges(
    hungry: Floor, cells: tuple[int, ...], is_restarted: bool
) -> None:
    """Until that one's battery is sufficient; it was sent away from its charger with an empty battery."""
    charging = hungry.add("Robot1", 56, battery=0.12)
    hungry.run(2)
    assert hungry.dispatcher.activity("Robot1") == "charging"
    robot = hungry.add("Robot2", 58, battery=0.3)
    task = hungry.book.create(Order((Stop(Action.CHARGE, cells),), robot="Robot2"), hungry.now)
    hungry.run(1)
    assert hungry.task(task).state is TaskState.RUNNING
    if is_restarted:
        hungry.restart()
    hungry.run(30)
    assert (charging.cell, hungry.dispatcher.activity("Robot1")) == (56, "charging")
    assert hungry.task(task).reason == "waits for cell 56, which Robot1 uses"
    charging.battery = 0.41
    hungry.run(20)
    assert (hungry.task(task).action is not None, robot.cell) == (True, 56)
    assert charging.cell != 56


def test_a_charge_stop_takes_a_charger_that_none_uses(hungry: Floor) -> None:
    """It is farther away than the one whose robot could leave."""
    hungry.book.emit(Places(chargers=(56, 63)), "places", hungry.now)
    hungry.add("Robot1", 56, battery=0.45)
    hungry.run(2)
    hungry.add("Robot2", 48, battery=0.5)
    task = hungry.book.create(Order((Stop(Action.CHARGE),), robot="Robot2"), hungry.now)
    hungry.run(2)
    assert hungry.task(task).target == 63
    assert hungry.dispatcher.chargers.charging == {"Robot1": 56}


@pytest.mark.parametrize("away", ["unknown", "joining", "silent", "held", "no battery", "not live"])
def test_a_charge_stop_does_not_end_while_its_robot_is_away(hungry: Floor, away: str) -> None:
    """The planner or the manager was restarted, or the robot is silent for a moment: it still charges."""
    robot = hungry.add("Robot1", 0, battery=0.2)
    task = hungry.book.create(Order((Stop(Action.CHARGE), Stop(Action.GO, (5,)))), hungry.now)
    hungry.run(12)
    if away == "unknown":
        del hungry.facts.robots["Robot1"]
    elif away == "held":
        hungry.book.hold(task.id, hungry.now)
    elif away == "no battery":
        robot.battery, robot.moved_at = None, hungry.now
    elif away == "not live":
        hungry.facts.is_live = False
        del hungry.facts.robots["Robot1"]
    else:
        robot.state, robot.away_since = away, hungry.now
    hungry.run(5)
    hungry.facts.is_live = True
    hungry.facts.robots["Robot1"] = robot
    robot.state, robot.away_since, robot.battery = "arrived", inf, 0.3
    if away == "held":
        hungry.book.resume(task.id, hungry.now)
    hungry.run(3)
    assert (robot.cell, hungry.task(task).target, hungry.task(task).position) == (56, 56, 0)
    assert not [event for event in hungry.events if event.name == "acted"]
    robot.battery = 0.97
    hungry.run_until_ended(task)


def test_a_lost_robots_charge_stop_ends(hungry: Floor) -> None:
    """Another robot does the rest of the task."""
    robot = hungry.add("Robot1", 0, battery=0.2)
    task = hungry.book.create(Order((Stop(Action.CHARGE), Stop(Action.GO, (5,)))), hungry.now)
    hungry.run(12)
    robot.state, robot.away_since = "silent", hungry.now
    hungry.run(10)
    assert hungry.task(task).action is not None
    hungry.add("Robot2", 3, battery=0.9)
    hungry.run_until_ended(task)
    assert hungry.task(task).visits[-1].robot == "Robot2"


def test_a_charge_stop_of_a_robot_without_battery_ends(hungry: Floor) -> None:
    hungry.add("Robot1", 0)
    task = hungry.book.create(Order((Stop(Action.CHARGE), Stop(Action.GO, (5,)))), hungry.now)
    hungry.run_until_ended(task)


def test_thresholds_out_of_order_are_refused() -> None:
    with pytest.raises(ValueError, match="critical < sufficient <= full"):
        BatteryLevels(critical=0.5, sufficient=0.4)


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

    def noted(grid: GridMap, shut: Any, start: int, avoided: Any) -> int | None:
        searched.append(start)
        return search(grid, shut, start, avoided)

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


def test_a_zone_costs_a_robot_more() -> None:
    """The way through the zone is four metres long and counts ten; around it are six."""
    travel, grid = TravelCosts(), GridMap(2, 5)
    zone = {"ice": Zone("ice", "cost", (1, 2, 3))}
    travel.set_map(grid, frozenset(), zone, 0)
    assert travel.metres(0, 4) == 4.0
    assert travel.metres(0, 4, {"ice": 3.0}) == 6.0


def test_the_way_to_a_charger_leads_around_a_robots_forbidden_cells(hungry: Floor) -> None:
    """3 m to the stop; from there to the charger 4 m, or 18 m around the cells that Robot1 may not enter."""
    wall = Zone("wall", "blocked", tuple(range(32, 39)), robots=("Robot1",))
    hungry.book.emit(wall, "zone", hungry.now)
    hungry.add("Robot1", 0, battery=0.30)
    task = hungry.go(24)
    hungry.run(3)
    assert hungry.task(task).state is TaskState.QUEUED
    assert "enough energy for it now" in hungry.task(task).reason
    hungry.add("Robot2", 0, battery=0.30)
    hungry.run(3)
    assert hungry.task(task).robot == "Robot2"


def test_a_charger_that_is_closed_to_a_robot_keeps_no_task_from_it(hungry: Floor) -> None:
    hungry.book.emit(Zone("dock", "blocked", (56,), robots=("Robot1",)), "zone", hungry.now)
    hungry.add("Robot1", 0, battery=0.30)
    task = hungry.go(7, 3)
    hungry.run_until_ended(task)
    assert hungry.task(task).state is TaskState.DONE


@pytest.mark.parametrize("cells", [(3,), (3, 4)])
def test_a_dear_zone_takes_no_more_energy(hungry: Floor, cells: tuple[int, ...]) -> None:
    """The planner does not know cost zones: robots drive the same metres. The task was refused for good."""
    hungry.book.emit(Zone("mud", "cost", tuple(range(64)), 100.0), "zone", hungry.now)
    hungry.add("Robot1", 0, battery=0.9)
    order = Order((Stop(Action.GO, cells), Stop(Action.GO, (7,))))
    task = hungry.book.create(order, hungry.now)
    hungry.run_until_ended(task)
    assert [visit.robot for visit in hungry.task(task).visits] == ["Robot1", "Robot1"]


def test_a_cheap_zone_takes_no_less_energy(hungry: Floor) -> None:
    """7 m to the stop and 14 m to the charger; the robot would have stood still before it was there."""
    hungry.book.emit(Zone("main", "cost", tuple(range(64)), 1.0), "zone", hungry.now)
    cheap = replace(HUNGRY, zone_cost={"main": 0.01})
    hungry.book.emit(RobotEntry("Robot1", profile=cheap), "profile", hungry.now)
    hungry.add("Robot1", 0, battery=0.30)
    task = hungry.go(7)
    hungry.run(3)
    assert hungry.task(task).state is TaskState.QUEUED
    assert "enough energy for it now" in hungry.task(task).reason


def test_a_robot_may_leave_a_blocked_cell_but_not_enter_it() -> None:
    travel, grid = TravelCosts(), GridMap(1, 3)
    travel.set_map(grid, frozenset({1}), {}, 0)
    assert travel.metres(1, 2) == 1.0
    assert travel.metres(2, 1) == float("inf")
    assert travel.metres(0, 2) == float("inf")


def test_the_queue_with_the_earliest_end_gets_the_task() -> None:
    travel, grid = TravelCosts(), GridMap()
    travel.set_map(grid, frozenset(), {}, 0)
    profile = RobotProfile(speed=1.0)
    queues = [RobotQueue("Robot1", profile, 0, 50.0), RobotQueue("Robot2", profile, 63, 10.0)]
    tasks = [Task(n, Order((Stop(Action.GO, (cell,)),)), "", "", 0.0, 0.0) for n, cell in ((1, 1), (2, 62))]
    inserted = Queues(travel, 1).insert(tasks, queues)
    assert {task.number: robot for task, robot in inserted} == {1: "Robot1", 2: "Robot2"}


def test_the_sum_of_all_ways_is_the_least() -> None:
    """By hand: 3 + 1 cells; the nearest task for A first would cost 1 + 5."""
    travel, grid = TravelCosts(), GridMap(1, 10)
    travel.set_map(grid, frozenset(), {}, 0)
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    robots = [FreeRobot("A", 3, RobotProfile(), None), FreeRobot("B", 5, RobotProfile(), None)]
    tasks = [Task(n, Order((Stop(Action.GO, (cell,)),)), "", "", 0.0, 0.0) for n, cell in ((1, 4), (2, 0))]
    chosen = {choice.robot: choice.task.number for choice in assigner.choose(tasks, robots, 0.0)}
    assert chosen == {"A": 2, "B": 1}


def test_hundreds_of_robots_get_tasks_in_one_call() -> None:
    """All robots get one task each, no two the same."""
    travel, grid = TravelCosts(), GridMap(20, 60)
    travel.set_map(grid, frozenset(), {}, 0)
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    profile = RobotProfile()
    robots = [FreeRobot(f"R{n}", 2 * n, profile, 0.9) for n in range(600)]
    tasks = [Task(n, Order((Stop(Action.GO, (n % 100 * 12,)),)), "", "", 0.0, 0.0) for n in range(700)]
    chosen = assigner.choose(tasks, robots, 0.0, (5, 6))
    assert len({choice.robot for choice in chosen}) == len({choice.task.number for choice in chosen}) == 600


def test_robots_with_profiles_of_their_own_have_their_turns() -> None:
    """Each was compared with each task in one step: with 1000 robots that took half a minute."""
    travel, grid = TravelCosts(), GridMap(20, 60)
    travel.set_map(grid, frozenset(), {}, 0)
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    robots = {
        f"R{n}": FreeRobot(f"R{n}", 2 * n, RobotProfile(capacity=60 + n, payload=n % 3), None)
        for n in range(400)
    }
    tasks = {
        n: Task(n, Order((Stop(Action.GO, (n % 100 * 12,)),), payload=1.0), "", "", 0.0, 0.0)
        for n in range(500)
    }
    turns = 0
    for turns in range(1, 20):  # noqa: B007 - their number counts
        chosen = assigner.choose([*tasks.values()], [*robots.values()], 0.0)
        assert len(chosen) <= 100
        for choice in chosen:
            del robots[choice.robot], tasks[choice.task.number]
        if all(robot.profile.payload < 1 for robot in robots.values()):
            break
    assert len(robots) == 134, "some robots that can do tasks got none"
    assert turns > 2


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


def test_robots_leave_for_no_cell_of_another_floor(hungry: Floor) -> None:
    hungry.book.emit(Places(chargers=(56,), parking=(7,)), "places", hungry.now)
    hungry.add("Robot1", 0, battery=0.2)
    hungry.add("Robot2", 20, battery=0.9)
    hungry.run(8)
    assert hungry.dispatcher.goals() == {"Robot1": 56, "Robot2": 7}
    hungry.dispatcher.leave_floor()
    assert hungry.dispatcher.goals() == {}


def _let_die(floor: Floor, robot: RobotFacts) -> None:
    """Let a person say that a robot lies dead on the floor."""
    robot.state, robot.mode, robot.away_since = "dead", "dead", floor.now  # away: the floor does not move it
    floor.book.emit(RobotEntry(robot.id, mode="dead"), "dead", floor.now)


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_charger_under_a_dead_robot_is_left_to_it(hungry: Floor, when: str) -> None:
    """An idle robot goes to another charger, also if the other one died after it had been chosen."""
    hungry.book.emit(Places(chargers=(56, 63)), "places", hungry.now)
    dead, robot = hungry.add("Robot1", 56, battery=0.97), hungry.add("Robot2", 24, battery=0.3)
    if when == "before":
        _let_die(hungry, dead)
    hungry.run(2)
    assert (hungry.dispatcher.chargers.charging == {"Robot2": 56}) == (when == "after")
    _let_die(hungry, dead)
    hungry.run(20)
    assert (robot.cell, hungry.dispatcher.activity("Robot2")) == (63, "charging")


def test_a_robot_without_a_charger_says_why(hungry: Floor) -> None:
    robot = hungry.add("Robot1", 0, battery=0.3)
    _let_die(hungry, hungry.add("Robot2", 56))
    hungry.run(3)
    assert hungry.dispatcher.chargers.waiting == {"Robot1": "no charger is free; Robot2 stands at 56"}
    del hungry.facts.robots["Robot2"]
    hungry.facts.shut, hungry.facts.map_revision = frozenset({1, 8}), 1
    hungry.run(3)
    assert hungry.dispatcher.chargers.waiting == {
        "Robot1": "no path leads Robot1 to a charger that is free (cells 56)"
    }
    hungry.facts.shut, hungry.facts.map_revision = frozenset(), 2
    hungry.run(20)
    assert robot.cell == 56


@pytest.mark.parametrize("why", ["shut", "unreachable", "stuck"])
def test_a_charger_that_is_not_reached_is_given_up(hungry: Floor, why: str) -> None:
    """It is blocked, the planner finds no path to it, or the robot does not get on: another one is chosen."""
    hungry.book.emit(Places(chargers=(56, 63)), "places", hungry.now)
    robot = hungry.add("Robot1", 0, battery=0.3)
    hungry.run(2)
    assert hungry.dispatcher.chargers.charging == {"Robot1": 56}
    if why == "shut":
        hungry.facts.shut, hungry.facts.map_revision = frozenset({56}), 1
        hungry.run(3)
    else:
        robot.away_since = hungry.now  # the floor does not move it
        if why == "unreachable":
            robot.state = "unreachable"
        hungry.run(25 if why == "unreachable" else 125)
    assert hungry.dispatcher.chargers.charging == {"Robot1": 63}


def test_a_charger_in_a_zone_is_not_for_each_robot(hungry: Floor) -> None:
    """The nearest charger is in a zone that this robot may not enter."""
    hungry.book.emit(Places(chargers=(2, 63)), "places", hungry.now)
    hungry.book.emit(Zone("dock", "blocked", (2,), robots=("Robot1",)), "zone", hungry.now)
    hungry.add("Robot1", 0, battery=0.3)
    hungry.run(2)
    assert hungry.dispatcher.chargers.charging == {"Robot1": 63}


def test_a_sufficient_robot_leaves_the_charger_that_is_left(hungry: Floor) -> None:
    """A charger under a dead robot does not count as free for an empty one."""
    hungry.book.emit(Places(chargers=(56, 63)), "places", hungry.now)
    _let_die(hungry, hungry.add("Robot1", 63))
    hungry.add("Robot2", 56, battery=0.45)
    hungry.run(1)
    hungry.add("Robot3", 40, battery=0.1)
    hungry.run(2)
    assert hungry.dispatcher.chargers.charging == {"Robot3": 56}


def test_a_charge_stop_avoids_a_charger_under_a_dead_robot(hungry: Floor) -> None:
    hungry.book.emit(Places(chargers=(56, 63)), "places", hungry.now)
    dead, robot = hungry.add("Robot1", 56, battery=0.97), hungry.add("Robot2", 24, battery=0.3)
    task = hungry.book.create(Order((Stop(Action.CHARGE),), robot="Robot2"), hungry.now)
    hungry.run(2)
    assert hungry.task(task).target == 56
    _let_die(hungry, dead)
    hungry.run(20)
    assert robot.cell == 63


@pytest.mark.parametrize("why", ["dead", "shut", "removed", "taken"])
def test_a_parking_place_that_is_lost_is_given_up(floor: Floor, why: str) -> None:
    floor.book.emit(Places(parking=(6, 56)), "places", floor.now)
    robot = floor.add("Robot1", 3)
    floor.run(7)
    assert floor.dispatcher.goals() == {"Robot1": 6}
    if why == "dead":
        _let_die(floor, floor.add("Robot2", 6))
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


def test_a_full_robot_leaves_its_charger_without_a_parking_place(hungry: Floor) -> None:
    """All parking places are occupied: it waits beside the charger."""
    hungry.book.emit(Places(chargers=(56,), parking=(7,)), "places", hungry.now)
    hungry.add("Robot1", 7, battery=0.97)
    robot = hungry.add("Robot2", 56, battery=0.97)
    hungry.run(10)
    assert robot.cell not in (7, 56)


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
