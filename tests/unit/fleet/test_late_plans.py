"""Plans that take their time: what the planner does meanwhile, and what it takes of an outdated one."""

from __future__ import annotations

from math import pi

import pytest

from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellsIgnored,
    Event,
    GoalSet,
    Instruction,
    MakePlan,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    RobotRemoved,
    SendCancel,
    SendCells,
    Tick,
    ZonesSet,
)
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import PlanRequest, PlanResult, compute_plan
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.coordination.zones import Direction, Zone, ZoneKind
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.guidance import RIGHT, UP


class PlannerHarness:
    """A planner whose plans are made when a test says so, and robots that stand in their cells."""

    def __init__(self, *starts: int, settings: FleetSettings | None = None) -> None:
        grid = GridMap(1, 8) if len(starts) == 1 else GridMap()
        self.planner = FleetPlanner(grid, settings or FleetSettings(repairs=0))
        self.now = 0.0
        self.requests: list[PlanRequest] = []
        self.sent: dict[str, tuple[int, ...]] = {}
        self.revisions: dict[str, int] = {}
        for number, cell in enumerate(starts, start=1):
            self.join(f"R{number}", cell)

    def tell(self, event: Event) -> list[Instruction]:
        done = self.planner.handle(event, self.now)
        for instruction in done:
            match instruction:
                case MakePlan(request):
                    self.requests.append(request)
                case SendCells(robot, revision, cells):
                    self.sent[robot], self.revisions[robot] = cells, revision
                case SendCancel() | Reply() | BlockedChanged() | CellsIgnored():
                    pass
        self.planner.validate()
        return done

    def join(self, robot: str, cell: int) -> None:
        x, y = self.planner.state.grid.centre(cell)
        for _ in range(3):
            self.tell(PoseSeen(robot, x, y, 0.0))
            self.tell(ReportSeen(robot, ClientReport(self.revisions[robot], ClientState.IDLE)))
            self.now += 0.5
        self.tell(PoseSeen(robot, x, y, 0.0))
        assert self.sent[robot] == (cell,)

    def events(self, count: int) -> None:
        """Give the planner events without any news."""
        for _ in range(count):
            self.tell(Tick())

    def stand(self) -> None:
        """Have all robots say that they stand in their cells and took their lists."""
        for robot in self.revisions:
            x, y = self.planner.state.grid.centre(self.planner.state.ledger.route(robot)[0])
            for _ in range(3):
                self.tell(PoseSeen(robot, x, y, 0.0))
                self.tell(ReportSeen(robot, ClientReport(self.revisions[robot], ClientState.IDLE)))
                self.now += 0.25

    def finish(self) -> PlanResult:
        """Finish the plan that was asked for last."""
        result = compute_plan(self.requests[-1])
        self.tell(PlanMade(result))
        return result

    def finish_all(self) -> None:
        while True:
            asked = len(self.requests)
            self.finish()
            if len(self.requests) == asked:
                return


@pytest.fixture
def pair() -> PlannerHarness:
    """Two robots in the corners of a floor, sent across it; the plan for that is asked for, and not there."""
    harness = PlannerHarness(0, 7)
    harness.finish_all()
    harness.tell(GoalSet("R1", 56))
    harness.finish_all()
    harness.sent.clear()
    harness.tell(GoalSet("R2", 63))
    return harness


def test_no_robot_is_granted_cells_while_a_plan_is_made(pair: PlannerHarness) -> None:
    ledger, (x, y) = pair.planner.state.ledger, pair.planner.state.grid.centre(8)
    cells = tuple(ledger.granted("R1"))
    pair.tell(
        ReportSeen("R1", ClientReport(pair.revisions["R1"], ClientState.DRIVING, cells, target=cells[-1]))
    )
    pair.tell(PoseSeen("R1", x, y, 0.0))
    pair.tell(Tick())
    assert ledger.route("R1")[0] == 8
    assert pair.sent == {}
    pair.finish()
    assert len(pair.sent["R1"]) == len(pair.sent["R2"]) == 5


