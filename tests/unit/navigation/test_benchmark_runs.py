"""The seeded runs of the benchmarks: simulation, localization, navigation and safety stage together."""

from __future__ import annotations

from statistics import mean

import numpy as np
import pytest

from benchmarks.floor import Floor
from benchmarks.localization.runs import CAMERA, SHIPPED, drive
from benchmarks.navigation.drive import run


@pytest.mark.slow
def test_a_robot_reaches_its_goal_among_walkers() -> None:
    result = run(5010)
    assert result.reached, result.text
    assert result.contacts == 0
    assert result.driven < 1.3 * result.shortest
    assert result.error < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["lidar", "camera"])
def test_a_driving_robot_stays_localized(sensor: str) -> None:
    found = drive(5002, CAMERA if sensor == "camera" else SHIPPED, sensor, seconds=15.0)
    assert found.rmse_m < 0.15
    assert found.rmse_deg < 4.0
    assert 0.1 < mean(found.nees) < 10.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_floor() -> None:
    first, again = Floor(3, walkers=2), Floor(3, walkers=2)
    for floor in (first, again):
        floor.world.step(1.0)
    assert first.robot.pose == again.robot.pose
    assert first.world.all_boxes == again.world.all_boxes
    np.testing.assert_array_equal(first.scan().ranges, again.scan().ranges)
    np.testing.assert_array_equal(first.map.data, again.map.data)
    assert (Floor(4).map.data != first.map.data).any()
