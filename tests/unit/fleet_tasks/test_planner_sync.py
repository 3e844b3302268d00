"""Modes, zones and blocked cells that people change by the API or at the planner, and restarts of both."""

from __future__ import annotations

from dataclasses import replace
from math import inf, pi
from types import SimpleNamespace

import pytest
from support.planner_copy import RUN, SPILL, Both

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.limits import MOST_LIFETIME
from rce_fleet.manager.convert import show_profile
from rce_fleet.manager.planner_sync import (
    CELLS_DELAY_S,
    BlockCell,
    SetMode,
    SetZone,
)
from rce_fleet.manager.zones import checked, read_zone, zone_fields
from rce_fleet.nodes.zone_messages import read_zone as read_by_planner
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.energy import effort_of
from rce_fleet.tasks.facts import FleetFacts, RobotFacts
from rce_fleet.tasks.loads import settle_load
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import (
    FleetEntry,
    GoalEntry,
    Places,
    PlannerRun,
    RobotEntry,
    RobotProfile,
    Zone,
)
from rce_fleet.tasks.task import TaskState
from rce_fleet.tasks.travel import TravelCosts
from rce_fleet.tasks.zone_costs import zone_profiles


def test_what_the_api_changed_goes_to_the_planner() -> None:
    both = Both()
    both.book.emit(RobotEntry("Robot1", "paused", reason="tea", user="bob"), "paused", both.now)
    both.book.emit(SPILL, "zone", both.now)
    assert both.step() == [SetMode("Robot1", "paused", "tea", "bob"), SetZone("spill", SPILL)]
    assert both.step() == []
    both.book.emit(replace(SPILL, is_removed=True), "zone removed", both.now)
    assert both.step() == [SetZone("spill", None)]
    assert (both.step(), both.facts.zones) == ([], {})


def test_what_the_planner_was_told_is_adopted() -> None:
    both = Both()
    both.facts.robots["Robot1"].mode = "manual"
    both.facts.robots["Robot1"].mode_reason = "by carl"
    both.facts.mode = "paused"
    both.facts.zones["spill"] = SPILL
    both.facts.requested = frozenset({9})
    assert both.step() == []
    assert (both.mode(), both.book.entry("Robot1").reason) == ("manual", "by carl")
    assert (both.book.fleet.mode, both.book.zones["spill"].reason) == ("paused", "oil")
    assert both.book.blocked.cells == (9,)
    both.facts.robots["Robot1"].mode = both.facts.mode = "automatic"
    both.facts.zones.clear()
    both.facts.requested = frozenset()
    assert both.step() == []
    assert (both.mode(), both.book.fleet.mode, both.book.zones) == ("automatic", "automatic", {})
    assert not both.book.blocked.cells


def test_a_restarted_planner_gets_everything_again() -> None:
    both = Both()
    both.facts.zones["spill"], both.facts.mode, both.facts.requested = SPILL, "stopped", frozenset({9})
    both.facts.robots["Robot1"].mode = "dead"
    both.step()
    both.facts.zones, both.facts.mode = {}, "automatic"
    both.facts.robots["Robot1"].mode = "automatic"
    both.sync.begin(replace(RUN, started="2.0"), both.now)
    assert both.facts.requested == frozenset()
    calls = both.step()
    assert {type(call) for call in calls} == {SetMode, SetZone, BlockCell}
    assert (both.facts.mode, both.facts.robots["Robot1"].mode) == ("stopped", "dead")
    assert (set(both.facts.zones), both.facts.requested) == ({"spill"}, frozenset({9}))
    assert both.step() == []


def test_a_restarted_manager_sees_what_changed() -> None:
    """While it was away a person freed a cell and paused a robot at the same planner."""
    first = Both()
    first.facts.zones["spill"], first.facts.requested = SPILL, frozenset({9})
    first.step()
    again = Both(first.book)
    again.facts.robots["Robot1"].mode = "paused"
    assert again.step() == []
    assert (again.mode(), again.book.zones, again.book.blocked.cells) == ("paused", {}, ())