def test_one_plan_is_asked_for_at_a_time(pair: PlannerHarness) -> None:
    asked = len(pair.requests)
    pair.tell(CellBlocked(30))
    pair.tell(CellBlocked(31))
    assert len(pair.requests) == asked
    pair.finish()
    assert len(pair.requests) == asked + 1
    assert {30, 31} <= set(pair.requests[-1].blocked)


def test_an_outdated_plan_is_taken_as_far_as_it_goes(pair: PlannerHarness) -> None:
    """Robots drive on although the fleet changes during every plan."""
    pair.tell(CellBlocked(30))
    pair.finish()
    assert pair.sent["R2"][0] == 7
    assert len(pair.sent["R2"]) == 5


def test_a_route_ends_before_a_cell_that_was_blocked_meanwhile(pair: PlannerHarness) -> None:
    pair.tell(CellBlocked(23))
    pair.finish()
    assert pair.sent["R2"] == (7, 15)
    pair.finish()
    assert 23 not in pair.sent["R2"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("zone", "sent"),
    [
        (Zone("z", ZoneKind.BLOCKED, (23,), robots=("R2",)), (7, 15)),
        (Zone("z", ZoneKind.BLOCKED, (23,), robots=("R1",)), (7, 15, 23, 31, 39)),
        (Zone("z", ZoneKind.BLOCKED, edges=((15, 23),)), (7, 15)),
        (Zone("z", ZoneKind.ONE_WAY, (23,), direction=Direction.MINUS_Y), (7, 15)),
        (Zone("z", ZoneKind.LIMITED, (0, 23, 31), capacity=1), (7, 15)),
        (Zone("z", ZoneKind.LIMITED, (0, 23, 31), capacity=2), (7, 15, 23, 31, 39)),
        (Zone("z", ZoneKind.LIMITED, (0, 23, 31), robots=("R2",), capacity=1), (7, 15, 23, 31, 39)),
        (Zone("z", ZoneKind.SLOW, (23,), speed=0.2), (7, 15, 23, 31, 39)),
    ],
)
def test_a_route_keeps_to_zones_that_were_set_meanwhile(
    pair: PlannerHarness, zone: Zone, sent: tuple[int, ...]
) -> None:
    """It ends before the first move that a zone does not allow any more; the next plan leads around it."""
    pair.tell(ZonesSet((zone,)))
    pair.finish()
    assert pair.sent["R2"] == sent
    pair.finish_all()
    route = pair.planner.state.ledger.route("R2")
    assert route[-1] == 63
    assert (23 in route) is (len(sent) > 2)


def test_a_zone_that_was_set_while_a_plan_is_taken_over_counts() -> None:
    """Of the first part of the plan nothing is granted, and of the second nothing is entered."""
    harness = PlannerHarness(0, settings=FleetSettings(repairs=0, visits_per_step=3))
    harness.finish_all()
    harness.tell(GoalSet("R1", 7))
    harness.tell(PlanMade(compute_plan(harness.requests[-1])))
    harness.tell(ZonesSet((Zone("z", ZoneKind.BLOCKED, (6,), robots=("R1",)),)))
    harness.events(3)
    assert harness.planner.state.ledger.route("R1") == [0, 1, 2, 3, 4, 5]


def test_a_plan_that_failed_is_asked_for_again() -> None:
    """The robot stands meanwhile, and the planner does not ask at each tick."""
    harness = PlannerHarness(0)
    harness.finish_all()
    harness.tell(GoalSet("R1", 5))
    for _ in range(3):
        asked = len(harness.requests)
        number = harness.requests[-1].number
        harness.tell(PlanMade(PlanResult(number, (), (), (), complete=False, failure="ValueError: no")))
        harness.events(10)
        assert len(harness.requests) <= asked + 1
        assert harness.sent["R1"] == (0,)
        harness.now += 6.0
        harness.stand()
        harness.tell(Tick())
        assert len(harness.requests) == asked + 1
    harness.finish()
    assert harness.sent["R1"] == (0, 1, 2, 3, 4)


def test_a_robot_with_another_goal_waits_for_the_next_plan(pair: PlannerHarness) -> None:
    pair.tell(GoalSet("R2", 3))
    pair.finish()
    assert "R2" not in pair.sent
    pair.finish()
    assert pair.sent["R2"] == (7, 6, 5, 4, 3)


