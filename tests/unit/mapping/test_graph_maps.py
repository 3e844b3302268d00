"""Several robots, saved maps, localization in them, and input that is bad."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.walls import box, drive, drive_log, polyline, scan_at
from unit.mapping.test_graph_loops import RING, RING_WAY, worst_error

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.graph.localization import GraphLocalizer
from rce_fleet.mapping.graph.mapper import GraphMapper
from rce_fleet.mapping.graph.storage import load_graph, save_graph

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray
    from support.walls import Poses

    from rce_fleet.mapping.graph.key_graph import KeyGraph


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[KeyGraph, Path, Poses]:
    truth = drive(RING_WAY[:5])
    mapper = GraphMapper()
    for record in drive_log(RING, truth, np.random.default_rng(8)):
        mapper.add(record)
    mapper.finish()
    path = tmp_path_factory.mktemp("maps") / "ring.npz"
    save_graph(mapper.graph, path)
    return mapper.graph, path, truth[0]


@pytest.mark.slow
def test_robots_are_joined_where_they_meet() -> None:
    first, second = drive(RING_WAY[:4]), drive([(11.5, 8.5), (1.6, 8.2), (1.4, 1.6), (6, 1.5)])
    mapper = GraphMapper()
    logs = [drive_log(RING, way, np.random.default_rng(seed)) for seed, way in enumerate((first, second))]
    for step in range(max(map(len, logs))):
        for robot, log in zip(("R1", "R2"), logs, strict=True):
            if step < len(log):
                mapper.add(log[step], robot)
    assert mapper.robots == ("R1", "R2")
    assert mapper.is_joined("R2")
    mapper.finish()
    for robot, way in (("R1", first), ("R2", second)):
        error = relative(relative(first[0], way), mapper.trajectory(robot))
        assert np.hypot(error[:, 0], error[:, 1]).max() < 0.1


@pytest.mark.slow
def test_robots_that_do_not_meet_stay_apart() -> None:
    other = [
        *polyline((50, 0), (57, 0), (57, 3), (66, 3), (66, 8), (61, 8), (61, 11), (50, 11), closed=True),
        *box(53, 4, 1.5, 2.5),
        *box(58, 6, 1, 1),
    ]
    mapper = GraphMapper()
    rng = np.random.default_rng(1)
    for record in drive_log(RING, drive([(1.5, 1.5), (12, 1.7), (12.3, 6)]), rng):
        mapper.add(record, "R1")
    for record in drive_log(other, drive([(51, 2), (51.5, 8.5), (56, 8.5), (56.5, 5), (63, 5)]), rng):
        mapper.add(record, "R2")
    assert mapper.is_joined("R1")
    assert not mapper.is_joined("R2")


@pytest.mark.slow
def test_saved_map_is_the_same(saved: tuple[KeyGraph, Path, Poses]) -> None:
    graph, path, _ = saved
    again = load_graph(path)
    assert np.array_equal(again.poses, graph.poses)
    assert np.array_equal(again.parts, graph.parts)
    assert len(again.edges) == len(graph.edges)
    assert len(again.refined) == len(graph.refined)
    assert again.loops == graph.loops
    for one, two in zip(again.scans, graph.scans, strict=True):
        assert np.allclose(one.points, two.points, atol=1e-5)
        assert np.array_equal(one.ranges, two.ranges)


@pytest.mark.slow
def test_loaded_map_is_continued_from_known_start(saved: tuple[KeyGraph, Path, Poses]) -> None:
    _, path, origin = saved
    mapper = GraphMapper(graph=load_graph(path))
    keys = len(mapper.graph)
    way = drive([(1.5, 1.5), (9, 1.6)])
    start = compose(relative(origin, way[0]), (0.15, -0.1, 0.03))
    for index, record in enumerate(drive_log(RING, way, np.random.default_rng(3))):
        mapper.add(record, start=start if index == 0 else None)
    assert mapper.is_joined()
    assert len(mapper.graph) > keys
    error = relative(relative(origin, way[-1]), mapper.pose())
    assert np.hypot(*error[:2]) < 0.05


@pytest.mark.slow
def test_loaded_map_is_continued_from_unknown_start(saved: tuple[KeyGraph, Path, Poses]) -> None:
    _, path, origin = saved
    mapper = GraphMapper(graph=load_graph(path))
    way = drive([(12.3, 3), (12.2, 8.4), (4, 8.4)])
    for record in drive_log(RING, way, np.random.default_rng(3)):
        mapper.add(record)
    assert mapper.is_joined()
    error = relative(relative(origin, way[-1]), mapper.pose())
    assert np.hypot(*error[:2]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("is_known", [True, False])
def test_robot_is_localized_in_saved_map(saved: tuple[KeyGraph, Path, Poses], is_known: bool) -> None:
    _, path, origin = saved
    graph = load_graph(path)
    way = drive([(12.3, 3), (12.2, 8.4), (6, 8.4)])
    start = compose(relative(origin, way[0]), (0.2, 0.1, -0.05))
    localizer = GraphLocalizer(graph, start=start if is_known else None)
    poses = [localizer.add(record) for record in drive_log(RING, way, np.random.default_rng(5))]
    assert all(pose is not None for pose in poses[20:])
    assert poses[-1] is not None
    error = relative(relative(origin, way[-1]), poses[-1])
    assert np.hypot(*error[:2]) < 0.05
    assert abs(error[2]) < 0.02
    assert np.array_equal(graph.poses, load_graph(path).poses)


def test_skipped_scans_have_odometry_poses() -> None:
    mapper = GraphMapper()
    record = scan_at(RING, (1.5, 1.5, 0.0))
    mapper.add(record)
    for index in range(1, 4):
        mapper.add(replace(record, index=index, odometry=(0.005 * index, 0.0, 0.0)))
    assert mapper.trajectory()[:, 0] == pytest.approx([0, 0.005, 0.01, 0.015])


def test_scans_without_returns_follow_odometry() -> None:
    mapper = GraphMapper()
    for index in range(30):
        blind = scan_at(RING, (1.5, 1.5, 0.0), index=index, farthest=0.1, odometry=(0.1 * index, 0.0, 0.0))
        mapper.add(blind)
    assert mapper.trajectory()[:, 0] == pytest.approx(0.1 * np.arange(30), abs=0.02)


@pytest.mark.slow
def test_gap_in_log_is_bridged() -> None:
    """A robot that sends nothing on a part of its way is placed again by its odometry and the map."""
    truth = drive(RING_WAY)
    log = drive_log(RING, truth, np.random.default_rng(6))
    kept = [index for index in range(len(log)) if not 40 <= index < 52]
    mapper = GraphMapper()
    for index in kept:
        mapper.add(log[index])
    mapper.finish()
    assert worst_error(mapper.trajectory(), truth[kept]) < 0.3


@pytest.mark.slow
def test_lost_robot_is_found_on_its_own_map() -> None:
    """After a gap that odometry cannot bridge the robot begins a new part, which loops join again."""
    truth = drive([*RING_WAY, (12.3, 1.8), (12.3, 5)])
    log = drive_log(RING, truth, np.random.default_rng(6))
    gap = range(150, 190)
    turned = compose((0.0, 0.0, 0.8), np.array([record.odometry for record in log]))
    kept = [index for index in range(len(log)) if index not in gap]
    mapper = GraphMapper()
    for index in kept:
        odometry = log[index].odometry if index < gap.start else tuple(turned[index].tolist())
        mapper.add(replace(log[index], odometry=odometry))
    assert len(np.unique(mapper.graph.parts)) == 1
    assert worst_error(mapper.trajectory(), truth[kept]) < 0.1


@pytest.mark.parametrize(("silence", "parts"), [(100.0, 2), (5.0, 1)])
def test_robot_is_lost_after_a_long_silence(silence: float, parts: int) -> None:
    mapper = GraphMapper()
    truth = drive([(1.5, 1.5), (6, 1.6)], step=0.5)
    for index, pose in enumerate(truth):
        record = scan_at(RING, pose, index=index, odometry=relative(truth[0], pose))
        mapper.add(replace(record, time=0.2 * index + (silence if index >= 5 else 0.0)))
        if index == 5:
            assert len(np.unique(mapper.graph.parts)) == parts


def test_robot_moves_though_odometry_stands_still() -> None:
    truth = drive([(1.5, 1.5), (6, 1.6)], step=0.15)
    mapper = GraphMapper()
    for record in drive_log(RING, truth, np.random.default_rng(2)):
        mapper.add(replace(record, odometry=(0.0, 0.0, 0.0)))
    # Dead reckoning errs by 4.5 m; along the corridor scans alone tell little.
    assert worst_error(mapper.trajectory(), truth) < 0.5


@pytest.mark.parametrize(("beams", "field_of_view"), [(61, 4.0), (541, 4.7), (360, 6.265)])
def test_other_lasers_are_mapped(beams: int, field_of_view: float) -> None:
    truth = drive([(1.5, 1.5), (8, 1.6)], step=0.4)
    mapper = GraphMapper()
    log = drive_log(RING, truth, np.random.default_rng(2), beams=beams, field_of_view=field_of_view)
    for record in log:
        mapper.add(record)
    assert worst_error(mapper.trajectory(), truth) < 0.06


def test_odometry_that_is_not_finite_is_refused() -> None:
    mapper = GraphMapper()
    with pytest.raises(ValueError, match=r"scan 7: the odometry must be three finite numbers"):
        mapper.add(scan_at(RING, (1.5, 1.5, 0.0), index=7, odometry=(np.nan, 0.0, 0.0)))
    assert mapper.robots == ()


def test_empty_map_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="nothing to save"):
        save_graph(GraphMapper().graph, tmp_path / "map.npz")


def change(path: Path, target: Path, **changes: NDArray[Any]) -> None:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    arrays.update(changes)
    np.savez(target, **arrays)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"header": np.array('{"format": "rce graph map", "version": 99}')}, "version 99"),
        ({"header": np.array("nonsense")}, "has no header"),
        ({"poses": np.zeros((3, 2))}, r"expected 'poses' of shape \(None, 3\)"),
        ({"poses": np.full((3, 3), "0")}, r"'poses' of shape \(None, 3\), found <U1 of shape \(3, 3\)"),
        ({"ways": np.zeros(2)}, "rows in 'ways', found 2"),
        ({"edge_ends": np.full((1, 2), 10**6)}, "rows in 'edge_poses'|does not have"),
    ],
)
def test_wrong_map_file_is_refused(
    saved: tuple[KeyGraph, Path, Poses], tmp_path: Path, changes: dict[str, NDArray[Any]], reason: str
) -> None:
    change(saved[1], tmp_path / "wrong.npz", **changes)
    with pytest.raises(MapError, match=reason):
        load_graph(tmp_path / "wrong.npz")


def test_damaged_map_file_is_refused(saved: tuple[KeyGraph, Path, Poses], tmp_path: Path) -> None:
    path = tmp_path / "short.npz"
    path.write_bytes(saved[1].read_bytes()[:5000])
    with pytest.raises(MapError, match=r"short\.npz: is damaged"):
        load_graph(path)
    with pytest.raises(MapError, match="cannot be read"):
        load_graph(tmp_path / "missing.npz")


def test_map_file_with_wrong_bytes_is_refused(saved: tuple[KeyGraph, Path, Poses], tmp_path: Path) -> None:
    path, content = tmp_path / "wrong.npz", saved[1].read_bytes()
    draw, reasons = Random(5), set[str]()
    for _ in range(60):
        damaged = bytearray(content)
        place = draw.randrange(len(content) - 4)
        damaged[place : place + 4] = draw.choice((bytes(4), b"\xff" * 4, draw.randbytes(4)))
        path.write_bytes(damaged)
        try:
            load_graph(path)
        except MapError as error:
            reasons.add(str(error))
    assert len(reasons) > 1
    assert all(reason.startswith(f"{path}: ") for reason in reasons)