@pytest.mark.parametrize("is_told", [True, False])
def test_a_request_not_sent_before_a_kill_is_sent(is_told: bool) -> None:
    """The manager was killed after it accepted; changes at the planner do not undo what it was not told."""
    first = Both()
    first.book.emit(RobotEntry("Robot1", "paused", unsent=True), "paused", first.now)
    first.book.emit(replace(SPILL, unsent=True), "zone", first.now)
    if is_told:
        first.step()
        for record in first.sync.confirmed():
            first.book.put_record(record)
    assert first.sync.confirmed() == []
    again = Both(first.book)
    calls = again.step()
    assert len(calls) == (0 if is_told else 2)
    assert (again.mode(), set(again.book.zones)) == (
        ("automatic", set()) if is_told else ("paused", {"spill"})
    )


@pytest.mark.parametrize("blocked", [True, False])
@pytest.mark.parametrize("is_told", [True, False])
def test_a_cell_not_sent_before_a_kill_is_sent(is_told: bool, blocked: bool) -> None:
    """The manager was killed after it accepted; the planner went on, and people undid it there."""
    first = Both()
    first.facts.requested = frozenset() if blocked else frozenset({9})
    first.step()
    asked = first.book.blocked.changed({9: blocked}, unsent=True)
    first.book.emit(asked, "blocked" if blocked else "freed", first.now)
    if is_told:
        assert first.step() == [BlockCell(9, blocked)]
        for record in first.sync.confirmed():
            first.book.put_record(record)
        assert first.book.blocked.unsent == ()
    assert first.sync.confirmed() == []
    again = Both(first.book)
    again.facts.requested = frozenset() if blocked else frozenset({9})
    assert again.step() == ([] if is_told else [BlockCell(9, blocked)])
    assert (9 in again.book.blocked.cells) == (blocked is not is_told)


def test_a_late_list_of_cells_undoes_no_request() -> None:
    """The planner's list comes seconds after its answer; a second request in between is sent as well."""
    both = Both()
    late = both.facts.requested
    for blocked in (True, False, True):
        both.book.emit(both.book.blocked.changed({9: blocked}, unsent=True), "cell", both.now)
        assert both.step(0.5) == [BlockCell(9, blocked)]
        both.facts.requested = late
    assert (both.step(2.0), both.book.blocked.cells) == ([], (9,))
    both.facts.requested = frozenset({9})
    assert (both.step(10.0), both.book.blocked.cells) == ([], (9,))
    both.facts.requested = frozenset()
    assert (both.step(), both.book.blocked.cells) == ([], ())


def test_another_grid_forgets_unsent_cells() -> None:
    first = Both()
    first.step()
    first.book.emit(first.book.blocked.changed({9: True}, unsent=True), "blocked", first.now)
    again = Both(first.book, PlannerRun("2.0", "16 x 16"))
    assert (again.step(), again.book.blocked.cells) == ([], ())


def test_a_zone_removed_before_a_kill_stays_removed() -> None:
    first = Both()
    first.facts.zones["spill"] = SPILL
    first.step()
    gone = replace(SPILL, is_removed=True, unsent=True)
    first.book.emit(gone, "zone removed", first.now)
    again = Both(first.book)
    again.facts.zones["spill"] = SPILL
    assert again.step() == [SetZone("spill", None)]
    assert again.sync.confirmed() == [replace(gone, unsent=False)]
    assert (again.facts.zones, again.book.zones) == ({}, {})


def test_the_fleets_mode_hides_a_robots_own() -> None:
    both = Both()
    both.book.emit(FleetEntry("paused"), "paused", both.now)
    both.step()
    both.facts.robots["Robot1"].mode = "paused"
    assert (both.step(), both.mode()) == ([], "automatic")
    both.book.emit(RobotEntry("Robot1", "out_of_service"), "taken out", both.now)
    assert [call.mode for call in both.step() if isinstance(call, SetMode)] == ["out_of_service"]