def test_a_robot_that_was_removed_gets_no_route(pair: PlannerHarness) -> None:
    pair.tell(RobotRemoved("R2"))
    pair.finish()
    assert "R2" not in pair.sent
    assert pair.requests[-1].robots == ("R1",)


def test_a_plan_that_was_not_asked_for_is_ignored(pair: PlannerHarness) -> None:
    result = compute_plan(pair.requests[-1])
    pair.tell(PlanMade(PlanResult(result.number - 1, result.visitors, result.cells, (), complete=True)))
    assert pair.sent == {}
    pair.tell(PlanMade(result))
    pair.sent.clear()
    pair.tell(PlanMade(result))
    assert pair.sent == {}


def test_a_plan_waits_for_a_robot_that_is_being_stopped() -> None:
    harness = PlannerHarness(0)
    harness.tell(GoalSet("R1", 7))
    harness.finish_all()
    harness.tell(GoalSet("R1", None))
    asked = len(harness.requests)
    assert harness.sent["R1"] == ()
    harness.tell(Tick())
    assert len(harness.requests) == asked
    harness.tell(ReportSeen("R1", ClientReport(harness.revisions["R1"], ClientState.IDLE)))
    harness.now += 1.0
    x, y = harness.planner.state.grid.centre(0)
    harness.tell(PoseSeen("R1", x, y, 0.0))
    assert len(harness.requests) == asked + 1


def test_hindered_robot_gets_its_place_once_the_cell_is_free() -> None:
    """Nothing of its own is heard in between."""
    harness = PlannerHarness(3)
    x, y = harness.planner.state.grid.centre(4)
    for _ in range(3):
        harness.tell(PoseSeen("R2", x - 0.4, y, 0.0))
        harness.tell(ReportSeen("R2", ClientReport(harness.revisions["R2"], ClientState.IDLE)))
        harness.now += 0.5
    harness.tell(PoseSeen("R2", x - 0.4, y, 0.0))
    assert "cell 3 is held by R1" in harness.planner.snapshot().robots[1].reason
    harness.tell(RobotRemoved("R1"))
    assert harness.sent["R2"] == (4,)


# Plans that are taken over in parts


@pytest.fixture
def slow() -> PlannerHarness:
    """The same two robots; each event takes over three entries of a plan, and one robot gets cells."""
    harness = PlannerHarness(0, 7, settings=FleetSettings(visits_per_step=3, robots_per_step=1, repairs=0))
    for _ in range(3):
        harness.finish()
        harness.events(10)
    harness.tell(GoalSet("R1", 56))
    harness.tell(GoalSet("R2", 63))
    harness.sent.clear()
    return harness


def test_a_plan_is_taken_over_with_the_events_after_it(slow: PlannerHarness) -> None:
    slow.finish()
    assert len(slow.planner.state.ledger.route("R1")) < 8
    assert slow.sent == {}
    slow.events(10)
    slow.finish()
    slow.events(10)
    assert slow.planner.state.ledger.route("R1") == [0, 8, 16, 24, 32, 40, 48, 56]
    assert len(slow.sent["R1"]) == len(slow.sent["R2"]) == 5


@pytest.mark.slow
@pytest.mark.parametrize("parts", range(5))
def test_what_changes_between_two_parts_of_a_plan_counts(slow: PlannerHarness, parts: int) -> None:
    """A route ends where a cell was blocked, or where its robot was stopped, and the others go on."""
    slow.finish()
    slow.events(10)
    slow.finish()
    slow.events(parts)
    slow.tell(CellBlocked(23))
    slow.tell(GoalSet("R1", 3))
    for _ in range(4):
        slow.events(10)
        slow.stand()
        slow.finish()
    slow.events(10)
    routes = slow.planner.state.ledger
    assert routes.route("R1")[-1] == 3
    assert routes.route("R2")[-1] == 63
    assert 23 not in routes.route("R2")


