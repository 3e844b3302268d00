"""A fleet on a lane graph: directions are kept, slow lanes are avoided and driven slowly, zones count too."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import GoalSet, PoseSeen, SendCells, Tick, ZonesSet
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.coordination.zones import Zone, ZoneBook, ZoneKind
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import Lane, LaneGraph

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

FLOOR = GridMap(3, 9)
OUTER = (*range(9), 17, *range(26, 17, -1), 9, 0)
"""Counter-clockwise around the floor."""
ONE_WAY = LaneGraph((Lane("ring", OUTER, one_way=True), Lane("across", (4, 13, 22))))
PACES = LaneGraph(
    (
        Lane("slow", tuple(range(9)), speed=0.05),
        Lane("around", (8, 17, *range(26, 17, -1), 9, 0), speed=0.5),
    )
)
SETTINGS = {
    "one by one": FleetSettings(repairs=24),
    "beside": FleetSettings(repairs=1),
    "for all": FleetSettings(repairs=0),
    "with turns": FleetSettings(repairs=0, quarter_turn=1.0, stop=0.5),
    "dijkstra": FleetSettings(planner="dijkstra", resolve_deadlocks=True),
}


@pytest.fixture(params=SETTINGS.values(), ids=list(SETTINGS))
def settings(request: pytest.FixtureRequest) -> FleetSettings:
    """Ways to find paths."""
    found: FleetSettings = request.param
    return found


def on_lanes(lanes: LaneGraph, settings: FleetSettings) -> FleetPlanner:
    """Return a planner of the lanes on the floor."""
    return FleetPlanner(lanes.restrict(FLOOR), settings, lanes=lanes)


@pytest.mark.slow
def test_robots_never_drive_against_a_lane(
    make_fleet: type[SimulatedClients], settings: FleetSettings
) -> None:
    """Three robots get goals behind them again and again, and drive all around the ring."""
    planner = on_lanes(ONE_WAY, settings)
    fleet = make_fleet(planner, [2, 17, 20], 1)
    driven: set[tuple[int, int]] = set()

    def arrived() -> bool:
        for name in fleet.robots:
            driven.update(pairwise(planner.state.ledger.granted(name)))
        return fleet.all_arrived()

    fleet.send([1, 22, 19])
    fleet.run(arrived)
    for name, goal in zip(fleet.robots, [0, 13, 3], strict=True):
        assert fleet.ask(GoalSet(name, goal)).ok
    fleet.run(arrived)
    assert driven
    assert driven <= ONE_WAY.moves.keys()


@pytest.mark.slow
def test_slow_lanes_are_avoided(make_fleet: type[SimulatedClients], settings: FleetSettings) -> None:
    fleet = make_fleet(on_lanes(PACES, settings), [1], 1, loss=0.0)
    fleet.send([7])
    fleet.run(lambda: len(fleet.planner.snapshot().robots[0].plan) > 5)
    assert 22 in fleet.planner.snapshot().robots[0].plan
    fleet.run(fleet.all_arrived)


def test_lists_of_cells_have_the_speed_of_the_lane(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(on_lanes(PACES, FleetSettings()), [3], 1, loss=0.0)
    fleet.send([])
    fleet.run(lambda: fleet.states() == [RobotState.IDLE])
    out = [*fleet.tell(GoalSet("Robot1", 5)), *fleet.tell(Tick())]
    assert [(done.cells, done.speed) for done in out if isinstance(done, SendCells)] == [((3, 4, 5), 0.05)]


def test_a_robot_beside_its_lane_says_so(make_fleet: type[SimulatedClients]) -> None:
    planner = on_lanes(ONE_WAY, FleetSettings())
    for at in range(3):
        planner.handle(PoseSeen("Robot1", 2.5, 1.5, 0.0), 10.0 * at)
    planner.handle(Tick(), 30.0)
    assert planner.snapshot().robots[0].reason == "it stands on no lane: drive it onto one by hand"


def test_goals_off_lanes_are_refused(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(on_lanes(ONE_WAY, FleetSettings()), [0], 1, loss=0.0)
    fleet.send([])
    fleet.run(lambda: fleet.states() == [RobotState.IDLE])
    assert fleet.ask(GoalSet("Robot1", 11)).message == "cell 11 is on no lane; choose another goal"


def test_zones_close_lanes_and_limit_speed_too() -> None:
    book = ZoneBook(PACES)
    grid = PACES.restrict(FLOOR)
    assert book.closed(grid) == frozenset()
    book.put(
        [
            Zone("shut", ZoneKind.BLOCKED, edges=((17, 26),)),
            Zone("calm", ZoneKind.SLOW, (22,), speed=0.2),
        ]
    )
    assert book.closed(grid) == {(17, 26)}
    assert book.speed_limit("Robot1", [23, 22]) == 0.2
    assert book.speed_limit("Robot1", [24, 23]) == 0.5
    assert ZoneBook(ONE_WAY).closed(ONE_WAY.restrict(FLOOR)) >= {(1, 0), (9, 18), (12, 13)} & {
        (1, 0),
        (9, 18),
    }


def test_a_blocked_lane_has_no_way_around(make_fleet: type[SimulatedClients]) -> None:
    """With a move of the ring closed, a goal behind it is unreachable until it is open again."""
    fleet = make_fleet(on_lanes(LaneGraph((Lane("ring", OUTER, one_way=True),)), FleetSettings()), [2], 1)
    fleet.send([])
    fleet.run(lambda: fleet.states() == [RobotState.IDLE])
    assert fleet.ask(ZonesSet((Zone("shut", ZoneKind.BLOCKED, edges=((5, 6),)),))).ok
    assert fleet.ask(GoalSet("Robot1", 7)).ok
    fleet.run(lambda: fleet.states() == [RobotState.UNREACHABLE])
    assert fleet.ask(ZonesSet((), remove=("shut",))).ok
    fleet.run(fleet.all_arrived)
