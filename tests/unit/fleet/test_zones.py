"""Zones: cells and moves that are blocked, slow zones, one-way zones, zones with room for a few robots."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import inf
from typing import TYPE_CHECKING, Any

import pytest

from rce_fleet.coordination import blocking
from rce_fleet.coordination.events import (
    CellBlocked,
    CellFreed,
    GoalSet,
    ModeSet,
    Reply,
    SendCells,
    Tick,
    ZonesSet,
)
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import PlanRequest, compute_plan
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.snapshot import RobotSnapshot, RobotState
from rce_fleet.coordination.zones import Direction, Zone, ZoneBook, ZoneKind
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.planner import JointPlan, PlanningProblem

if TYPE_CHECKING:
    from collections.abc import Callable

    from unit.fleet.conftest import SimulatedClients

    Make = Callable[[GridMap, list[int], list[int]], SimulatedClients]

LOOP = GridMap(3, 9, blocked=frozenset({10, 11, 12, 13, 14, 15, 16}))
"""A loop around a wall: rows 0 and 2, columns 0 and 8."""


@pytest.fixture(params=[24, 0], ids=["one by one", "for all"])
def make(request: pytest.FixtureRequest, make_fleet: type[SimulatedClients]) -> Make:
    """Makes a fleet whose paths are found one by one, or for all at once."""

    def of(grid: GridMap, starts: list[int], goals: list[int]) -> SimulatedClients:
        fleet = make_fleet(FleetPlanner(grid, FleetSettings(repairs=request.param)), starts, 1, loss=0.0)
        fleet.send(goals)
        return fleet

    return of


def robot(fleet: SimulatedClients, number: int = 1) -> RobotSnapshot:
    return fleet.planner.snapshot().robots[number - 1]


def put(fleet: SimulatedClients, *zones: Zone) -> None:
    reply = fleet.ask(ZonesSet(zones))
    assert reply.ok, reply.message


def blocked(name: str, *cells: int, **more: object) -> Zone:
    return Zone(name, ZoneKind.BLOCKED, cells, **more)  # type: ignore[arg-type]  # the fields of a zone


@pytest.mark.slow
def test_a_replaced_zone_blocks_its_new_cells(make: Make) -> None:
    """Also for single robots; a cell of two zones stays blocked until both are gone."""
    fleet = make(GridMap(), [], [])
    state = fleet.planner.state
    put(fleet, blocked("a", 1, 2), blocked("b", 2, 3), blocked("c", 8, 9, robots=("Robot1",)))
    put(fleet, blocked("a", 1, 4), blocked("c", 9, 10, robots=("Robot2",)))
    assert state.blocked == {1, 2, 3, 4}
    assert [zone and zone.id for zone in map(state.zones.blocks, range(6))] == [
        None,
        "a",
        "b",
        "b",
        "a",
        None,
    ]
    assert state.forbidden("Robot1") == frozenset()
    assert state.forbidden("Robot2") == {9, 10}
    assert fleet.ask(ZonesSet((), remove=("b",))).ok
    assert state.blocked == {1, 4}


@pytest.mark.slow
def test_a_blocked_zone_blocks_until_it_is_removed(make: Make) -> None:
    fleet = make(LOOP, [0], [8])
    put(fleet, blocked("spill", 6, reason="oil", by="anna"))
    assert not fleet.ask(CellFreed(6)).ok
    assert fleet.ask(GoalSet("Robot1", 6)).message == (
        "cell 6 is blocked by zone 'spill' (oil, by anna); choose another goal"
    )
    fleet.run(fleet.all_arrived)
    assert robot(fleet).replans == 1
    assert fleet.ask(ZonesSet((), remove=("spill",))).ok
    assert fleet.planner.state.blocked == set()


def test_a_zone_ends_when_it_expires(make: Make) -> None:
    fleet = make(LOOP, [0], [])
    put(fleet, blocked("short", 6, expires=fleet.now + 2.0))
    assert fleet.planner.state.blocked == {6}
    fleet.run(lambda: not fleet.planner.state.zones.zones)
    assert fleet.planner.state.blocked == set()
    assert fleet.planner.state.zones.revision == 2


def test_a_cell_stays_blocked_for_its_other_reasons(make: Make) -> None:
    fleet = make(LOOP, [0], [])
    put(fleet, blocked("one", 5, 6), blocked("two", 6, 7))
    assert fleet.ask(CellBlocked(7)).ok
    assert fleet.ask(ZonesSet((), remove=("one", "two"))).ok
    assert fleet.planner.state.blocked == {7}
    assert fleet.ask(CellFreed(7)).ok
    assert fleet.planner.state.blocked == set()


@pytest.mark.slow
def test_a_zone_for_one_robot_leaves_the_way_to_others(make: Make) -> None:
    fleet = make(LOOP, [0, 18], [8, 7])
    put(fleet, blocked("narrow", 6, robots=("Robot1",)))
    fleet.run(lambda: len(robot(fleet).plan) > 5)
    assert 6 not in robot(fleet).plan
    assert not fleet.ask(GoalSet("Robot1", 6)).ok
    fleet.run(fleet.all_arrived)
    assert fleet.ask(GoalSet("Robot2", 6)).ok
    fleet.run(fleet.all_arrived)


@pytest.mark.slow
def test_robots_keep_to_the_direction_of_a_one_way_zone(make: Make) -> None:
    """Rows 0 and 2 are a roundabout: the short way back is closed."""
    fleet = make(LOOP, [0], [5])
    put(
        fleet,
        Zone("out", ZoneKind.ONE_WAY, tuple(range(9)), direction=Direction.PLUS_X),
        Zone("back", ZoneKind.ONE_WAY, tuple(range(18, 27)), direction=Direction.MINUS_X),
    )
    fleet.run(fleet.all_arrived)
    assert fleet.ask(GoalSet("Robot1", 3)).ok
    fleet.tell(Tick())
    fleet.tell(Tick())
    assert robot(fleet).plan[:2] == (5, 6)
    assert len(robot(fleet).plan) == 19
    fleet.run(fleet.all_arrived)


def test_a_one_way_zone_may_reach_the_edge_of_the_map(make: Make) -> None:
    """No move wraps around into the next row, or leaves the map."""
    fleet = make(GridMap(2, 3), [0], [])
    put(
        fleet,
        Zone("x", ZoneKind.ONE_WAY, (0, 2, 3, 5), direction=Direction.MINUS_X),
        Zone("y", ZoneKind.ONE_WAY, (1, 4), direction=Direction.PLUS_Y),
    )
    closed = fleet.planner.state.zones.closed(fleet.grid)
    assert closed == {(0, 1), (1, 2), (3, 4), (4, 5), (4, 1)}
    assert fleet.ask(GoalSet("Robot1", 3)).ok
    fleet.run(fleet.all_arrived)


@pytest.mark.slow
def test_a_blocked_move_is_blocked_in_one_direction(make: Make) -> None:
    fleet = make(LOOP, [4], [])
    put(fleet, Zone("step", ZoneKind.BLOCKED, edges=((4, 5),)))
    assert fleet.ask(GoalSet("Robot1", 6)).ok
    fleet.run(fleet.all_arrived)
    assert robot(fleet).replans == 0
    assert fleet.ask(GoalSet("Robot1", 4)).ok
    fleet.tell(Tick())
    assert robot(fleet).plan == (6, 5, 4)


def test_a_slow_zone_limits_the_speed_and_is_avoided(make: Make) -> None:
    fleet = make(LOOP, [4], [])
    put(fleet, Zone("ramp", ZoneKind.SLOW, (5, 6, 7), speed=0.1))
    out = [*fleet.tell(GoalSet("Robot1", 7)), *fleet.tell(Tick())]
    sent = [done for done in out if isinstance(done, SendCells)][-1]
    assert (sent.cells[0], sent.speed) == (4, 0.1 if 5 in sent.cells else inf)
    fleet.run(fleet.all_arrived)
    assert fleet.planner.state.zones.speed_limit("Robot1", [7]) == 0.1


@pytest.mark.slow
def test_a_limited_zone_has_room_for_its_capacity(make: Make) -> None:
    """Two robots want into an area with room for one; the second waits until the first has left."""
    fleet = make(LOOP, [0, 18], [])
    area = (6, 7, 8, 17, 26, 25, 24)
    put(fleet, Zone("lift", ZoneKind.LIMITED, area, capacity=1))
    for name, goal in (("Robot1", 7), ("Robot2", 25)):
        assert fleet.ask(GoalSet(name, goal)).ok
    inside: list[int] = []

    def one_is_there() -> bool:
        claims = [fleet.planner.state.ledger.claims(name) for name in fleet.robots]
        inside.append(sum(1 for cells in claims if not cells.isdisjoint(area)))
        return RobotState.ARRIVED in fleet.states()

    fleet.run(one_is_there)
    first = fleet.states().index(RobotState.ARRIVED)
    assert fleet.ask(GoalSet(f"Robot{first + 1}", (1, 19)[first])).ok
    fleet.run(lambda: one_is_there() and fleet.states()[1 - first] is RobotState.ARRIVED)
    assert max(inside) == 1


def test_the_same_zone_twice_changes_nothing(make: Make) -> None:
    fleet = make(LOOP, [0], [])
    put(fleet, blocked("a", 5))
    put(fleet, blocked("a", 5))
    assert fleet.planner.state.zones.revision == 1
    assert fleet.ask(ZonesSet((blocked("b", 6),), revision=0)).message == (
        "the zones have revision 1, not 0: read them and try again"
    )
    assert fleet.ask(ZonesSet((blocked("b", 6),), replace=True, revision=1)).ok
    assert set(fleet.planner.state.zones.zones) == {"b"}
    assert fleet.planner.state.blocked == {6}


@pytest.mark.parametrize(
    ("zone", "message"),
    [
        (blocked("", 1), "a zone needs an id"),
        (blocked("a"), "zone 'a' has no cells"),
        (blocked("a", 27), r"zone 'a': cells \[27\] are not on the map of 27 cells"),
        (blocked("a", *range(20, 50)), r"cells \[27, 28, 29, 30, 31\] and 18 more are not on the map"),
        (blocked("a", edges=((0, 2),)), "are not neighbours"),
        (Zone("a", ZoneKind.SLOW, (1,)), "needs 0.01 .. 100 m/s, not 0.0"),
        (Zone("a", ZoneKind.SLOW, (1,), speed=1e-320), "needs 0.01 .. 100 m/s, not 1e-320"),
        (Zone("a", ZoneKind.LIMITED, (1,), capacity=2**31 - 1), "capacity of 1 .. 1000000, not 2147483647"),
        (Zone("a", ZoneKind.ONE_WAY, (1,)), "needs a direction"),
        (Zone("a", ZoneKind.LIMITED, (1,)), "capacity of 1 .. 1000000, not 0"),
        (Zone("a", ZoneKind.COST, (1,)), "a metre counts 1 .. 1e.06, not 0.0"),
        (Zone("a", ZoneKind.COST, (1,), cost=float("nan")), "not nan"),
        (Zone("a", ZoneKind.SLOW, (1,), ((0, 1),), speed=1.0), "only a blocked zone has edges"),
    ],
)
def test_a_zone_that_cannot_be_is_refused(zone: Zone, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        zone.check(LOOP)


def test_too_many_zones_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that makes a new one each minute must not stop the planner after some weeks."""
    monkeypatch.setattr(blocking, "MOST_ZONES", 2)
    planner = FleetPlanner(LOOP)

    def put_some(*names: str, **more: Any) -> Reply:
        event = ZonesSet(tuple(blocked(name, 1) for name in names), **more)
        return next(one for one in planner.handle(event, 0.0) if isinstance(one, Reply))

    assert put_some("a", "b").ok
    assert put_some("c") == Reply(False, "there can be 2 zones, not 3: remove some")
    assert put_some("a").ok
    assert put_some("c", remove=("a",)).ok
    assert put_some("d", "e", replace=True).ok
    assert set(planner.state.zones.zones) == {"d", "e"}


