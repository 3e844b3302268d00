"""What the planner does in each case, with obedient robots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import pytest

from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellFreed,
    Event,
    GoalSet,
    ObstacleSeen,
    PoseSeen,
    ReportSeen,
    RobotRemoved,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.robot import ROBOT_LIFE, Cause, Phase, RobotRecord
from rce_fleet.coordination.snapshot import RobotSnapshot, RobotState
from rce_fleet.exceptions import TransitionError
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients


def robot(fleet: SimulatedClients, number: int = 1) -> RobotSnapshot:
    return fleet.planner.snapshot().robots[number - 1]


class Make(Protocol):
    """Makes a fleet; see :func:`make`."""

    def __call__(
        self, grid: GridMap, starts: list[int], goals: list[int] | None = None
    ) -> SimulatedClients: ...


@pytest.fixture
def make(make_fleet: type[SimulatedClients]) -> Make:
    """Makes a fleet whose robots have joined, on a network that loses nothing."""

    def of(grid: GridMap, starts: list[int], goals: list[int] | None = None) -> SimulatedClients:
        fleet = make_fleet(FleetPlanner(grid), starts, 1, loss=0.0)
        fleet.send(goals or [])
        return fleet

    return of


def test_a_robot_joins_where_it_stands_and_is_not_moved(make: Make) -> None:
    fleet = make(GridMap(), [27])
    assert (robot(fleet).cell, robot(fleet).plan, robot(fleet).state) == (27, (27,), RobotState.IDLE)


def test_a_robot_drives_to_its_goal_in_granted_cells(make: Make) -> None:
    fleet = make(GridMap(), [0], [63])
    assert len(robot(fleet).plan) == 15
    assert len(robot(fleet).granted) == 5
    fleet.run(fleet.all_arrived)
    assert robot(fleet).replans == 0


def test_a_robot_without_goal_steps_aside_and_comes_back(make: Make) -> None:
    # A corridor of one row with a bay beside cell 2, where the idle robot stands.
    grid = GridMap(2, 5, blocked=frozenset({5, 6, 8, 9}))
    fleet = make(grid, [2, 0])
    assert fleet.ask(GoalSet("Robot2", 4)).ok
    fleet.run(lambda: robot(fleet, 2).state is RobotState.ARRIVED and robot(fleet).cell == 7)
    fleet.run(lambda: robot(fleet).cell == 2)
    assert robot(fleet).state is RobotState.IDLE


def test_robot_on_anothers_goal_moves_away_and_stays_away(make: Make) -> None:
    fleet = make(GridMap(), [27, 0])
    assert fleet.ask(GoalSet("Robot2", 27)).ok
    fleet.run(lambda: robot(fleet, 2).state is RobotState.ARRIVED)
    assert robot(fleet).cell in GridMap().neighbours[27]


def test_a_cell_blocked_beyond_the_base_stops_no_robot(make: Make) -> None:
    """The robot drives on in its granted cells, and has another path before the next tick."""
    fleet = make(GridMap(), [24], [31])
    cell, base = robot(fleet).plan[5], robot(fleet).granted
    fleet.now += 0.2
    out = fleet.tell(CellBlocked(cell))
    assert SendCancel("Robot1") not in out
    assert BlockedChanged((cell,)) in out
    fleet.blocked = {cell}
    assert robot(fleet).plan[: len(base)] == base
    assert robot(fleet).plan[-1] == 31
    assert cell not in robot(fleet).plan
    assert robot(fleet).replans == 1
    fleet.run(fleet.all_arrived)


def test_a_cell_blocked_within_the_base_stops_its_robot(make: Make) -> None:
    fleet = make(GridMap(), [24], [31])
    cell = robot(fleet).granted[-1]
    assert SendCancel("Robot1") in fleet.tell(CellBlocked(cell))
    assert robot(fleet).state is RobotState.STOPPING
    fleet.run(lambda: robot(fleet).plan[-1] == 31)
    assert cell not in robot(fleet).plan
    fleet.run(fleet.all_arrived)


def test_blocking_an_unused_cell_changes_no_plan(make: Make) -> None:
    fleet = make(GridMap(), [0], [7])
    out = fleet.tell(CellBlocked(60))
    assert not [done for done in out if isinstance(done, SendCancel)]
    fleet.run(fleet.all_arrived)
    assert robot(fleet).replans == 0


def test_an_occupied_cell_is_blocked_when_its_robot_has_left(make: Make) -> None:
    fleet = make(GridMap(), [27])
    reply = fleet.ask(CellBlocked(27))
    assert reply.ok
    assert "Robot1" in reply.message
    assert fleet.planner.snapshot().pending == (27,)
    assert fleet.planner.snapshot().blocked == ()
    fleet.run(lambda: fleet.planner.snapshot().blocked == (27,))
    assert robot(fleet).cell != 27


def test_a_granted_cell_is_blocked_when_its_robot_has_stopped(make: Make) -> None:
    fleet = make(GridMap(), [24], [31])
    ahead = robot(fleet).granted[4]
    assert fleet.ask(CellBlocked(ahead)).ok
    assert fleet.planner.snapshot().pending == (ahead,)
    fleet.run(lambda: fleet.planner.snapshot().blocked == (ahead,))
    fleet.run(fleet.all_arrived)


def test_a_pending_cell_can_be_freed(make: Make) -> None:
    fleet = make(GridMap(1, 1), [0])
    fleet.ask(CellBlocked(0))
    assert fleet.ask(CellFreed(0)).ok
    assert fleet.planner.snapshot().pending == ()


def test_cut_off_goal_is_reported_and_reached_once_free(make: Make) -> None:
    fleet = make(GridMap(1, 5), [0, 4])
    assert fleet.ask(CellBlocked(2)).ok
    assert fleet.ask(GoalSet("Robot1", 3)).ok
    fleet.step()
    assert robot(fleet).state is RobotState.UNREACHABLE
    assert fleet.ask(CellFreed(2)).ok
    fleet.blocked = set()
    fleet.run(lambda: robot(fleet).state is RobotState.ARRIVED)


def test_robot_cut_off_from_its_goal_does_not_block_others(make: Make) -> None:
    grid = GridMap(3, 3, blocked=frozenset({1}))
    fleet = make(grid, [0, 8])
    fleet.ask(CellBlocked(3))
    fleet.ask(GoalSet("Robot1", 2))
    fleet.ask(GoalSet("Robot2", 6))
    fleet.run(lambda: robot(fleet, 2).state is RobotState.ARRIVED)
    assert robot(fleet).state is RobotState.UNREACHABLE


def test_cell_found_blocked_by_a_sensor_is_blocked(make: Make) -> None:
    fleet = make(GridMap(), [24])
    fleet.hidden = {28}
    fleet.ask(GoalSet("Robot1", 31))
    fleet.run(fleet.all_arrived)
    assert fleet.planner.snapshot().blocked == (28,)
    assert robot(fleet).replans == 1


def test_sensor_hit_in_another_robots_cell_is_ignored(make: Make) -> None:
    fleet = make(GridMap(), [0, 1])
    fleet.tell(ObstacleSeen("Robot1", (1, 0, 999)))
    assert fleet.planner.snapshot().blocked == ()
    assert fleet.planner.snapshot().pending == ()


def test_silent_robot_keeps_its_cells_others_drive_around(make: Make) -> None:
    fleet = make(GridMap(3, 5), [7, 5])
    fleet.silent = {"Robot1"}
    fleet.run(lambda: robot(fleet).state is RobotState.SILENT)
    assert "sends neither poses nor states" in robot(fleet).reason
    fleet.ask(GoalSet("Robot2", 9))
    fleet.run(lambda: robot(fleet, 2).state is RobotState.ARRIVED)
    assert robot(fleet).granted == (7,)
    fleet.silent = set()
    fleet.run(lambda: robot(fleet).state is RobotState.IDLE)


def test_silent_robot_continues_after_its_return(make: Make) -> None:
    fleet = make(GridMap(), [0], [63])
    fleet.silent = {"Robot1"}
    fleet.run(lambda: robot(fleet).state is RobotState.SILENT)
    fleet.silent = set()
    fleet.run(fleet.all_arrived)


def test_a_new_robot_on_the_way_is_driven_around(make: Make) -> None:
    fleet = make(GridMap(3, 8), [8], [15])
    fleet.add_robot("Robot2", 14)
    fleet.run(lambda: fleet.states() == [RobotState.ARRIVED, RobotState.IDLE])
    assert robot(fleet, 2).cell == 14


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ((-5.0, 1.5), "it is outside the map: localize it, or drive it onto the map by hand"),
        ((1.5, 1.5), "it stands in cell 9, which is a wall: localize it, or drive it out by hand"),
    ],
)
def test_robot_that_cannot_be_placed_says_where_it_is(place: tuple[float, float], reason: str) -> None:
    planner = FleetPlanner(GridMap(blocked=frozenset({9})))
    for second in range(3):
        planner.handle(PoseSeen("Robot1", *place, 0.0), 10.0 * second)
    planner.handle(Tick(), 30.0)
    assert planner.snapshot().robots[0].reason == reason


def test_robot_in_a_blocked_cell_reports_why_it_cannot_join(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap()), [], 1, loss=0.0)
    fleet.ask(CellBlocked(9))
    fleet.blocked = set()
    fleet.add_robot("Robot1", 9)
    reason = "it stands in cell 9, which is blocked: free the cell, or drive it out by hand"
    fleet.run(lambda: bool(fleet.states()) and robot(fleet).reason == reason)
    fleet.ask(CellFreed(9))
    fleet.run(lambda: robot(fleet).state is RobotState.IDLE)


def test_a_restarted_planner_takes_over_where_robots_are(make: Make) -> None:
    fleet = make(GridMap(), [0], [63])
    for _ in range(30):
        fleet.step()
    fleet.restart_planner(FleetPlanner(GridMap()))
    fleet.run(lambda: fleet.states() == [RobotState.IDLE])
    fleet.ask(GoalSet("Robot1", 7))
    fleet.run(fleet.all_arrived)


def test_restarted_move_client_gets_its_cells_again(make: Make) -> None:
    fleet = make(GridMap(), [0], [63])
    for _ in range(30):
        fleet.step()
    fleet.restart_client("Robot1")
    fleet.run(fleet.all_arrived)


def test_a_new_goal_replaces_the_old_one(make: Make) -> None:
    fleet = make(GridMap(), [0], [63])
    for _ in range(20):
        fleet.step()
    base = robot(fleet).granted
    assert len(base) > 1
    out = fleet.tell(GoalSet("Robot1", 56))
    assert not [done for done in out if isinstance(done, SendCancel | SendCells)], "its base stays"
    assert robot(fleet).plan == base
    fleet.tell(Tick())
    assert robot(fleet).plan[: len(base)] == base
    assert robot(fleet).plan[-1] == 56
    fleet.run(fleet.all_arrived)
    assert robot(fleet).cell == 56
    assert robot(fleet).replans == 0, "a new goal is not a blocked path"


def test_a_robot_without_its_goal_stays(make: Make) -> None:
    fleet = make(GridMap(), [0], [63])
    for _ in range(40):
        fleet.step()
    assert fleet.ask(GoalSet("Robot1", None)).ok
    fleet.run(lambda: robot(fleet).state is RobotState.IDLE)
    assert robot(fleet).cell not in (0, 63)


def test_robot_off_its_path_is_stopped_and_placed_again(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = make(GridMap(), [0])
    fleet.run(lambda: fleet.clients["Robot1"].report.reached == 0)
    monkeypatch.setattr(fleet, "check", lambda: None)  # The robot is where it must not be: that is the point.
    fleet.robots["Robot1"].x, fleet.robots["Robot1"].y = 1.5, 1.5
    fleet.tell(PoseSeen("Robot1", 1.5, 1.5, 0.0))
    assert robot(fleet).state is RobotState.STOPPING
    assert robot(fleet).reason == "it left its path"
    fleet.run(lambda: robot(fleet).state is RobotState.IDLE)
    assert robot(fleet).cell == 9


@pytest.mark.parametrize(
    ("place", "state", "reason"),
    [
        ((3.5, 1.5), RobotState.STOPPING, "it was pushed along its path"),
        ((2.5, 1.5), RobotState.DRIVING, ""),
    ],
    ids=["around a corner", "into the next cell"],
)
def test_robot_pushed_along_its_path_is_stopped_if_it_cannot_drive_back(
    make: Make,
    monkeypatch: pytest.MonkeyPatch,
    place: tuple[float, float],
    state: RobotState,
    reason: str,
) -> None:
    """Its move client sends it back to the corner that it drove to, and navigation would cut that."""
    fleet = make(GridMap(blocked=frozenset({3, 8, 9, 18})), [0], [12])
    fleet.run(lambda: fleet.robots["Robot1"].x > 2.1)
    assert robot(fleet).granted[-4:] == (2, 10, 11, 12)
    assert fleet.clients["Robot1"].report.target == 2
    monkeypatch.setattr(fleet, "check", lambda: None)  # The robot is where it must not be: that is the point.
    fleet.robots["Robot1"].x, fleet.robots["Robot1"].y = place
    fleet.tell(PoseSeen("Robot1", *place, 0.0))
    assert (robot(fleet).state, robot(fleet).reason) == (state, reason)
    fleet.run(fleet.all_arrived)


def test_a_removed_robot_leaves_its_cells(make: Make) -> None:
    fleet = make(GridMap(1, 3), [0, 1])
    fleet.ask(GoalSet("Robot1", 2))
    fleet.robots.pop("Robot2")
    assert fleet.ask(RobotRemoved("Robot2")).ok
    fleet.run(fleet.all_arrived)


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (GoalSet("Nobody", 3), "robot Nobody is unknown"),
        (GoalSet("Robot1", 64), "not on the map"),
        (GoalSet("Robot1", 10), "is blocked"),
        (GoalSet("Robot1", 12), "is blocked"),
        (GoalSet("Robot1", 63), "goal of Robot2"),
        (CellBlocked(-1), "not on the map"),
        (CellBlocked(10), "is a wall"),
        (CellFreed(10), "is a wall"),
        (CellFreed(99), "not on the map"),
        (RobotRemoved("Nobody"), "robot Nobody is unknown"),
    ],
)
def test_invalid_request_is_refused_with_a_reason(make: Make, event: Event, words: str) -> None:
    fleet = make(GridMap(blocked=frozenset({10})), [0, 1])
    fleet.ask(CellBlocked(12))
    fleet.ask(GoalSet("Robot2", 63))
    before = fleet.planner.snapshot()
    reply = fleet.ask(event)
    assert not reply.ok
    assert words in reply.message
    assert fleet.planner.snapshot() == before


def test_freeing_a_free_cell_succeeds(make: Make) -> None:
    assert make(GridMap(), [0]).ask(CellFreed(5)).ok


def test_pose_that_is_not_a_number_is_ignored() -> None:
    planner = FleetPlanner(GridMap())
    assert planner.handle(PoseSeen("Robot1", float("nan"), 0.0, 0.0), 0.0) == []
    assert planner.snapshot().robots == ()


def test_cell_list_is_sent_again_until_acknowledged() -> None:
    planner = FleetPlanner(GridMap(), first_revision=40)
    assert SendCells("R", 41, ()) in planner.handle(PoseSeen("R", 0.5, 0.5, 0.0), 0.0)
    assert SendCells("R", 41, ()) not in planner.handle(Tick(), 0.5)
    again = planner.handle(Tick(), 1.0)
    assert again[:2] == [SendCancel("R"), SendCells("R", 41, ())]
    planner.handle(ReportSeen("R", ClientReport(revision=41, state=ClientState.IDLE)), 1.1)
    assert not [done for done in planner.handle(Tick(), 2.5) if isinstance(done, SendCells)]


def test_transition_outside_the_table_is_refused() -> None:
    for phase in Phase:
        for cause in Cause:
            record = RobotRecord("R", 0, phase=phase)
            if ROBOT_LIFE.allows(phase, cause):
                record.change(cause)
                assert record.phase is ROBOT_LIFE.table[phase][cause]
            else:
                with pytest.raises(TransitionError):
                    record.change(cause)
                assert record.phase is phase
