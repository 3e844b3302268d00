"""CARMEN logs and trajectories."""

from __future__ import annotations

import gzip
from math import cos, inf, isclose, pi, sin
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.exceptions import LogError
from rce_fleet.mapping.logs import read_carmen
from rce_fleet.mapping.records import no_return_range
from rce_fleet.mapping.trajectory import complete_trajectory, read_trajectory, write_trajectory

TAIL = "1.0 2.0 0.5 1.1 2.1 0.6 {time} host {time}"


def flaser(*ranges: float, time: float = 5.0) -> str:
    return f"FLASER {len(ranges)} {' '.join(map(str, ranges))} {TAIL.format(time=time)}\n"


def odom(x: float, y: float, yaw: float, time: float) -> str:
    return f"ODOM {x} {y} {yaw} 0 0 0 {time} host {time}\n"


def write(folder: Path, text: str, *, packed: bool = False) -> Path:
    file = folder / "run.log"
    file.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    return file


@pytest.mark.parametrize("packed", [False, True])
def test_records_have_beams_times_and_odometry(tmp_path: Path, *, packed: bool) -> None:
    text = "# a log\nPARAM laser_max 80\nNEFF 3\n" + flaser(1.0, 2.0, 3.0, 81.83) + flaser(1.5, 2.0, time=4.0)
    log = read_carmen(write(tmp_path, text, packed=packed))
    first, second = log.records
    assert log.faults == []
    assert (first.index, first.time, first.odometry) == (0, 5.0, (1.1, 2.1, 0.6))
    assert first.ranges.tolist() == [1.0, 2.0, 3.0, inf]
    assert (first.angle_min, first.angle_increment) == (-pi / 2, pi / 4)
    assert (second.index, second.time) == (1, 4.0)


@pytest.mark.parametrize(("beams", "steps"), [(180, 180), (181, 180), (360, 360), (361, 360)])
def test_beams_span_half_a_circle(tmp_path: Path, beams: int, steps: int) -> None:
    (record,) = read_carmen(write(tmp_path, flaser(*([2.0] * (beams - 1)), 81.0))).records
    assert isclose(record.angle_increment, pi / steps)
    assert isclose(record.angles()[90 * beams // 180], 0, abs_tol=1e-9)


def test_odometry_comes_from_the_odom_before(tmp_path: Path) -> None:
    text = flaser(1.0, 9.0) + odom(1, 0, 0, 1.0) + flaser(1.0, time=1.25) + odom(2, 0, 1, 2.0)
    text += odom(9, 0, 0, 8.0) + flaser(1.0, time=3.0) + odom(7, 0, 0, 9.5)
    found = [record.odometry for record in read_carmen(write(tmp_path, text)).records]
    assert found == [(1, 0, 0), (1.25, 0, 0.25), (9, 0, 0)]


ROBOT = "3.0 1.2 0.5 3.0 1.0 0.5 0 0 0.2 0.3"
"""Of a robot whose laser is 0.2 m in the map's direction of y from its base."""


@pytest.mark.parametrize(
    ("remissions", "axis"),
    [("", ""), ("0 ", ""), ("0 ", " 1e6"), ("3 10 20 30 ", ""), ("3 10 20 30 ", " 1e6")],
)
def test_a_robotlaser_has_its_own_angles_range_and_laser(tmp_path: Path, remissions: str, axis: str) -> None:
    line = f"ROBOTLASER1 5 -2.0 4.0 0.5 20.0 0.01 0 3 1.0 19.9 20.0 {remissions}{ROBOT}{axis} 7.5 host 0.1\n"
    (record,) = read_carmen(write(tmp_path, "SYNC start\n" + line + line.replace("LASER1", "LASER2"))).records
    assert (record.time, record.odometry) == (7.5, (3.0, 1.0, 0.5))
    assert (record.angle_min, record.angle_increment) == (-2.0, 0.5)
    assert record.ranges.tolist() == [1.0, inf, inf]  # 19.9 is within half a percent of the greatest reading
    assert record.laser == pytest.approx((0.2 * sin(0.5), 0.2 * cos(0.5), 0.0))


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("ROBOTLASER1 0 0 3\n", "expected at least 8 fields"),
        ("ROBOTLASER1 0 0 3 0.1 20 0 0 x 1\n", "expected a number of ranges"),
        (f"ROBOTLASER1 0 0 3 0.1 20 0 0 9 1.0 {ROBOT} 1 host 1\n", "expected 9 ranges"),
        (
            f"ROBOTLASER1 0 0 3 0 20 0 0 1 1.0 0 {ROBOT} 1 host 1\n",
            "angular_resolution: expected more than 0",
        ),
        (f"ROBOTLASER1 0 nan 3 1 20 0 0 1 1.0 0 {ROBOT} 1 host 1\n", "start_angle: expected a finite number"),
    ],
)
def test_a_faulty_robotlaser_is_reported_and_left_out(tmp_path: Path, line: str, fault: str) -> None:
    log = read_carmen(write(tmp_path, flaser(1.0, 2.0) + line))
    assert len(log.records) == 1
    assert "run.log:2: ROBOTLASER1 left out" in log.faults[0]
    assert fault in log.faults[0]