def test_the_slowest_zone_has_a_cost() -> None:
    """A planner takes no such zone any more; its costs are finite all the same."""
    book = ZoneBook()
    book.put([Zone("a", ZoneKind.SLOW, (1,), speed=1e-320), Zone("b", ZoneKind.SLOW, (2,), speed=100.0)])
    assert book.costs() == {1: 20}


def test_costs_are_shared_by_robots_with_the_same_zones() -> None:
    book = ZoneBook()
    book.put(
        [
            Zone("all", ZoneKind.COST, (1,), cost=2.5),
            Zone("two", ZoneKind.SLOW, (1, 2), robots=("A", "B"), speed=0.1),
            Zone("none", ZoneKind.COST, (3,), robots=("C",), cost=1.0),
        ]
    )
    assert book.costs() == book.costs_of("C") == {1: 3}
    assert book.costs_of("A") == {1: 5, 2: 5}
    assert book.costs_of("A") is book.costs_of("B")
    assert book.costs_of("C") is book.costs()
    book.put([], ["two"])
    assert book.costs_of("A") == {1: 3}


def test_own_costs_of_a_robot_replace_those_of_zones() -> None:
    """Zones of the same costs share one object, and a zone that comes later counts too."""
    book = ZoneBook()
    ramp = Zone("ramp", ZoneKind.COST, (1, 2), cost=2.0)
    book.put([ramp, Zone("gate", ZoneKind.LIMITED, (3,), capacity=1)])
    assert book.set_own_costs({"A": {"ramp": 1.0}, "B": {"gate": 3.5, "wet": 4.0}, "C": {"ramp": 1e6}})
    assert not book.set_own_costs({"A": {"ramp": 1.0}, "B": {"gate": 3.5, "wet": 4.0}, "C": {"ramp": 1e6}})
    assert (book.costs_of("A"), book.costs_of("C")) == ({}, {1: 20, 2: 20})
    assert book.costs_of("B") == {1: 2, 2: 2, 3: 4}
    assert book.costs_of("D") is book.costs()
    book.put([Zone("wet", ZoneKind.COST, (4,), cost=1.0)])
    assert (book.costs_of("B")[4], book.costs_of("D")) == (4, {1: 2, 2: 2})
    assert book.set_own_costs({"A": {"ramp": 2.0}})
    assert book.costs_of("A") is book.costs_of("B") is book.costs()


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        FleetSettings(repairs=24),
        FleetSettings(repairs=1),
        FleetSettings(repairs=0),
        FleetSettings(repairs=0, quarter_turn=1.0, stop=0.5),
        FleetSettings(planner="dijkstra"),
    ],
    ids=["one by one", "beside", "for all", "with turns", "dijkstra"],
)
@pytest.mark.parametrize(
    "zone",
    [
        Zone("z", ZoneKind.SLOW, (3, 4, 5), robots=("Robot1",), speed=0.1),
        Zone("z", ZoneKind.COST, (3, 4, 5), robots=("Robot1",), cost=5.0),
    ],
    ids=["slow", "cost"],
)
def test_zone_for_one_robot_costs_only_this_one(
    make_fleet: type[SimulatedClients], settings: FleetSettings, zone: Zone
) -> None:
    """The other one's short way leads through it."""
    fleet = make_fleet(FleetPlanner(LOOP, settings), [9, 1], 1, loss=0.0)
    fleet.send([])
    fleet.run(lambda: len(fleet.planner.snapshot().robots) == 2)
    put(fleet, zone)
    for name, goal in (("Robot1", 8), ("Robot2", 7)):
        assert fleet.ask(GoalSet(name, goal)).ok
    fleet.run(lambda: len(robot(fleet, 1).plan) > 5 and len(robot(fleet, 2).plan) > 3)
    assert 22 in robot(fleet, 1).plan
    assert 4 in robot(fleet, 2).plan
    fleet.run(fleet.all_arrived)