def test_a_robot_that_joins_again_keeps_its_mode() -> None:
    both = Both()
    both.facts.robots["Robot1"].mode = "paused"
    both.step()
    robot = both.facts.robots.pop("Robot1")
    assert (both.step(), both.mode()) == ([], "paused")
    robot.mode = "automatic"
    both.facts.robots["Robot1"] = robot
    assert [call.mode for call in both.step() if isinstance(call, SetMode)] == ["paused"]


def test_a_refused_zone_is_sent_again_later() -> None:
    both = Both()
    both.book.emit(SPILL, "zone", both.now)
    assert len(both.step(refused=True)) == 1
    assert both.step() == []
    assert len(both.step(20.0)) == 1


def test_a_cell_that_is_still_occupied_is_blocked_once() -> None:
    both = Both()
    both.facts.requested = frozenset({9})
    both.step()
    both.facts.requested, both.facts.pending = frozenset(), frozenset({9})
    assert (both.step(), both.book.blocked.cells) == ([], (9,))


@pytest.mark.parametrize("silent", [0.0, 60.0])
def test_a_cell_stays_blocked_when_its_robot_leaves(silent: float) -> None:
    """The planner's list has it seconds later than its state; the planner may be silent meanwhile."""
    both = Both()
    both.book.emit(both.book.blocked.changed({9: True}, unsent=True), "blocked", both.now)
    both.sync.adopt(both.now)
    for call in both.sync.calls(both.now):
        both.sync.took(call, both.now, refused=False)
    both.facts.pending = both.facts.shut = frozenset({9})
    assert (both.step(CELLS_DELAY_S + 1), both.book.blocked.cells) == ([], (9,))
    if silent:
        both.facts.is_live = False
        both.step(silent)
        both.facts.is_live = True
    both.facts.pending = frozenset()
    for _ in range(4):
        assert (both.step(0.5), both.book.blocked.cells) == ([], (9,))
    both.facts.requested = frozenset({9})
    assert (both.step(20.0), both.book.blocked.cells) == ([], (9,))
    both.facts.requested = frozenset()
    assert (both.step(), both.book.blocked.cells) == ([], ())


@pytest.mark.parametrize("is_shut", [False, True])
def test_a_cell_freed_when_its_robot_left_is_adopted(is_shut: bool) -> None:
    """Also if sensors keep it blocked: the list does not have it in time."""
    both = Both()
    both.facts.requested = frozenset({9})
    both.step()
    both.facts.pending, both.facts.shut = frozenset({9}), frozenset({9})
    both.step()
    both.facts.requested = both.facts.pending = frozenset()
    both.facts.shut = frozenset({9} if is_shut else ())
    both.step(1.0)
    assert both.book.blocked.cells == ((9,) if is_shut else ())
    assert (both.step(CELLS_DELAY_S), both.book.blocked.cells) == ([], ())


def test_another_grid_brings_the_planners_zones() -> None:
    both = Both()
    both.facts.zones["spill"] = SPILL
    both.step()
    both.facts.zones["spill"] = replace(SPILL, cells=(20, 21, 22))
    assert "another grid" in both.sync.begin(PlannerRun("2.0", "16 x 16"), both.now)
    assert both.step() == []
    assert both.book.zones["spill"].cells == (20, 21, 22)


@pytest.mark.parametrize(
    "zone",
    [
        replace(SPILL, edges=((5, 6),)),
        replace(SPILL, robots=("Robot2", "Robot1"), until=2000.0),
        Zone("ice", "slow", (3,), 0.2, robots=("Robot1",)),
        Zone("lane", "one_way", (3, 4), -pi / 2),
        Zone("lift", "limited", (3, 4), 2.0),
        Zone("mud", "cost", (3, 4), 2.5, robots=("Robot1",)),
    ],
)
def test_zones_are_the_same_after_the_wire(zone: Zone) -> None:
    kept = checked(zone, GridMap(), 1000.0)
    back = read_zone(zone_fields(kept, 1000.0), 1000.0)
    assert back == kept


