"""When a fleet may get another grid of cells, and what it keeps."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.coordination.events import (
    CellBlocked,
    GoalSet,
    ModeSet,
    ObstacleGone,
    ObstacleSeen,
    RobotRemoved,
    RobotsExpected,
    Tick,
)
from rce_fleet.coordination.grid_change import carried_cells, next_planner, refuse_grid
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.move_client import ClientReport, MoveClient
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.maps.fleet_grid import fleet_grid, map_of_grid
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

FINER = GridMap(10, 10, 0.8)
TURNED = GridMap(8, 8, 1.0, origin=(8.0, 0.0), yaw=pi / 2)


def make(make_fleet: type[SimulatedClients], starts: list[int]) -> SimulatedClients:
    fleet = make_fleet(FleetPlanner(GridMap()), starts, 3, loss=0.0)
    fleet.send([])
    fleet.run(lambda: refuse_grid(fleet.planner, GridMap()) == "")
    return fleet


def change(fleet: SimulatedClients, grid: GridMap) -> None:
    """Change the grid of planner, robots and move clients."""
    assert refuse_grid(fleet.planner, grid) == ""
    planner, instructions = next_planner(fleet.planner, grid, fleet.now)
    fleet.restart_planner(planner)
    fleet.grid = grid
    fleet.blocked = set(planner.state.blocked)
    for robot, client in fleet.clients.items():
        fleet.robots[robot].grid = grid
        fleet.clients[robot] = MoveClient(grid, robot, fleet.now, ClientReport(client.report.revision))
    for instruction in instructions:
        fleet._carry_out(instruction)


@pytest.mark.parametrize("grid", [FINER, TURNED], ids=["finer", "turned"])
def test_robots_drive_on_the_new_grid(make_fleet: type[SimulatedClients], grid: GridMap) -> None:
    fleet = make(make_fleet, [0, 18, 63])
    change(fleet, grid)
    fleet.run(lambda: fleet.states() == [RobotState.IDLE] * 3)
    places = [grid.cell_at(robot.x, robot.y) for robot in fleet.robots.values()]
    assert [robot.cell for robot in fleet.planner.snapshot().robots] == places
    for number, goal in enumerate([55, 3, 22], start=1):
        assert fleet.ask(GoalSet(f"Robot{number}", goal)).ok
    fleet.run(fleet.all_arrived)


def test_a_driving_robot_forbids_the_change(make_fleet: type[SimulatedClients]) -> None:
    fleet = make(make_fleet, [0, 63])
    assert fleet.ask(GoalSet("Robot1", 7)).ok
    fleet.run(lambda: fleet.states()[0] is RobotState.DRIVING)
    assert "Robot1 is driving" in refuse_grid(fleet.planner, FINER)
    assert fleet.ask(GoalSet("Robot1", None)).ok
    assert "Robot1 is stopping" in refuse_grid(fleet.planner, FINER)
    fleet.run(lambda: refuse_grid(fleet.planner, GridMap()) == "")


def test_a_silent_robot_forbids_the_change(make_fleet: type[SimulatedClients]) -> None:
    fleet = make(make_fleet, [0])
    fleet.silent = {"Robot1"}
    fleet.run(lambda: fleet.states() == [RobotState.SILENT])
    assert "Robot1 is silent" in refuse_grid(fleet.planner, FINER)


def test_a_robot_that_was_not_heard_yet_forbids_the_change() -> None:
    """An earlier planner granted it cells. The planner of the new grid would not know of them."""
    planner = FleetPlanner(GridMap())
    planner.handle(RobotsExpected({"Robot2": (61, 62)}), 0.0)
    assert "Robot2 may be driving and has sent no pose yet" in refuse_grid(planner, FINER)
    planner.handle(RobotRemoved("Robot2"), 1.0)
    assert refuse_grid(planner, FINER) == ""


def test_robots_are_awaited_on_the_new_grid_too(make_fleet: type[SimulatedClients]) -> None:
    fleet = make_fleet(FleetPlanner(GridMap()), [0], 3, loss=0.0)
    fleet.tell(RobotsExpected({"Robot2": ()}))
    fleet.run(lambda: refuse_grid(fleet.planner, FINER) == "", limit=3.0)
    planner, _ = next_planner(fleet.planner, FINER, fleet.now)
    assert planner.expected == ["Robot2"]


def test_a_fleet_stays_paused_for_its_reason(make_fleet: type[SimulatedClients]) -> None:
    fleet = make(make_fleet, [0])
    assert fleet.ask(ModeSet(None, RobotMode.PAUSED, "visitors", "anna")).ok
    fleet.run(lambda: fleet.states() == [RobotState.PAUSED])
    before = fleet.planner.state
    change(fleet, FINER)
    after = fleet.planner.state
    assert (after.mode, after.mode_reason) == (RobotMode.PAUSED, before.mode_reason)
    assert "visitors" in after.reason_of(after.robots["Robot1"])
    fleet.run(lambda: fleet.states() == [RobotState.PAUSED])
    assert "visitors" in fleet.planner.snapshot().robots[0].reason


@pytest.mark.parametrize(
    ("grid", "words"),
    [
        (GridMap(40, 40, 0.5), "too small for robots with a radius of 0.22 m: choose at least 0.74 m"),
        (GridMap(8, 8, 1.0, origin=(3.0, 0.0)), "Robot1 would stand outside of the grid"),
        (GridMap(8, 8, 1.0, blocked=frozenset({0})), "Robot1 would stand in cell 0, which would be blocked"),
        (GridMap(4, 4, 2.0), "Robot1 and Robot2 would both be in cell 0"),
    ],
)
def test_a_grid_that_robots_do_not_fit_is_refused(
    make_fleet: type[SimulatedClients], grid: GridMap, words: str
) -> None:
    assert words in refuse_grid(make(make_fleet, [0, 1]).planner, grid)


def test_blocked_places_stay_blocked(make_fleet: type[SimulatedClients]) -> None:
    """A person's cells are freed by people only, also on the new grid."""
    fleet = make(make_fleet, [0])
    fleet.ask(CellBlocked(27))
    fleet.tell(ObstacleSeen("Robot1", (36,)))
    change(fleet, FINER)
    by_people = carried_cells(GridMap(), FINER, [27])
    sensed = carried_cells(GridMap(), FINER, [36]) - by_people
    assert fleet.planner.state.blocked == by_people | sensed
    fleet.tell(ObstacleGone("Robot1", tuple(by_people | sensed)))
    assert fleet.planner.state.blocked == by_people
    fleet.tell(Tick())
    fleet.planner.validate()


