"""What robots drive, step by step, checked by the independent checker: also how near they follow."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest

from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import Lane, LaneGraph

if TYPE_CHECKING:
    from unit.fleet.conftest import SimulatedClients

HALL = GridMap(10, 12)
LANES = LaneGraph(
    (
        *(Lane(f"row {row}", tuple(range(12 * row, 12 * row + 12))) for row in range(10)),
        Lane("down", tuple(range(0, 120, 12)), one_way=True),
        Lane("up", tuple(range(119, 0, -12)), one_way=True),
        Lane("across", tuple(range(5, 120, 12)), speed=0.5),
    )
)
"""Rows, a slower lane across them, and one at each end that is driven in one direction."""
FOLLOWING = 6
"""Steps for which a cell is empty before the next robot enters it: 0.6 s.

The one before drives on to 0.15 m before the next centre, and it as far to the border: 0.7 m at 0.9 m/s.
"""


def drive(fleet: SimulatedClients, goals: list[int]) -> list[list[int]]:
    """Send the robots to their goals; return the cell of each robot at each step."""
    paths: list[list[int]] = [[] for _ in fleet.robots]

    def note() -> bool:
        for robot, path in zip(fleet.robots.values(), paths, strict=True):
            cell = fleet.grid.cell_at(robot.x, robot.y)
            assert cell is not None
            path.append(cell)
        return fleet.all_arrived()

    fleet.send(goals)
    fleet.run(note)
    return paths


@pytest.mark.slow
def test_many_robots_keep_their_distance_on_lanes(make_fleet: type[SimulatedClients]) -> None:
    """24 robots, three of them without a move client that answers, on lanes with directions and speeds."""
    seed = 2
    rng = Random(seed)
    planner = FleetPlanner(LANES.restrict(HALL), FleetSettings(), lanes=LANES)
    cells = planner.state.grid.free
    fleet = make_fleet(planner, rng.sample(cells, 24), seed, loss=0.1)
    fleet.mute = {"Robot1", "Robot2", "Robot3"}
    paths = drive(fleet, rng.sample(cells, 24))
    assert all(planner.state.robots[robot].pose_only for robot in fleet.mute)
    one_way = LANES.closed(planner.state.grid)
    assert check_plan(planner.state.grid, paths, one_way=one_way, following=FOLLOWING) == []


@pytest.mark.parametrize("planner", ["lacam", "dijkstra"])
def test_robots_in_a_row_keep_their_distance(make_fleet: type[SimulatedClients], planner: str) -> None:
    """Six robots follow each other around a corner."""
    chosen = FleetSettings(planner=planner, resolve_deadlocks=True)
    fleet = make_fleet(FleetPlanner(GridMap(), chosen), list(range(6)), 1, loss=0.0)
    paths = drive(fleet, [39, 47, 55, 63, 62, 61])
    assert check_plan(fleet.grid, paths, following=FOLLOWING) == []
