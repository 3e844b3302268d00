"""A new planner keeps clear of the cells on which robots still drive for an earlier one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.events import (
    GoalSet,
    PoseSeen,
    ReportSeen,
    RobotRemoved,
    RobotsExpected,
    SendCells,
    Tick,
)
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.nodes.known_robots import KNOWN_FOR, WRITTEN_EVERY, KnownRobots
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from pathlib import Path

GRID = GridMap(3, 6)
DRIVES = ClientReport(7, ClientState.DRIVING, (8, 9, 10))
BRAKES = ClientReport(8, ClientState.CANCELLING)
STANDS = ClientReport(8, ClientState.IDLE)


@pytest.fixture
def planner() -> FleetPlanner:
    """Return a planner that was started while Robot1 drives from cell 8 to cell 10."""
    made = FleetPlanner(GRID)
    made.handle(PoseSeen("Robot1", *GRID.centre(8), 0.0), 0.0)
    made.handle(ReportSeen("Robot1", DRIVES), 0.1)
    return made


def test_cells_of_an_earlier_planner_stay_claimed(planner: FleetPlanner) -> None:
    claims = planner.state.ledger.claims
    assert claims("Robot1") == {8, 9, 10}
    planner.handle(PoseSeen("Robot1", *GRID.centre(9), 0.0), 0.2)
    planner.handle(ReportSeen("Robot1", BRAKES), 0.3)
    assert claims("Robot1") == {8, 9, 10}
    planner.handle(ReportSeen("Robot1", STANDS), 0.6)
    planner.handle(PoseSeen("Robot1", *GRID.centre(9), 0.0), 0.7)
    assert claims("Robot1") == {9}


def test_others_are_not_granted_those_cells(planner: FleetPlanner) -> None:
    now = 0.2
    while now < 3.0:
        planner.handle(PoseSeen("Robot2", *GRID.centre(4), 0.0), now)
        planner.handle(ReportSeen("Robot2", STANDS), now)
        planner.handle(PoseSeen("Robot1", *GRID.centre(8), 0.0), now)
        planner.handle(ReportSeen("Robot1", DRIVES), now)
        planner.handle(GoalSet("Robot2", 16), now)
        planner.handle(Tick(), now)
        planner.validate()
        assert planner.state.ledger.claims("Robot2").isdisjoint({8, 9, 10})
        now += 0.2
    assert planner.state.ledger.claims("Robot2")


def join(planner: FleetPlanner, robot: str, cell: int, begin: float, end: float) -> None:
    """Let time pass in which a robot stands in a cell, and its move client takes all lists."""
    now = begin
    while now < end:
        planner.handle(PoseSeen(robot, *GRID.centre(cell), 0.0), now)
        report = ClientReport(planner.state.robots[robot].revision, ClientState.IDLE)
        planner.handle(ReportSeen(robot, report), now)
        planner.handle(Tick(), now)
        planner.validate()
        now += 0.1


def test_no_cells_are_granted_before_known_robots_are_heard() -> None:
    planner = FleetPlanner(GRID)
    planner.handle(RobotsExpected({"Robot1": (), "Robot2": ()}), 0.0)
    sends: list[tuple[float, int]] = []
    revision = 0
    for step in range(120):
        now = step / 10
        if now >= 3.0:
            planner.handle(PoseSeen("Robot2", *GRID.centre(8), 0.0), now)
            planner.handle(ReportSeen("Robot2", ClientReport(0, ClientState.IDLE)), now)
        planner.handle(PoseSeen("Robot1", *GRID.centre(0), 0.0), now)
        out = planner.handle(ReportSeen("Robot1", ClientReport(revision, ClientState.IDLE)), now)
        out += planner.handle(GoalSet("Robot1", 5), now) if step == 20 else []
        out += planner.handle(Tick(), now)
        for one in out:
            if isinstance(one, SendCells) and one.robot == "Robot1":
                revision = one.revision
                sends.append((now, len(one.cells)))
    assert all(length <= 1 for at, length in sends if at < 3.0)
    assert any(length > 1 for at, length in sends if 3.0 <= at < 4.0)


def test_a_robot_that_stays_away_is_awaited_for_a_limited_time() -> None:
    planner = FleetPlanner(GRID)
    planner.handle(RobotsExpected({"Robot9": (8, 9)}), 0.0)
    assert planner.state.ledger.claims("Robot9") == {8, 9}
    wait = planner.settings.expect_timeout
    join(planner, "Robot1", 0, 0.0, 2.0)
    planner.handle(GoalSet("Robot1", 5), 2.0)
    join(planner, "Robot1", 0, 2.0, wait - 0.5)
    assert planner.state.ledger.granted("Robot1") == [0]
    join(planner, "Robot1", 0, wait - 0.5, wait + 1.0)
    assert len(planner.state.ledger.granted("Robot1")) > 1
    assert planner.state.ledger.claims("Robot9") == {8, 9}
    assert not {8, 9} & set(planner.state.ledger.route("Robot1"))


def test_cells_of_an_earlier_planner_stay_claimed_till_a_report() -> None:
    planner = FleetPlanner(GRID)
    claims = planner.state.ledger.claims
    planner.handle(RobotsExpected({"Robot1": (8, 9, 10)}), 0.0)
    planner.handle(PoseSeen("Robot1", *GRID.centre(8), 0.0), 0.1)
    assert claims("Robot1") == {8, 9, 10}
    planner.handle(ReportSeen("Robot1", ClientReport(7, ClientState.DRIVING, (8, 9))), 0.2)
    assert claims("Robot1") == {8, 9}


def test_a_cell_that_two_robots_may_be_in_stays_claimed_until_both_are_heard() -> None:
    """The next cells of one robot's path are cells in which others may stand."""
    planner = FleetPlanner(GRID)
    claims = planner.state.ledger.claims
    planner.handle(RobotsExpected({"Robot1": (0, 1, 2), "Robot2": (2, 3), "Robot3": (1, 7)}), 0.0)
    join(planner, "Robot1", 0, 0.1, 2.0)
    assert claims("Robot1") == {0}
    assert claims("Robot2") == {2, 3}
    assert claims("Robot3") == {1, 7}
    planner.validate()
    planner.handle(PoseSeen("Robot3", *GRID.centre(7), 0.0), 2.0)
    assert claims("Robot3") == {1, 7}
    planner.handle(GoalSet("Robot1", 5), 2.0)
    join(planner, "Robot1", 0, 2.0, planner.settings.expect_timeout + 2.0)
    assert claims("Robot2") == {2, 3}
    assert not {1, 2, 3, 7} & set(planner.state.ledger.granted("Robot1"))
    planner.handle(RobotRemoved("Robot3"), 9.0)
    assert claims("Robot2") == {2, 3}
    planner.validate()


