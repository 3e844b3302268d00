"""Plans that take their time: what the planner does meanwhile, and what it takes of an outdated one."""

from __future__ import annotations

import pytest

from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
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
)
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import PlanRequest, PlanResult, compute_plan
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.planning.grid import GridMap


class PlannerHarness:
    """A planner whose plans are made when a test says so, and robots that stand in their cells."""

    def __init__(self, *starts: int, settings: FleetSettings | None = None) -> None:
        self.planner = FleetPlanner(GridMap(1, 8) if len(starts) == 1 else GridMap(), settings)
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
                case SendCancel() | Reply() | BlockedChanged():
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
    x, y = pair.planner.state.grid.centre(8)
    pair.tell(PoseSeen("R1", x, y, 0.0))
    pair.tell(Tick())
    assert pair.planner.state.ledger.route("R1")[0] == 8
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
    harness = PlannerHarness(0, 7, settings=FleetSettings(visits_per_step=3, robots_per_step=1))
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