def test_a_cost_zone_is_sent_to_the_planner() -> None:
    both = Both()
    both.book.emit(Zone("mud", "cost", (2,), 5.0), "zone", 0.0)
    (call,) = both.step()
    assert isinstance(call, SetZone)
    assert call.zone == both.book.zones["mud"]
    assert not both.step()


def test_ways_lead_around_a_robots_forbidden_cells() -> None:
    """Cells 1 and 9 are blocked for one robot only: on a floor of two rows no way is left for it."""
    grid = GridMap(2, 8)
    book = TaskBook()
    book.emit(Zone("shut", "blocked", (1, 9), robots=("Robot1",)), "zone", 0.0)
    book.emit(Zone("mud", "cost", (2,), 5.0), "zone", 0.0)
    facts = FleetFacts(robots={name: RobotFacts(name) for name in ("Robot1", "Robot2")})
    profiles = zone_profiles(book, facts, RobotProfile())
    assert profiles["Robot1"].zone_cost == {"mud": 5.0, "shut": inf}
    assert profiles["Robot2"].zone_cost == {"mud": 5.0}
    travel = TravelCosts()
    travel.set_map(grid, grid.blocked, book.zones, 0)
    task = book.create(Order((Stop(Action.GO, (3,)),)), 0.0)
    assert effort_of(task, 0, travel, profiles["Robot1"]).first == inf
    assert effort_of(task, 1, travel, profiles["Robot1"]).first < inf
    assert effort_of(task, 0, travel, profiles["Robot2"]).first == 5.0


@pytest.mark.parametrize(
    "zone",
    [
        Zone("aisle", "one_way", (1, 2, 3), 0.0, robots=("Robot1",)),
        Zone("aisle", "blocked", (), edges=((3, 2), (2, 1)), robots=("Robot1",)),
    ],
)
def test_ways_do_not_lead_against_a_robots_zone(zone: Zone) -> None:
    """Time and energy count the way around; of a robot that the zone is not for, the straight one."""
    book = TaskBook()
    book.emit(zone, "zone", 0.0)
    facts = FleetFacts(robots={name: RobotFacts(name) for name in ("Robot1", "Robot2")})
    profile = RobotProfile(zone_cost={"aisle": 1.5})
    profiles = zone_profiles(book, facts, profile)
    assert show_profile(profiles["Robot1"]).zone_cost == {}
    assert "Robot2" not in profiles
    travel, grid = TravelCosts(), GridMap(2, 8)
    travel.set_map(grid, grid.blocked, book.zones, 0)
    task = book.create(Order((Stop(Action.GO, (0,)),)), 0.0)
    for in_metres in (False, True):
        assert effort_of(task, 4, travel, profiles["Robot1"], in_metres=in_metres).first == 6.0
        assert effort_of(task, 4, travel, RobotProfile(), in_metres=in_metres).first == 4.0


def test_another_grid_holds_tasks_and_removes_places() -> None:
    """The cells that they name have other numbers there, or are none."""
    both = Both()
    book, go = both.book, (Stop(Action.GO, (3,)),)
    waiting = book.create(Order(go), both.now)
    loaded = book.create(Order((Stop(Action.PICK, (1,)), Stop(Action.DELIVER, (2,)))), both.now)
    loaded = replace(loaded, state=TaskState.RUNNING, robot="Robot1", position=1, loads=1, target=2)
    held = book.create(Order(go), both.now)
    returning = replace(loaded, number=9, state=TaskState.CANCELLING, robot="Robot2")
    done = replace(waiting, number=10, state=TaskState.DONE, order=Order(go, every=60.0), recurs_at=1e6)
    for task in (loaded, returning, done):
        book.put_record(task)
    book.hold(held.id, both.now)
    book.emit(Places((5,), (6,), (7,), 4), "places", both.now)
    book.emit(GoalEntry("Robot1", 6), "goal", both.now)
    both.sync.begin(PlannerRun("2.0", "16 x 16"), both.now)
    states = {task.id: task.state.value for task in book.tasks.values()}
    assert states == {"T1": "held", "T2": "held", "T3": "held", "T9": "failed", "T10": "done", "T11": "held"}
    assert (book.find("T2").robot, book.find("T2").target) == ("Robot1", None)
    assert all("another grid" in book.find(name).reason for name in ("T1", "T2", "T3", "T9", "T11"))
    assert (book.places, book.goals) == (Places(revision=5), {})
    names = [event.name for event in book.take_events()][-7:]
    assert names[-2:] == ["places", "planner"]
    both.sync.begin(PlannerRun("3.0", "16 x 16"), both.now)
    assert [event.name for event in book.take_events()] == ["planner"]