SETTINGS = {
    "one by one": FleetSettings(repairs=24),
    "beside": FleetSettings(repairs=1),
    "for all": FleetSettings(repairs=0),
    "with turns": FleetSettings(repairs=0, quarter_turn=1.0, stop=0.5),
    "dijkstra": FleetSettings(planner="dijkstra", resolve_deadlocks=True),
}


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS.values(), ids=list(SETTINGS))
def test_moves_are_closed_for_one_robot_only(
    make_fleet: type[SimulatedClients], settings: FleetSettings
) -> None:
    """To the right there is one way for Robot1, in row 2; the others take the shortest, also when pushed."""
    planner = FleetPlanner(GridMap(3, 9), settings)
    fleet = make_fleet(planner, [0, 9, 26], 1)
    closed = {(3, 4), (12, 13)}
    planner.state.zones.put(
        [
            blocked("shut", edges=((3, 4),), robots=("Robot1",)),
            Zone("back", ZoneKind.ONE_WAY, (13,), robots=("Robot1",), direction=Direction.MINUS_X),
        ]
    )
    driven: dict[str, set[tuple[int, int]]] = {name: set() for name in fleet.robots}

    def arrived() -> bool:
        for name in fleet.robots:
            driven[name].update(pairwise(planner.state.ledger.granted(name)))
        return fleet.all_arrived()

    fleet.send([8, 17, 1])
    fleet.run(arrived)
    for name, goal in zip(fleet.robots, [2, 9, 7], strict=True):
        assert fleet.ask(GoalSet(name, goal)).ok
    fleet.run(arrived)
    for name, goal in zip(fleet.robots, [16, 8, 0], strict=True):
        assert fleet.ask(GoalSet(name, goal)).ok
    fleet.run(arrived)
    assert (21, 22) in driven["Robot1"]
    assert closed.isdisjoint(driven["Robot1"])
    assert not closed.isdisjoint(driven["Robot2"])


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS.values(), ids=list(SETTINGS))
def test_closing_all_ways_of_a_robot_stops_it(
    make_fleet: type[SimulatedClients], settings: FleetSettings
) -> None:
    """Its path is taken away; the zone's end gives it another."""
    fleet = make_fleet(FleetPlanner(GridMap(1, 9), settings), [0], 1, loss=0.0)
    fleet.send([8])
    fleet.run(lambda: robot(fleet).cell in (1, 2, 3))
    put(fleet, blocked("shut", edges=((6, 7),), robots=("Robot1",)))
    fleet.run(lambda: fleet.states() == [RobotState.UNREACHABLE])
    assert 7 not in robot(fleet).plan
    assert fleet.ask(ZonesSet((), remove=("shut",))).ok
    fleet.run(fleet.all_arrived)


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=list(SETTINGS))
def test_a_robot_waits_for_room_in_a_full_zone(
    make_fleet: type[SimulatedClients], settings: FleetSettings
) -> None:
    """It is unreachable while a blocked zone is in its way as well."""
    fleet = make_fleet(FleetPlanner(LOOP, settings), [7, 1], 1, loss=0.0)
    fleet.send([])
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2)
    put(fleet, Zone("lift", ZoneKind.LIMITED, (6, 7, 8, 17, 26, 25, 24), capacity=1))
    assert fleet.ask(GoalSet("Robot2", 25)).ok
    fleet.run(lambda: fleet.states()[1] is RobotState.WAITING and robot(fleet, 2).reason != "")
    assert robot(fleet, 2).reason == "zone 'lift' is full"
    put(fleet, blocked("spill", 5, 23))
    fleet.run(lambda: fleet.states()[1] is RobotState.UNREACHABLE)
    assert robot(fleet, 2).reason == ""
    assert fleet.ask(ZonesSet((), remove=("spill",))).ok
    fleet.run(lambda: robot(fleet, 2).reason == "zone 'lift' is full")
    assert fleet.ask(GoalSet("Robot1", 4)).ok
    fleet.run(fleet.all_arrived)
    assert robot(fleet, 2).reason == ""


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=list(SETTINGS))
def test_a_paused_robot_on_the_only_way_is_no_full_zone(
    make_fleet: type[SimulatedClients], settings: FleetSettings
) -> None:
    """When it is resumed, the other one waits for room only."""
    fleet = make_fleet(FleetPlanner(LOOP, settings), [7, 1], 1, loss=0.0)
    fleet.send([])
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2)
    put(fleet, Zone("lift", ZoneKind.LIMITED, (6, 7, 8), capacity=1), blocked("spill", 23))
    assert fleet.ask(ModeSet("Robot1", RobotMode.PAUSED)).ok
    fleet.run(lambda: fleet.states()[0] is RobotState.PAUSED)
    assert fleet.ask(GoalSet("Robot2", 8)).ok
    fleet.run(lambda: fleet.states()[1] is RobotState.UNREACHABLE)
    assert fleet.ask(ModeSet("Robot1", RobotMode.AUTOMATIC)).ok
    fleet.run(lambda: robot(fleet, 2).reason == "zone 'lift' is full")
    assert fleet.states()[1] is RobotState.WAITING


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=list(SETTINGS))
def test_a_full_zone_beside_the_way_is_no_reason(
    make_fleet: type[SimulatedClients], settings: FleetSettings
) -> None:
    """Robot2's goal is shut off by a zone for it; Robot1 fills a zone elsewhere."""
    fleet = make_fleet(FleetPlanner(LOOP, settings), [18, 1], 1, loss=0.0)
    fleet.send([])
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 2)
    put(
        fleet,
        Zone("lift", ZoneKind.LIMITED, (18, 9), capacity=1),
        blocked("steps", edges=((4, 5), (22, 23)), robots=("Robot2",)),
    )
    assert fleet.ask(GoalSet("Robot2", 8)).ok
    fleet.run(lambda: fleet.states()[1] is RobotState.UNREACHABLE)
    assert robot(fleet, 2).reason == ""


