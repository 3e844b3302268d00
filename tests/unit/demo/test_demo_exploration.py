"""What ``rce demo --slam`` makes of the explored map: files, the fleet's grid, and the report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.exploration import Explored, block_cells, grid_of, without_robots
from rce_fleet.demo.floor import FLOOR
from rce_fleet.demo.resources import Ports
from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.agreement import MapAgreement
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ros_map import load_map
from rce_fleet.station.client import StationClient


def config_in(folder: Path, *, slam: bool = True) -> DemoConfig:
    return DemoConfig(choose_scenario(2, 5), 5, Ports(), folder, slam=slam)


def test_without_a_map_the_planner_knows_no_wall(tmp_path: Path) -> None:
    assert "walls" not in config_in(tmp_path).planner_parameters
    assert config_in(tmp_path, slam=False).planner_parameters["walls"] == sorted(FLOOR.blocked)


def test_the_true_map_is_only_for_the_judge(tmp_path: Path) -> None:
    config = config_in(tmp_path)
    config.write_scene()
    assert config.true_map_file.exists()
    assert not config.map_file.exists()


def test_the_grid_has_the_walls_and_boxes_of_the_map(tmp_path: Path) -> None:
    config = config_in(tmp_path)
    config.write_scene()
    made = load_map(config.true_map_file)
    expected = FLOOR.blocked | config.scenario.boxes
    assert config.scenario.boxes
    assert grid_of(made, config) == expected
    noisy = made.data.copy()
    noisy[:, :-1][made.data[:, 1:] == 100] = 100  # walls are drawn a cell too thick
    assert grid_of(OccupancyMap(noisy, made.resolution, made.origin), config) == expected


def test_the_cell_of_a_dock_is_never_blocked(tmp_path: Path) -> None:
    """A robot that hid its surroundings from the explorer can leave its dock."""
    config = config_in(tmp_path)
    data = np.full((160, 160), 100, np.int8)
    data[:20, :20] = 0  # only one cell is free
    blocked = grid_of(OccupancyMap(data, 0.05), config)
    assert blocked == frozenset(range(1, 64)).difference(config.scenario.starts)


def test_robots_at_their_docks_are_not_on_the_map() -> None:
    data = np.zeros((60, 60), np.int8)
    data[28:33, 28:33] = 100
    data[0] = 100
    cleaned = without_robots(OccupancyMap(data, 0.05, Pose(-1.0, 2.0, 0.0)), [(0.5, 3.5)])
    assert not cleaned.occupied[1:].any()
    assert cleaned.occupied[0].all()


def test_the_report_tells_time_agreement_and_cells() -> None:
    explored = Explored(61.23, MapAgreement(0.99912, 1.0, 0.0123, 0.05), Pose(0.5, 1.5, 0.1), (3, 9))
    assert explored.as_json() == {
        "seconds": 61.2,
        "explored": 0.9991,
        "right": 1.0,
        "wall_error_m": 0.0123,
        "wall_error_p95_m": 0.05,
        "blocked_cells": [3, 9],
    }
    assert explored.initial_pose == {"initial_pose_x": 0.5, "initial_pose_y": 1.5, "initial_pose_a": 0.1}


class Station(StationClient):
    """Answers as a test says."""

    def __init__(self, *answers: Exception | None) -> None:
        self.answers = list(answers)
        self.asked: list[int] = []

    async def set_blocked(self, cell: int, *, blocked: bool) -> None:
        assert blocked
        self.asked.append(cell)
        answer = self.answers.pop(0) if self.answers else None
        if answer is not None:
            raise answer


async def test_cells_are_blocked_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_fleet.demo.exploration.RETRY_S", 0.0)
    said: list[str] = []
    busy, refused = StationUnavailableError("starting"), RequestRefusedError("Robot1 is in cell 4")
    station = Station(busy, None, refused)
    await block_cells(station, (3, 4, 5), said.append)
    assert station.asked == [3, 3, 4, 5]
    assert said == ["refused: Robot1 is in cell 4"]
    with pytest.raises(DemoError, match="cell 7 cannot be blocked: gone"):
        await block_cells(Station(*[StationUnavailableError("gone")] * 99), (7,), said.append)