def test_a_begun_task_gets_cells_of_another_grid() -> None:
    """The stop that was made is in a cell that the smaller grid does not have."""
    both = Both()
    book = both.book
    stops = (Stop(Action.PICK, (40,)), Stop(Action.DELIVER, (50,)))
    task = book.create(Order(stops, return_cells=(3,)), both.now)
    book.put_record(replace(task, state=TaskState.RUNNING, robot="Robot1", position=1, loads=1, target=50))
    both.sync.begin(PlannerRun("2.0", "4 x 4"), both.now)
    book.grid = GridMap(4, 4)
    with pytest.raises(TaskRefusedError, match="cell 50 is not on the map of 16 cells"):
        book.change("T1", replace(task.order, priority=1), both.now)
    wanted = replace(task.order, stops=(stops[0], Stop(Action.DELIVER, (9,))))
    assert book.change("T1", wanted, both.now).order == wanted
    assert book.resume("T1", both.now).state is TaskState.RUNNING
    book.hold("T1", both.now)
    settled = settle_load(book, "T1", 5, both.now)
    assert [stop.cells for stop in settled.order.stops] == [(40,), (5,), (9,)]
    with pytest.raises(TaskRefusedError, match="cell 40 is not on the map of 16 cells"):
        book.create(wanted, both.now)


def test_a_task_names_cells_of_stops_that_come_again() -> None:
    stops = tuple(Stop(Action.GO, (cell,)) for cell in (1, 2, 3))
    order = Order(stops, rounds=2, return_cells=(7,))
    named = {made: list(order.cells(made)) for made in (0, 3, 4, 6)}
    assert named == {0: [1, 2, 3, 7], 3: [1, 2, 3, 7], 4: [2, 3, 7], 6: [7]}


def test_a_floor_of_an_earlier_release_is_the_same_turned_or_not() -> None:
    """Earlier releases wrote ``0 rad`` for every grid."""
    run = PlannerRun("2.0", "8 x 8 cells of 1 m at (0.0, 0.0), turned by 0.3 rad")
    assert not run.has_other_floor(PlannerRun("1.0", "8 x 8 cells of 1 m at (0.0, 0.0), 0 rad"))
    assert not run.has_other_floor(PlannerRun())
    assert run.has_other_floor(PlannerRun("1.0", "8 x 8 cells of 1 m at (1.0, 0.0), 0 rad"))
    assert run.has_other_floor(PlannerRun("1.0", run.floor.replace("0.3", "1.2")))


def test_the_planner_takes_zones_that_end_very_late() -> None:
    """The API allows an end in the year 5138; the planner ends the zone after its longest life."""
    zone = replace(SPILL, until=1e11)
    taken = read_by_planner(SimpleNamespace(**zone_fields(zone, 1000.0)), 50.0)  # type: ignore[arg-type]
    assert taken.expires == 50.0 + MOST_LIFETIME


def test_a_zone_of_the_planner_has_the_limits_of_the_api() -> None:
    """The planner's service takes longer reasons, and zones that live longer."""
    zone = zone_fields(Zone("ice", "slow", (3,), 0.2, reason="x" * 5000), 0.0)
    seen = read_zone({**zone, "lifetime": 1e300, "speed": 1e-320}, 0.0)
    assert (len(seen.reason), seen.until, seen.value) == (500, 1e11, 0.01)