def test_faulty_lines_are_reported_and_left_out(tmp_path: Path) -> None:
    faulty = [
        "FLASER 3 1.0 2.0\n",
        "FLASER x\n",
        "ODOM 1 nan 0 0 0 0 1\n",
        "ODOM 1\n",
        flaser(1.0).replace("1.1", "?"),
    ]
    log = read_carmen(write(tmp_path, "".join(faulty) + flaser(1.0, 4.0) + "TRUEPOS 1 2\n"))
    assert len(log.records) == 1
    assert [fault.partition(": ")[0] for fault in log.faults] == [f"{log.name}:{n}" for n in range(1, 6)]


def test_readings_that_are_not_distances_are_inf(tmp_path: Path) -> None:
    (record,) = read_carmen(
        write(tmp_path, "FLASER 5 nan inf -1 0 2.0 " + TAIL.format(time=1) + "\n" + "\n")
    ).records
    assert np.isinf(
        record.ranges
    ).all()  # 2.0 is the greatest reading of the log, which is not a distance either


def test_a_damaged_gzip_keeps_what_was_read(tmp_path: Path) -> None:
    text = "".join(flaser(*np.random.default_rng(n).uniform(1, 9, 180), time=n) for n in range(200))
    file = tmp_path / "run.log.gz"
    packed = gzip.compress(text.encode())
    file.write_bytes(packed[: len(packed) // 2])
    log = read_carmen(file)
    assert 0 < len(log.records) < 200
    assert "ends early" in log.faults[-1]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "empty"),
        ("ODOM 0 0 0 0 0 0 1 host 1\n", "expected FLASER or ROBOTLASER1 records, found 1 ODOM"),
        ("RAWLASER1 0 1 2\n", "found 1 RAWLASER1"),
        ("FLASER 9\n", "first of 1 faults"),
    ],
)
def test_logs_without_scans_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(LogError, match=reason):
        read_carmen(write(tmp_path, text))


def test_a_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"gone\.log: cannot be read: No such file"):
        read_carmen(tmp_path / "gone.log")


def test_no_return_is_found_in_the_readings() -> None:
    draw = np.random.default_rng(1)
    walls = [draw.uniform(0.5, 20, 180) for _ in range(50)]
    codes = [np.append(scan, [81.83, 81.91, 81.83]) for scan in walls]
    cut = [np.append(scan, [50.0, 50.0, 50.0]) for scan in walls]
    both = [np.append(scan, [50.0, 50.0, 50.0]) for scan in walls] + [np.array([81.91])]
    assert 20 < no_return_range(codes) < 81.83
    assert 20 < no_return_range(cut) < 50
    assert no_return_range(both) == 50
    assert 19.8 < no_return_range(walls) < 20
    assert no_return_range([]) == inf


poses = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3))


@given(st.lists(poses, min_size=1, max_size=30), poses, st.data())
def test_exact_odometry_completes_a_trajectory(
    way: list[tuple[float, ...]], at: tuple[float, ...], data: st.DataObject
) -> None:
    """If the odometry is right, all poses follow from any of them."""
    odometry = np.array(way)
    turn = at[2]
    rotated = odometry[:, :2] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    true = np.column_stack((rotated + at[:2], odometry[:, 2] + turn))
    known = np.array(sorted(data.draw(st.sets(st.integers(0, len(way) - 1), min_size=1))))
    found = complete_trajectory(odometry, known, true[known])
    assert np.allclose(found[:, :2], true[:, :2])
    assert np.allclose(np.cos(found[:, 2] - true[:, 2]), 1)


def test_what_odometry_misses_is_spread_over_the_way() -> None:
    odometry = np.array([[0.0, 0, 0], [1, 0, 0], [4, 0, 0], [4, 0, 0]])
    found = complete_trajectory(odometry, np.array([0, 2]), np.array([[0.0, 0, 0], [4, 0.4, 0.2]]))
    assert np.allclose(found[1], [1, 0.1, 0.05])
    assert np.allclose(found[2:], [4, 0.4, 0.2])


def test_a_trajectory_file_round_trips(tmp_path: Path) -> None:
    file = tmp_path / "trajectory.csv"
    write_trajectory(file, [1.0, 0.5], np.array([[1.0, 2, 3], [-1, -2, -3]]))
    assert file.read_text().splitlines() == [
        "scan,time,x,y,theta",
        "0,1.000000,1.000000,2.000000,3.000000",
        "1,0.500000,-1.000000,-2.000000,-3.000000",
    ]
    times, poses_read = read_trajectory(file)
    assert times.tolist() == [1.0, 0.5]
    assert poses_read.tolist() == [[1, 2, 3], [-1, -2, -3]]


@pytest.mark.parametrize(
    "text", ["", "a,b\n", "scan,time,x,y,theta\n1,2,3\n", "scan,time,x,y,theta\n1,2,3,4,x\n"]
)
def test_a_faulty_trajectory_file_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "trajectory.csv"
    file.write_text(text)
    with pytest.raises(LogError, match="expected"):
        read_trajectory(file)