def test_plans_count_turns_from_the_robots_headings() -> None:
    """A robot faces where its pose does, and one with granted cells in the direction of the last two."""
    harness = PlannerHarness(0, 7, settings=FleetSettings(repairs=0, quarter_turn=1.0, stop=0.5))
    harness.finish_all()
    harness.tell(GoalSet("R1", 59))
    assert harness.requests[-1].headings == (RIGHT, RIGHT)
    result = harness.finish()
    route = [cell for robot, cell in zip(result.visitors, result.cells, strict=True) if robot == 0]
    assert route == [1, 2, 3, 11, 19, 27, 35, 43, 51, 59]
    harness.events(3)
    assert harness.sent["R1"] == (0, 1, 2, 3, 11)
    harness.tell(GoalSet("R2", 62))
    assert harness.requests[-1].headings == (UP, RIGHT)


@pytest.fixture
def row() -> PlannerHarness:
    """Five robots in a row, all sent upwards; new paths for them are asked for, and not there."""
    harness = PlannerHarness(0, 1, 2, 3, 4, settings=FleetSettings())
    for number in range(1, 6):  # None of them is silent meanwhile.
        harness.tell(PoseSeen(f"R{number}", *harness.planner.state.grid.centre(number - 1), 0.0))
        harness.tell(
            ReportSeen(f"R{number}", ClientReport(harness.revisions[f"R{number}"], ClientState.IDLE))
        )
    for number in range(1, 6):
        assert isinstance(harness.tell(GoalSet(f"R{number}", 55 + number))[0], Reply)
    harness.tell(Tick())
    assert harness.requests[-1].copy is not None, "more robots than the planner repairs by itself"
    return harness


def test_new_paths_for_some_are_entered_without_a_plan_for_all(row: PlannerHarness) -> None:
    asked = len(row.requests)
    row.finish()
    for number in range(1, 6):
        assert row.planner.state.ledger.route(f"R{number}")[-1] == 55 + number
    assert len(row.requests) == asked


def test_new_path_over_a_cell_blocked_meanwhile_is_cut(row: PlannerHarness) -> None:
    row.tell(CellBlocked(24))
    result = row.finish()
    assert result.rerouting is not None
    assert any(cell == 24 for path in result.rerouting.paths for cell, _ in path), "it is on a new path"
    assert 24 not in {cell for number in range(1, 6) for cell in row.planner.state.ledger.route(f"R{number}")}
    row.tell(Tick())
    if row.requests[-1].number != result.number:
        row.finish()
    assert row.planner.state.ledger.route("R1")[-1] == 56


def test_robot_with_another_goal_meanwhile_gets_another_path(row: PlannerHarness) -> None:
    row.tell(GoalSet("R3", 63))
    result = row.finish()
    row.tell(Tick())
    if row.requests[-1].number != result.number:
        row.finish()
    assert row.planner.state.ledger.route("R3")[-1] == 63
    assert row.planner.state.ledger.route("R1")[-1] == 56


def test_robot_removed_meanwhile_leaves_the_others_their_paths(row: PlannerHarness) -> None:
    row.tell(RobotRemoved("R2"))
    row.finish()
    row.tell(Tick())
    assert row.planner.state.ledger.route("R1")[-1] == 56
    assert row.planner.state.ledger.route("R3")[-1] == 58


@pytest.mark.parametrize("repairs", [0, 3])
@pytest.mark.parametrize(("facing", "corner"), [(0.0, 7), (pi / 2, 56)])
def test_paths_of_single_robots_and_of_all_have_few_turns(repairs: int, facing: float, corner: int) -> None:
    """A robot drives straight on from where it faces, and turns once."""
    settings = FleetSettings(repairs=repairs, quarter_turn=1.0, stop=0.5)
    harness = PlannerHarness(0, 63, settings=settings)
    if harness.requests:
        harness.finish_all()
    harness.tell(PoseSeen("R1", *harness.planner.state.grid.centre(0), facing))
    harness.tell(PoseSeen("R2", *harness.planner.state.grid.centre(63), 0.0))
    harness.tell(GoalSet("R1", 62 if corner == 56 else 55))
    harness.events(1)
    if not repairs:
        harness.finish_all()
    route = harness.planner.state.ledger.route("R1")
    assert corner in route
    assert len(route) == 14