def test_a_plan_ends_before_a_move_that_is_closed_for_its_robot() -> None:
    """Of a planner that ignores costs of single robots."""

    class Careless:
        def plan(self, problem: PlanningProblem) -> JointPlan:
            return JointPlan.of([[0, 8], [1, 8], [2, 7]], complete=True)

    request = PlanRequest(
        number=0,
        rows=1,
        columns=9,
        blocked=(),
        robots=("Robot1", "Robot2"),
        starts=(0, 8),
        goals=(2, 7),
        rests=(-1, -1),
        seed=0,
        effort=100,
        own_closed=(((1,), ((1, 2),)), ((0,), ((2, 1),))),
    )
    assert compute_plan(request, Careless()).complete
    made = compute_plan(replace(request, own_closed=(((0,), ((1, 2),)),)), Careless())
    assert (made.visitors, made.cells, made.complete) == ((0, 1), (1, 7), False)
    made = compute_plan(replace(request, own_closed=(), closed=((0, 1),)), Careless())
    assert (made.visitors, made.cells, made.complete) == ((1,), (7,), False)


def test_a_cost_zone_is_avoided_by_all(make: Make) -> None:
    fleet = make(LOOP, [0], [])
    put(fleet, Zone("mud", ZoneKind.COST, (3, 4, 5), cost=5.0))
    assert fleet.ask(GoalSet("Robot1", 8)).ok
    fleet.run(lambda: len(robot(fleet).plan) > 5)
    assert 22 in robot(fleet).plan
    assert fleet.planner.state.zones.speed_limit("Robot1", [3, 4, 5]) == inf
    fleet.run(fleet.all_arrived)
