"""A piece of a real log: the graph's steps are nearer to the reference than odometry's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rce_fleet.geometry.poses import relative
from rce_fleet.mapping.graph.mapper import GraphMapper
from rce_fleet.mapping.logs import read_carmen
from rce_fleet.mapping.trajectory import read_trajectory


@pytest.mark.slow
@pytest.mark.needs("data")
@pytest.mark.parametrize(("name", "count", "step"), [("intel", 80, 1), ("freiburg-079", 200, 6)])
def test_piece_of_a_real_log_is_mapped(rce_data: Path, name: str, count: int, step: int) -> None:
    records = read_carmen(rce_data / "lidar" / f"{name}.raw.log.gz").records[:count]
    _, reference = read_trajectory(rce_data / "lidar" / f"{name}.ref.csv")
    mapper = GraphMapper()
    for record in records:
        mapper.add(record)
    mapper.finish()
    odometry = np.array([record.odometry for record in records])
    assert mapper.trajectory().shape == (count, 3)

    def error(poses: NDArray[np.float64]) -> tuple[float, float]:
        true = relative(reference[: count - step], reference[step:count])
        found = relative(true, relative(poses[:-step], poses[step:]))
        turns = np.degrees(np.abs(found[:, 2]))
        return float(np.hypot(found[:, 0], found[:, 1]).mean()), float(turns.mean())

    shift, turn = error(mapper.trajectory())
    assert shift < 0.05
    assert turn < 1.0
    dead_shift, dead_turn = error(odometry)
    assert shift < dead_shift
    assert turn < dead_turn
