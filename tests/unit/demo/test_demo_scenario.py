"""What the demo drives on."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.floor import FLOOR
from rce_fleet.demo.scenario import MIN_LONGEST_PATH, choose_scenario
from rce_fleet.demo.worlds import find_world, warehouse
from rce_fleet.planning.dijkstra import shortest_path

MAP = "type octile\nheight 2\nwidth 3\nmap\n...\n.@.\n"
SCEN = "version 1\n0\tm.map\t3\t2\t0\t0\t2\t1\t3\n0\tm.map\t3\t2\t2\t0\t0\t1\t3\n"


@pytest.mark.slow
@pytest.mark.parametrize("robots", [1, 3, 8])
@pytest.mark.parametrize("seed", range(25))
def test_some_robot_has_a_long_way(robots: int, seed: int) -> None:
    scenario = choose_scenario(robots, seed)
    assert len(scenario.robots) == robots
    assert len(scenario.boxes) == 3
    assert not scenario.boxes & {*scenario.starts, *scenario.goals}
    grid = scenario.grid.with_blocked(scenario.grid.blocked | scenario.boxes)
    ways = [
        shortest_path(grid, start, goal) for start, goal in zip(scenario.starts, scenario.goals, strict=True)
    ]
    assert all(ways)
    assert max(len(way or ()) for way in ways) >= MIN_LONGEST_PATH


def test_a_seed_draws_the_same_again() -> None:
    assert choose_scenario(3, 7) == choose_scenario(3, 7)
    assert choose_scenario(3, 7) != choose_scenario(3, 8)


def test_the_floor_has_eight_by_eight_cells_and_walls() -> None:
    assert (FLOOR.rows, FLOOR.columns, len(FLOOR)) == (8, 8, 64)
    assert FLOOR.blocked
    assert FLOOR.connected()


def test_too_many_robots_are_refused() -> None:
    with pytest.raises(DemoError, match="do not fit"):
        choose_scenario(60, 0)


def test_a_benchmark_gives_starts_and_goals(tmp_path: Path) -> None:
    (tmp_path / "m.map").write_text(MAP)
    (tmp_path / "m.scen").write_text(SCEN)
    scenario = choose_scenario(2, 0, grid=find_world(str(tmp_path / "m.map")).grid, scen=tmp_path / "m.scen")
    assert scenario.starts == (0, 2)
    assert scenario.goals == (5, 3)
    assert scenario.grid.blocked == {4}
    assert not scenario.boxes


def test_a_benchmark_with_too_few_rows_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.map").write_text(MAP)
    (tmp_path / "m.scen").write_text(SCEN)
    with pytest.raises(DemoError, match="2 rows"):
        choose_scenario(3, 0, grid=find_world(str(tmp_path / "m.map")).grid, scen=tmp_path / "m.scen")


def test_file_that_is_not_a_map_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.map").write_text("hello")
    with pytest.raises(DemoError, match=r"^[^:]*m\.map, line 1: "):
        find_world(str(tmp_path / "m.map"))


def test_the_warehouse_has_room_for_a_thousand_robots() -> None:
    world = warehouse()
    assert (world.grid.rows, world.grid.columns) == (62, 104)
    assert world.grid.connected()
    assert world.grid.blocked.isdisjoint((*world.docks, *world.shelves, *world.chargers))
    assert len(set(world.docks)) + len(set(world.shelves)) > 2000
    scenario = choose_scenario(1000, 5, grid=find_world("warehouse").grid)
    assert len({*scenario.starts}) == len({*scenario.goals}) == 1000
    assert not scenario.boxes
    assert scenario == choose_scenario(1000, 5, grid=world.grid)


def test_an_unknown_world_is_refused_with_the_known_ones() -> None:
    with pytest.raises(DemoError, match=r"no world 'wherehouse' .*floor, warehouse"):
        find_world("wherehouse")