def test_kept_robots_are_those_of_the_same_grid(tmp_path: Path) -> None:
    planner = FleetPlanner(GRID)
    join(planner, "Robot1", 8, 0.0, 2.0)
    kept = KnownRobots(tmp_path / "robots.json", ahead=4, boot="first")
    content = kept.content(planner.state, 100.0)
    assert content is not None
    kept.write(content, 100.0)
    assert kept.content(planner.state, 101.0) is None
    assert kept.content(planner.state, 101.0 + WRITTEN_EVERY) == content, "robots at rest become unknown"
    next_one = KnownRobots(tmp_path / "robots.json", 4, boot="first")
    assert next_one.read(GRID, 101.0) == ({"Robot1": (8,)}, "")
    assert next_one.read(GridMap(4, 6), 101.0) == ({}, "")
    robots, remark = next_one.read(GRID, 101.0 + KNOWN_FOR)
    assert robots == {}
    assert "1.0 h old and is ignored: check where Robot1" in remark
    (tmp_path / "robots.json").write_text("[1]")
    with pytest.raises(ValueError, match="does not hold the robots of a fleet"):
        kept.read(GRID, 101.0)


@pytest.mark.parametrize("boot", ["second", ""])
def test_robots_of_an_earlier_start_of_the_machine_count(tmp_path: Path, boot: str) -> None:
    """Its clock cannot say how old the file is: another robot would be sent through a robot that stands."""
    planner = FleetPlanner(GRID)
    join(planner, "Robot1", 8, 0.0, 2.0)
    kept = KnownRobots(tmp_path / "robots.json", ahead=4, boot="first" if boot else "")
    content = kept.content(planner.state, 90_000.0)
    assert content is not None
    kept.write(content, 90_000.0)
    for now in (5.0, 90_001.0, 500_000.0):
        robots, remark = KnownRobots(tmp_path / "robots.json", 4, boot=boot).read(GRID, now)
        assert robots == {"Robot1": (8,)}
        assert "the cells of Robot1 are claimed until these robots are heard" in remark
