"""``rce map``: logs in, files out."""

from __future__ import annotations

import gzip
import json
import threading
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from math import nan
from pathlib import Path
from random import Random

import numpy as np
import pytest
import typer
from support.lidar_drive import FRONT, START, drive, rooms, write_bag, write_carmen
from typer.testing import CliRunner, Result

from rce_fleet import compiled
from rce_fleet.exceptions import LogError
from rce_fleet.geometry.poses import compose
from rce_fleet.mapping.gmapping.mapper import ParticleMapper
from rce_fleet.mapping.gmapping.parameters import FilterParameters
from rce_fleet.mapping.mapper import Mapper
from rce_fleet.mapping.trajectory import read_trajectory, write_trajectory
from rce_fleet.maps.ros_map import load_map, save_map
from rce_fleet.offline import commands, outputs
from rce_fleet.offline.inputs import read_log

FILES = ["map.pgm", "map.yaml", "report.json", "trajectory.csv"]


@pytest.fixture(autouse=True)
def few_particles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Map with few particles and without compiling: quick."""

    def mapper(algorithm: commands.Algorithm, seed: int) -> Mapper:
        return ParticleMapper(FilterParameters(particles=2, linear_update=0.2, angular_update=0.2), seed=seed)

    monkeypatch.setattr(commands, "_mapper", mapper)
    monkeypatch.setenv(compiled.COMPILED, "no")


def run(*args: Path | str, command: Callable[..., None] = commands.map_log) -> Result:
    app = typer.Typer()
    app.command()(command)
    return CliRunner().invoke(app, [str(each) for each in args])


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


@pytest.mark.slow
def test_a_log_becomes_a_map_and_a_trajectory(tmp_path: Path) -> None:
    true, records = drive()
    write_carmen(tmp_path / "run.log", records)
    (tmp_path / "run.log").write_bytes(gzip.compress((tmp_path / "run.log").read_bytes()))
    result = run(tmp_path / "run.log", "--output", tmp_path / "new" / "out", "--with", "gmapping")
    assert result.exit_code == 0, result.output
    assert "60 of 60 scans" in result.output
    folder = tmp_path / "new" / "out"
    assert names(folder) == FILES
    times, poses = read_trajectory(folder / "trajectory.csv")
    assert times.tolist() == [record.time for record in records]
    assert np.hypot(*(poses - true)[:, :2].T).mean() < 0.12
    assert (load_map(folder / "map.yaml").values_at(true[:, :2]) == 0).all()
    report = json.loads((folder / "report.json").read_text())
    assert sorted(report) == ["log_seconds", "loop_closures", "scans", "seconds"]
    assert (report["scans"], report["log_seconds"]) == (60, 59)


@pytest.mark.parametrize("row", ["5", "1,2,3", "1,2,3,4,x", "", "1,2,3,4,5,6"])
def test_a_faulty_row_of_a_trajectory_is_told_with_its_line(tmp_path: Path, row: str) -> None:
    path = tmp_path / "trajectory.csv"
    write_trajectory(path, [0.0], np.zeros((1, 3)))
    with path.open("a") as stream:
        stream.write(f"{row}\r\n")
    with pytest.raises(LogError, match=f"{path}:3: expected 5 numbers"):
        read_trajectory(path)


@pytest.mark.slow
def test_a_bag_becomes_a_map(tmp_path: Path) -> None:
    true, records = drive(laser=FRONT)
    write_bag(tmp_path / "run.bag", records, scan="/front/scan")
    result = run(tmp_path / "run.bag", "--output", tmp_path, "--with", "gmapping", "--scan", "/front/scan")
    assert result.exit_code == 0, result.output
    _, poses = read_trajectory(tmp_path / "trajectory.csv")
    assert np.hypot(*(poses - true)[:, :2].T).mean() < 0.12


@pytest.mark.slow
def test_a_bag_has_the_records_that_were_written(tmp_path: Path) -> None:
    _, records = drive(laser=FRONT)
    write_bag(tmp_path / "run.bag", records)
    found = read_log(tmp_path / "run.bag")
    assert found.faults == []
    for mine, other in zip(records, found.records, strict=True):
        assert np.allclose(mine.ranges, other.ranges, atol=1e-5)
        assert np.allclose(mine.odometry, other.odometry)
        assert np.allclose(mine.laser, other.laser)
        assert np.isclose(mine.time, other.time)


def test_a_laser_of_a_bag_may_be_upside_down(tmp_path: Path) -> None:
    _, records = drive(4, laser=FRONT)
    write_bag(tmp_path / "run.bag", records, upside_down=True)
    found = read_log(tmp_path / "run.bag")
    assert found.faults == []
    for mine, other in zip(records, found.records, strict=True):
        assert other.angle_increment < 0
        assert np.allclose(mine.points(), other.points()[::-1], atol=1e-4)


@pytest.mark.slow
def test_wrong_topics_of_a_bag_are_named(tmp_path: Path) -> None:
    write_bag(tmp_path / "run.bag", drive()[1], scan="/laser", odometry="/wheels")
    with pytest.raises(
        LogError, match=r"no topic /scan; expected sensor_msgs/LaserScan.*: /laser; .* --scan"
    ):
        read_log(tmp_path / "run.bag")
    with pytest.raises(
        LogError, match="/laser has messages of type sensor_msgs/LaserScan; expected nav_msgs/Odom"
    ):
        read_log(tmp_path / "run.bag", scan="/laser", odometry="/laser")


@pytest.mark.slow
def test_a_truncated_bag_is_refused(tmp_path: Path) -> None:
    write_bag(tmp_path / "run.bag", drive()[1])
    content = (tmp_path / "run.bag").read_bytes()
    (tmp_path / "run.bag").write_bytes(content[:3000])
    with pytest.raises(LogError, match=r"run\.bag: cannot be read as a ROS 1 bag"):
        read_log(tmp_path / "run.bag")


@pytest.mark.slow
def test_a_damaged_bag_is_read_as_far_as_possible_or_refused(tmp_path: Path) -> None:
    """Half of these damages ended ``rce map`` with a traceback."""
    log = tmp_path / "run.bag"
    write_bag(log, drive(12)[1])
    content = log.read_bytes()
    draw = Random(3)
    told = 0
    refused: list[str] = []
    for _ in range(40):
        damaged = bytearray(content)
        place = draw.randrange(13, len(content) - 4)
        damaged[place : place + 4] = draw.choice((bytes(4), b"\xff" * 4, draw.randbytes(4)))
        log.write_bytes(damaged)
        try:
            told += bool(read_log(log).faults)
        except LogError as error:
            refused.append(str(error))
    assert told
    assert refused
    assert all(text.startswith(str(log)) for text in refused)


@pytest.mark.parametrize("wrong", ["angle_min", "angle_increment", "range_max"])
def test_scans_of_a_bag_without_numbers_are_left_out(tmp_path: Path, wrong: str) -> None:
    records = drive(4)[1]
    records[1] = replace(records[1], **{wrong: nan})  # type: ignore[arg-type]  # all three are floats
    write_bag(tmp_path / "run.bag", records)
    found = read_log(tmp_path / "run.bag")
    assert (len(found.records), len(found.faults)) == (3, 1)
    assert "are not finite; left out" in found.faults[0]


def test_scans_of_a_bag_without_increment_are_left_out(tmp_path: Path) -> None:
    """All their beams would point the same way."""
    records = drive(4)[1]
    records[1] = replace(records[1], angle_increment=0.0)
    write_bag(tmp_path / "run.bag", records)
    found = read_log(tmp_path / "run.bag")
    assert len(found.records) == 3
    assert all(record.angle_increment for record in found.records)
    (fault,) = found.faults
    assert (
        fault
        == f"{tmp_path / 'run.bag'}: angle_increment of the scan at {records[1].time:.3f} s is 0; left out"
    )


def test_a_bag_whose_scans_have_no_increment_is_refused(tmp_path: Path) -> None:
    records = [replace(record, angle_increment=0.0) for record in drive(4)[1]]
    write_bag(tmp_path / "run.bag", records)
    with pytest.raises(LogError, match="the topic /scan has no usable message"):
        read_log(tmp_path / "run.bag")


@pytest.mark.parametrize("content", [None, "", "ODOM 0 0 0 0 0 0 1 host 1\n"])
def test_unusable_logs_end_with_a_message(tmp_path: Path, content: str | None) -> None:
    log = tmp_path / "bad.log"
    if content is not None:
        log.write_text(content)
    result = run(log, "--output", tmp_path / "out", "--with", "gmapping")
    assert result.exit_code == 1
    assert "bad.log: " in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()


def test_a_bad_log_leaves_folders_of_others(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    assert run(tmp_path / "bad.log", "--output", tmp_path / "mine").exit_code == 1
    assert run(tmp_path / "bad.log", "--output", tmp_path / "mine" / "new" / "out").exit_code == 1
    assert names(tmp_path) == ["mine"]
    assert names(tmp_path / "mine") == []


def test_slow_compiling_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    said, stream = threading.Event(), StringIO()

    def announce(text: str, file: StringIO) -> None:
        file.write(text)
        said.set()

    monkeypatch.setattr(outputs, "NOTICE_S", 0.01)
    monkeypatch.setattr(outputs, "print", announce, raising=False)
    monkeypatch.setattr(outputs, "compile_kernels", lambda: said.wait(30))
    outputs.compile_with_notice(stream)
    assert "compiling the inner loops" in stream.getvalue()


def test_an_output_that_is_a_file_is_refused(tmp_path: Path) -> None:
    write_carmen(tmp_path / "run.log", drive(3)[1])
    result = run(tmp_path / "run.log", "--output", tmp_path / "run.log", "--with", "gmapping")
    assert result.exit_code == 1
    assert "cannot be written to" in result.output


def test_ctrl_c_leaves_the_former_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_carmen(tmp_path / "run.log", drive(3)[1])
    (tmp_path / "map.yaml").write_text("former")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "save_map", interrupted)
    result = run(tmp_path / "run.log", "--output", tmp_path, "--with", "gmapping")
    assert result.exit_code == 130
    assert "nothing was written" in result.output
    assert names(tmp_path) == ["map.yaml", "run.log"]
    assert (tmp_path / "map.yaml").read_text() == "former"


@pytest.mark.slow
@pytest.mark.parametrize("start", [("--initial-pose", "4.7,3.2,-1.5708"), ("--global",)])
def test_a_log_is_localized_on_a_map(tmp_path: Path, start: tuple[str, ...]) -> None:
    true, records = drive()
    write_carmen(tmp_path / "run.log", records)
    save_map(rooms(), tmp_path / "rooms.yaml")
    result = run(
        tmp_path / "run.log", "--map", tmp_path / "rooms.yaml", "--output", tmp_path / "out", *start,
        command=commands.localize,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert names(tmp_path / "out") == ["report.json", "trajectory.csv"]
    _, poses = read_trajectory(tmp_path / "out" / "trajectory.csv")
    wrong = poses[:, :2] - compose(START, true)[:, :2]
    assert np.isfinite(poses).all()
    assert "--global" in start or np.hypot(*wrong[-20:].T).mean() < 0.5


@pytest.mark.parametrize("text", ["1,2", "1,2,x", "1,2,nan"])
def test_a_faulty_initial_pose_is_refused(tmp_path: Path, text: str) -> None:
    result = run(
        tmp_path / "a", "--map", tmp_path / "b", "--output", tmp_path, "--initial-pose", text,
        command=commands.localize,
    )  # fmt: skip
    assert result.exit_code == 2
    assert "X,Y,THETA" in result.output


def test_a_missing_map_ends_with_a_message(tmp_path: Path) -> None:
    write_carmen(tmp_path / "run.log", drive(3)[1])
    result = run(
        tmp_path / "run.log", "--map", tmp_path / "no.yaml", "--output", tmp_path / "out",
        command=commands.localize,
    )  # fmt: skip
    assert result.exit_code == 1
    assert "no.yaml" in result.output


def test_faulty_lines_are_printed(tmp_path: Path) -> None:
    write_carmen(tmp_path / "run.log", drive(3)[1])
    with (tmp_path / "run.log").open("a") as stream:
        stream.write("FLASER 7 1 2\n" * 12)
    result = run(tmp_path / "run.log", "--output", tmp_path / "out", "--with", "gmapping")
    assert result.exit_code == 0
    assert "run.log:5: FLASER left out: expected 7 ranges" in result.output
    assert "... and 2 more" in result.output
