"""Cells that sensors found blocked are freed by sensors; those that people blocked only by people."""

from __future__ import annotations

import pytest

from rce_fleet.coordination.answers import Answer, answer_array, read_answer
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellFreed,
    CellsIgnored,
    Instruction,
    ObstacleGone,
    ObstacleSeen,
    PoseSeen,
    ReportSeen,
)
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.planning.grid import GridMap


@pytest.fixture
def planner() -> FleetPlanner:
    made = FleetPlanner(GridMap(4, 4))
    made.handle(PoseSeen("Robot1", 0.5, 0.5, 0.0), 0.0)
    return made


def blocked(instructions: list[Instruction]) -> list[tuple[int, ...]]:
    return [one.cells for one in instructions if isinstance(one, BlockedChanged)]


def test_a_sensed_cell_is_freed_when_it_is_seen_free(planner: FleetPlanner) -> None:
    assert blocked(planner.handle(ObstacleSeen("Robot1", (5, 6)), 1.0))[-1] == (5, 6)
    assert blocked(planner.handle(ObstacleGone("Robot1", (5, 9)), 2.0)) == [(6,)]
    assert set(planner.state.sensed) == {6}
    planner.validate()


def test_cells_that_are_seen_free_are_freed_together(planner: FleetPlanner) -> None:
    """With a list of all blocked cells for each of them, one robot could keep the planner busy."""
    planner.handle(ObstacleSeen("Robot1", (5, 6, 9, 10)), 1.0)
    assert blocked(planner.handle(ObstacleGone("Robot1", (5, 6, 6, 9, 5)), 2.0)) == [(10,)]
    assert set(planner.state.sensed) == {10}
    planner.validate()


def test_another_robot_may_see_that_a_cell_is_free(planner: FleetPlanner) -> None:
    planner.handle(ObstacleSeen("Robot1", (5,)), 1.0)
    planner.handle(PoseSeen("Robot2", 3.5, 3.5, 0.0), 1.5)
    assert blocked(planner.handle(ObstacleGone("Robot2", (5,)), 2.0)) == [()]


def ignored(planner: FleetPlanner, robot: str, cells: tuple[int, ...], now: float) -> str:
    """Report cells as blocked and free; return why both are ignored."""
    before = set(planner.state.blocked)
    out = planner.handle(ObstacleSeen(robot, cells), now) + planner.handle(ObstacleGone(robot, (5,)), now)
    assert planner.state.blocked == before
    planner.validate()
    reasons = [one.reason for one in out if isinstance(one, CellsIgnored) and one.robot == robot]
    assert reasons[0] == reasons[-1]
    return reasons[0]


def test_cells_of_robots_without_a_known_place_are_ignored(planner: FleetPlanner) -> None:
    """They would close aisles for the whole fleet."""
    planner.handle(ObstacleSeen("Robot1", (5,)), 1.0)
    assert ignored(planner, "Robot9", (6,), 1.0) == "it has sent no pose"
    planner.handle(ReportSeen("Robot2", ClientReport(0, ClientState.IDLE)), 1.0)
    assert ignored(planner, "Robot2", (6,), 1.0) == "it has sent no pose"
    planner.handle(PoseSeen("Robot2", 3.5, 3.5, 0.0, 2.5, 0.1), 2.0)
    assert "its pose is uncertain by 2.5 m" in ignored(planner, "Robot2", (6,), 2.0)
    planner.handle(PoseSeen("Robot1", 200.0, 0.5, 0.0), 2.0)
    assert "jumped" in ignored(planner, "Robot1", (6,), 2.0)


@pytest.mark.parametrize("jumps", [True, False])
def test_what_a_lost_robot_reported_of_late_is_free(planner: FleetPlanner, jumps: bool) -> None:
    """It was not where its poses said; what it reported long ago, or another robot since, stays blocked."""
    planner.handle(PoseSeen("Robot2", 3.5, 3.5, 0.0), 0.0)
    planner.handle(ObstacleSeen("Robot1", (5, 6, 9, 10)), 1.0)
    planner.handle(ObstacleSeen("Robot1", (6, 9)), 90.0)
    planner.handle(ObstacleSeen("Robot2", (9,)), 91.0)
    planner.handle(CellBlocked(10), 92.0)
    planner.handle(ObstacleSeen("Robot1", (10,)), 93.0)
    lost = PoseSeen("Robot1", 900.0, 0.5, 0.0) if jumps else PoseSeen("Robot1", 0.5, 0.5, 0.0, 2.5, 0.1)
    assert blocked(planner.handle(lost, 100.0))[-1] == (5, 9, 10)
    planner.validate()


def test_cells_that_a_robot_cannot_see_are_ignored() -> None:
    planner = FleetPlanner(GridMap(20, 20))
    planner.handle(PoseSeen("Robot1", 0.5, 0.5, 0.0), 0.0)
    out = planner.handle(ObstacleSeen("Robot1", (10, 12, 399, 400)), 1.0)
    assert planner.state.blocked == {10}
    why = [one.reason for one in out if isinstance(one, CellsIgnored)]
    assert why == ["cell 12 is farther from it than 10 m (obstacle_reach)"]
    planner.validate()


def test_a_cell_that_a_robot_is_in_held_that_robot(planner: FleetPlanner) -> None:
    """A sensor saw a robot that the planner did not know yet; a cell that a person blocked stays blocked."""
    planner.handle(CellBlocked(9), 1.0)
    planner.handle(ObstacleSeen("Robot1", (5,)), 1.0)
    assert blocked(planner.handle(PoseSeen("Robot2", 1.5, 1.5, 0.0), 2.0)) == [(9,)]
    planner.handle(PoseSeen("Robot3", 1.5, 2.5, 0.0), 3.0)
    assert planner.state.blocked == {9}
    planner.validate()


def test_sensors_do_not_free_what_a_person_blocked(planner: FleetPlanner) -> None:
    planner.handle(CellBlocked(5), 1.0)
    planner.handle(ObstacleSeen("Robot1", (5,)), 2.0)
    assert blocked(planner.handle(ObstacleGone("Robot1", (5,)), 3.0)) == []
    assert planner.state.blocked == {5}


def test_a_person_takes_a_sensed_cell_over(planner: FleetPlanner) -> None:
    planner.handle(ObstacleSeen("Robot1", (5,)), 1.0)
    planner.handle(CellBlocked(5), 2.0)
    planner.handle(ObstacleGone("Robot1", (5,)), 3.0)
    assert planner.state.blocked == {5}
    planner.handle(CellFreed(5), 4.0)
    assert planner.state.blocked == set()
    planner.validate()


def test_an_answer_carries_freed_cells_only_if_there_are_any() -> None:
    """Planners of the release before take answers of three parts only."""
    report = ClientReport(3, ClientState.IDLE, (1, 2), 1, None)
    for answer in (Answer(report, (4,)), Answer(report, (4,), (7, 8))):
        fields = answer_array(answer)
        dimensions = fields["layout"]["dim"]
        assert len(dimensions) == (4 if answer.freed else 3)
        labels, sizes = ([one[key] for one in dimensions] for key in ("label", "size"))
        assert read_answer(labels, sizes, fields["data"]) == answer
