"""Batteries and chargers."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest

from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.energy import BatteryLevels, effort_of, share_needed
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import Places, RobotEntry, RobotProfile, Zone
from rce_fleet.tasks.task import Task, TaskState
from rce_fleet.tasks.travel import TravelCosts

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
    assert hungry.task(task).reason == "no path leads from its last stop to a charger (cell 56)"


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


@pytest.mark.parametrize("charges", [False, True])
def test_a_queue_takes_no_task_beyond_the_battery(hungry: Floor, *, charges: bool) -> None:
    """The present task leaves 36 % of the battery; the far one was shown as assigned, with an end."""
    hungry.add("Robot1", 40, battery=0.4)
    stops = (Stop(Action.CHARGE if charges else Action.GO, (44,), 300.0),)
    hungry.book.create(Order(stops), hungry.now)
    hungry.run(10)
    near, far = hungry.go(45), hungry.go(7)
    hungry.run(3)
    assert hungry.task(near).state is TaskState.ASSIGNED
    assert hungry.task(far).state is (TaskState.ASSIGNED if charges else TaskState.QUEUED)
    assert ("enough energy for it now" in hungry.task(far).reason) is not charges


def test_a_charge_stop_goes_to_a_charger(hungry: Floor) -> None:
    robot = hungry.add("Robot1", 0, battery=0.2)
    task = hungry.book.create(Order((Stop(Action.CHARGE), Stop(Action.GO, (5,)))), hungry.now)
    hungry.run(12)
    assert (robot.cell, hungry.task(task).target) == (56, 56)
    robot.battery = 0.97
    hungry.run_until_ended(task)


@pytest.mark.parametrize(("watts", "seconds"), [(30.0, 90.0), (60.0, 45.0), (10.0, inf)])
def test_a_task_that_charges_says_when_the_battery_is_full(watts: float, seconds: float) -> None:
    """0.75 Wh are lacking; the robot itself takes 10 W. How long it has charged counts by its battery."""
    profile = replace(HUNGRY, charging=watts + 10.0 if seconds < inf else watts, idle=10.0)
    floor = Floor(rules=TaskRules(profile=profile))
    floor.book.emit(Places(chargers=(56,)), "places", floor.now)
    floor.add("Robot1", 57, battery=0.2)
    task = floor.book.create(Order((Stop(Action.CHARGE), Stop(Action.GO, (60,)))), floor.now)
    ends = []
    for _ in range(2):
        floor.run(50)
        assert floor.task(task).action is not None
        ends.append(floor.dispatcher.expected_end(floor.task(task), floor.now))
    expected = floor.now + seconds + 4 / profile.speed
    assert ends == ([None] * 2 if seconds == inf else pytest.approx([expected - 50, expected]))


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


def test_robots_leave_for_no_cell_of_another_floor(hungry: Floor) -> None:
    hungry.book.emit(Places(chargers=(56,), parking=(7,)), "places", hungry.now)
    hungry.add("Robot1", 0, battery=0.2)
    hungry.add("Robot2", 20, battery=0.9)
    hungry.run(8)
    assert hungry.dispatcher.goals() == {"Robot1": 56, "Robot2": 7}
    hungry.dispatcher.leave_floor()
    assert hungry.dispatcher.goals() == {}


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_charger_under_a_dead_robot_is_left_to_it(hungry: Floor, when: str) -> None:
    """An idle robot goes to another charger, also if the other one died after it had been chosen."""
    hungry.book.emit(Places(chargers=(56, 63)), "places", hungry.now)
    dead, robot = hungry.add("Robot1", 56, battery=0.97), hungry.add("Robot2", 24, battery=0.3)
    if when == "before":
        hungry.let_die(dead)
    hungry.run(2)
    assert (hungry.dispatcher.chargers.charging == {"Robot2": 56}) == (when == "after")
    hungry.let_die(dead)
    hungry.run(20)
    assert (robot.cell, hungry.dispatcher.activity("Robot2")) == (63, "charging")


def test_a_robot_without_a_charger_says_why(hungry: Floor) -> None:
    robot = hungry.add("Robot1", 0, battery=0.3)
    hungry.let_die(hungry.add("Robot2", 56))
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
    hungry.let_die(hungry.add("Robot1", 63))
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
    hungry.let_die(dead)
    hungry.run(20)
    assert robot.cell == 63


def test_a_full_robot_leaves_its_charger_without_a_parking_place(hungry: Floor) -> None:
    """All parking places are occupied: it waits beside the charger."""
    hungry.book.emit(Places(chargers=(56,), parking=(7,)), "places", hungry.now)
    hungry.add("Robot1", 7, battery=0.97)
    robot = hungry.add("Robot2", 56, battery=0.97)
    hungry.run(10)
    assert robot.cell not in (7, 56)
