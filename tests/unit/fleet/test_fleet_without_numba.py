"""Fifty robots with the plain loops: without the extra ``rce[compiled]`` a fleet has to work too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from rce_fleet import compiled
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.movingai import read_map, read_scenario
from rce_fleet.planning.planner import PlanningProblem, load_planner

if TYPE_CHECKING:
    from pathlib import Path

    from unit.fleet.conftest import SimulatedClients

    from rce_fleet.planning.grid import GridMap

pytestmark = pytest.mark.needs("data")
ROBOTS = 50


@pytest.fixture(autouse=True)
def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(compiled.COMPILED, "no")
    for loop in compiled._kernels:  # tests before this one may have loops compiled for a whole file
        loop._used = loop.numpy


def scenario(folder: Path, name: str, *, short: bool = False) -> tuple[GridMap, list[int], list[int]]:
    """Return a map of MovingAI's benchmarks, with starts and goals; with ``short``, of the shortest ways."""
    grid = read_map(folder / "maps" / f"{name}.map")
    rows = read_scenario(folder / "maps" / f"{name}-random-1.scen", grid)
    if short:
        rows.sort(key=lambda row: sum(map(abs, np.subtract(grid.centre(row.start), grid.centre(row.goal)))))
    rows = rows[:ROBOTS]
    return grid, [row.start for row in rows], [row.goal for row in rows]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random-32-32-20", "warehouse-10-20-10-2-1"])
@pytest.mark.parametrize("rotations", [True, False])
def test_plan_for_fifty_robots_has_no_conflict(rce_data: Path, name: str, *, rotations: bool) -> None:
    grid, starts, goals = scenario(rce_data, name)
    problem = PlanningProblem.of(PlanningGraph.from_grid(grid), starts, goals, rotations=rotations)
    joint = load_planner("lacam").plan(problem)
    assert joint.complete
    assert not any(loop.is_compiled for loop in compiled._kernels)
    paths = [joint.path(robot) for robot in range(ROBOTS)]
    assert check_plan(grid, paths, starts=starts, goals=goals, rotations=rotations) == []
    assert np.array_equal(joint.cells[-1], goals)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_fifty_robots_reach_their_goals(rce_data: Path, make_fleet: type[SimulatedClients]) -> None:
    """Planner, move clients and robots; after each step the fleet checks that no two robots touch."""
    grid, starts, goals = scenario(rce_data, "random-32-32-20", short=True)
    fleet = make_fleet(FleetPlanner(grid), starts, 1, loss=0.0)
    fleet.send(goals)
    fleet.run(fleet.all_arrived)
    cells = {robot.id: robot.cell for robot in fleet.planner.snapshot().robots}
    assert cells == {f"Robot{number}": goal for number, goal in enumerate(goals, start=1)}
    assert not any(loop.is_compiled for loop in compiled._kernels)
