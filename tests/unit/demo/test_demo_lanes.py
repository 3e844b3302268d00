"""``rce demo --lanes``: where robots start and are sent, and what the planner is told."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.floor import FLOOR
from rce_fleet.demo.resources import Ports
from rce_fleet.demo.scenario import find_lanes, lane_scenario
from rce_fleet.demo.worlds import on_lanes, warehouse
from rce_fleet.nodes.planner_parameters import read_lane_graph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import LaneGraph
from rce_fleet.planning.planner import PlanningProblem, load_planner
from rce_fleet.planning.scenario import Scenario

EXAMPLE = Path(__file__).parents[3] / "configs" / "lanes.yaml"
RING = "{name: ring, path: [0, 3, 11, 8, 0], one_way: true}"
GRID = GridMap(2, 8)
SCEN = "version 1\n0\tm.map\t8\t2\t{start}\t0\t{goal}\t0\t1\n"


def found(file: Path, grid: GridMap = FLOOR) -> LaneGraph:
    lanes = find_lanes(file, grid, slam=False, blocked_cells=None)
    assert lanes is not None
    return lanes


def all_arrive(scenario: Scenario, lanes: LaneGraph) -> bool:
    graph = lanes.graph(scenario.grid)
    problem = PlanningProblem.of(graph, starts=scenario.starts, goals=scenario.goals)
    return load_planner("lacam").plan(problem).complete


def test_the_example_is_for_the_demos_floor() -> None:
    """All of its cells can be goals, and there is something of each kind of lane."""
    lanes = found(EXAMPLE)
    assert lanes.connected_part() == lanes.cells
    assert {lane.one_way for lane in lanes.lanes} == {True, False}
    assert any(lane.speed for lane in lanes.lanes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_robots_start_on_lanes_and_can_reach_their_goals(seed: int) -> None:
    lanes = found(EXAMPLE)
    scenario = lane_scenario(3, seed, grid=FLOOR, lanes=lanes)
    assert scenario == lane_scenario(3, seed, grid=FLOOR, lanes=lanes)
    assert scenario.grid == FLOOR
    assert not scenario.boxes
    assert all_arrive(scenario, lanes)


@pytest.mark.slow
def test_the_planner_gets_the_lanes_themselves() -> None:
    """It is in a container, which does not see the file."""
    lanes = found(EXAMPLE)
    scenario = lane_scenario(3, 0, grid=FLOOR, lanes=lanes)
    config = DemoConfig(scenario, 0, Ports(), Path("/folder"), lanes=lanes)
    assert read_lane_graph(config.planner_parameters, FLOOR, 0.18) == (lanes, [])
    assert config.goal_cells == sorted(lanes.cells)
    without = DemoConfig(scenario, 0, Ports(), Path("/folder"))
    assert "lanes" not in without.planner_parameters
    assert set(without.goal_cells) == set(FLOOR.free)


@pytest.mark.slow
def test_lanes_that_lead_away_are_no_goals(tmp_path: Path) -> None:
    """A robot could not come back from there, or not get there."""
    file = tmp_path / "lanes.yaml"
    file.write_text(
        f"lanes: [{RING}, {{path: [3, 5], one_way: true}}, {{path: [10, 8], one_way: true, cost: 2}}]"
    )
    with pytest.raises(DemoError, match="both lead from cell"):
        found(file, GRID)
    file.write_text(f"lanes: [{RING}, {{path: [3, 5], one_way: true}}, {{path: [14, 11], one_way: true}}]")
    lanes = found(file, GRID)
    assert lanes.connected_part() == {0, 1, 2, 3, 8, 9, 10, 11}
    for seed in range(8):
        scenario = lane_scenario(3, seed, grid=GRID, lanes=lanes)
        assert {*scenario.starts, *scenario.goals} <= lanes.connected_part()
        assert all_arrive(scenario, lanes), "on a ring no robot can pass another one"
    with pytest.raises(DemoError, match=re.escape("--lanes: 5 robots do not fit into 8 cells")):
        lane_scenario(5, 0, grid=GRID, lanes=lanes)


def test_starts_and_goals_of_a_file_are_on_lanes(tmp_path: Path) -> None:
    file, scen = tmp_path / "lanes.yaml", tmp_path / "m.scen"
    file.write_text(f"lanes: [{RING}, {{path: [3, 5], one_way: true}}]")
    lanes = found(file, GRID)
    scen.write_text(SCEN.format(start=0, goal=2))
    scenario = lane_scenario(1, 0, grid=GRID, lanes=lanes, scen=scen)
    assert len(scenario.starts) == 1
    scen.write_text(SCEN.format(start=0, goal=5))
    with pytest.raises(DemoError, match=r"m\.scen: from cell \d+ lanes do not lead to all others and back"):
        lane_scenario(1, 0, grid=GRID, lanes=lanes, scen=scen)


def test_lanes_without_a_way_back_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "lanes.yaml"
    file.write_text("lanes: [{path: [0, 3], one_way: true}]")
    with pytest.raises(DemoError, match="from no cell lanes lead to another one and back"):
        lane_scenario(1, 0, grid=GRID, lanes=found(file, GRID))


def test_robots_that_cannot_pass_each_other_keep_their_order(tmp_path: Path) -> None:
    """On a lane without a bay."""
    file = tmp_path / "lanes.yaml"
    file.write_text("lanes: [{path: [0, 3]}]")
    scenario = lane_scenario(2, 0, grid=GRID, lanes=found(file, GRID))
    assert all_arrive(scenario, found(file, GRID))
    with pytest.raises(DemoError, match="robots do not fit into 4 cells"):
        lane_scenario(3, 0, grid=GRID, lanes=found(file, GRID))


def test_docks_and_chargers_beside_lanes_are_not_used(tmp_path: Path) -> None:
    world = warehouse()
    first, second = world.docks[:2]
    file = tmp_path / "lanes.yaml"
    file.write_text(f"lanes: [{{path: [{first}, {second}]}}]")
    kept = on_lanes(world, found(file, world.grid))
    assert (kept.docks, kept.shelves, kept.chargers) == ((first, second), (), ())
    assert kept.grid == world.grid


@pytest.mark.parametrize(
    ("text", "slam", "blocked_cells", "expected"),
    [
        (None, False, None, "cannot be read: No such file or directory"),
        ("lanes: [{path: [0, 9]}]", False, None, "lanes[0].path[1]: cell 9 is neither in the row"),
        (
            "lanes: [{path: [0, 3], width: 0.3}]",
            False,
            None,
            "all 1 lanes are narrower than the robots, 0.36 m",
        ),
        ("lanes: [{path: [0, 3]}]", True, None, "--lanes lie on a map: use it without --slam"),
        ("lanes: [{path: [0, 3]}]", False, 1, "--blocked-cells cuts lanes, and with them goals"),
    ],
)
def test_lanes_that_cannot_be_used_are_named(
    tmp_path: Path, text: str | None, slam: bool, blocked_cells: int | None, expected: str
) -> None:
    file = tmp_path / "lanes.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(DemoError, match=re.escape(expected)):
        find_lanes(file, GRID, slam=slam, blocked_cells=blocked_cells)
    assert find_lanes(None, GRID, slam=slam, blocked_cells=blocked_cells) is None