def test_cells_that_only_share_an_edge_are_not_carried() -> None:
    assert carried_cells(GridMap(), GridMap(), [0, 27]) == {0, 27}
    assert carried_cells(GridMap(), GridMap(16, 16, 0.5), [0]) == {0, 1, 16, 17}
    assert carried_cells(GridMap(16, 16, 0.5), GridMap(), [17]) == {0}


@given(
    size=st.floats(0.4, 2.0),
    yaw=st.floats(-pi, pi),
    x=st.floats(-3, 3),
    cell=st.integers(0, 63),
    seed=st.integers(0, 9),
)
def test_every_point_of_a_blocked_cell_is_carried(
    size: float, yaw: float, x: float, cell: int, seed: int
) -> None:
    """Points drawn within the cell, but not at its very edge, are in carried cells or outside of the grid."""
    old, new = GridMap(), GridMap(20, 20, size, origin=(x, -2.0), yaw=yaw)
    carried = carried_cells(old, new, [cell])
    corners = [new.point(row, column) for row in (0, 20) for column in (0, 20)]
    if any(old.cell_at(*corner) == cell for corner in corners):
        return  # the tip of the grid may lie between two of the points that are looked at
    row, column = old.place(cell)
    reach = size / 4  # a corner of a new cell may reach between two of the points that are looked at
    for up, along in np.random.default_rng(seed).uniform(0, 1, (20, 2)):
        at = old.point(row + up, column + along)
        touched = new.cells_touched(*at, reach)
        assert new.cell_at(*at) is None or touched & carried


@pytest.mark.parametrize("size", [1.0, 0.5, 2.0])
def test_the_map_of_a_grid_has_its_walls(size: float) -> None:
    grid = GridMap(4, 4, blocked=frozenset({0, 10}))
    again = fleet_grid(map_of_grid(grid), size)
    assert again.blocked == carried_cells(grid, again, grid.blocked)
    assert (again.rows, again.columns) == (4 / size, 4 / size)
