"""What goes wrong in long runs: odometry that jumps, graphs that grow, joins that turn out to be wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.walls import box, drive, drive_log, polyline, scan_at
from unit.mapping.test_graph_loops import INFORMATION, RING, RING_WAY, graph_along, worst_error

from rce_fleet.geometry.poses import compose, inverse, relative
from rce_fleet.mapping.graph import mapper as mapper_module
from rce_fleet.mapping.graph import pruning
from rce_fleet.mapping.graph.key_graph import Edge, KeyGraph, edge_arrays
from rce_fleet.mapping.graph.localization import GraphLocalizer
from rce_fleet.mapping.graph.mapper import GraphMapper
from rce_fleet.mapping.graph.pose_graph import squared_distances
from rce_fleet.mapping.graph.storage import load_graph, save_graph

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.mapping.records import LaserRecord

WAY = [(1.5, 1.5), (12.3, 1.8), (12.3, 6)]


def jumping(log: list[LaserRecord], at: int, jump: tuple[float, float, float]) -> list[LaserRecord]:
    """Return a log whose odometry is another one from a scan on."""
    return [
        replace(record, odometry=tuple(compose(jump, np.array(record.odometry)).tolist()))
        if index >= at
        else record
        for index, record in enumerate(log)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("jump", [(2.0, 0.0, 0.0), (-3.0, 3.0, 0.0), (0.0, 0.0, 2.5), (90.0, 0.0, 1.0)])
def test_odometry_that_jumps_moves_no_scan(jump: tuple[float, float, float]) -> None:
    truth = drive(WAY)
    mapper = GraphMapper()
    for record in jumping(drive_log(RING, truth, np.random.default_rng(3)), 30, jump):
        mapper.add(record)
        assert bool(mapper.jump()) == (record.index == 30)
    assert mapper.statistics()["jumps"] == 1
    assert len(np.unique(mapper.graph.parts)) == 1
    assert worst_error(mapper.trajectory(), truth) < 0.1


def test_jump_without_a_match_joins_nothing() -> None:
    """A robot that sees nothing when its odometry jumps begins a part: no edge says where it is."""
    mapper = GraphMapper()
    for index in range(40):
        odometry = (0.1 * index + (7.0 if index >= 20 else 0.0), 0.0, 0.0)
        mapper.add(scan_at(RING, (1.5, 1.5, 0.0), index=index, farthest=0.1, odometry=odometry))
    assert len(np.unique(mapper.graph.parts)) == 2
    assert max(np.abs(edge.pose[0]) for edge in mapper.graph.edges) < 2


@pytest.mark.slow
def test_jump_keeps_the_place_in_a_saved_map(tmp_path: Path) -> None:
    truth = drive(WAY)
    mapper = GraphMapper()
    log = drive_log(RING, truth, np.random.default_rng(4))
    for record in log:
        mapper.add(record)
    save_graph(mapper.graph, tmp_path / "ring.npz")
    localizer = GraphLocalizer(load_graph(tmp_path / "ring.npz"), start=np.zeros(3))
    found = [localizer.add(record) for record in jumping(log, 30, (-2.0, 1.5, 1.0))]
    assert worst_error(np.array(found), truth) < 0.15


# Pruning


def test_composed_edges_equal_those_of_the_removed() -> None:
    """A chain without loops: the poses that fit the edges best are the same without the middle keyscans."""
    rng = np.random.default_rng(1)
    truth = drive(WAY, step=0.5)
    graph = graph_along(RING, truth)
    for edge in graph.edges:
        edge.pose[:] += rng.normal(0, 0.01, 3)
    graph.optimize()
    before = graph.poses.copy()
    removed = range(3, len(graph) - 1)
    numbers = pruning.remove(graph, removed)
    assert len(graph) == 4
    assert len(graph.edges) == 3
    assert numbers[[0, 1, 2, len(before) - 1]].tolist() == [0, 1, 2, 3]
    assert graph.poses == pytest.approx(before[numbers >= 0])
    assert squared_distances(graph.poses, edge_arrays(graph.edges)).max() < 1e-6
    assert graph.keys_of(0) == [0, 1, 2, 3]


def test_uncertainty_grows_along_removed_keyscans() -> None:
    graph = graph_along(RING, np.array([(float(x), 1.5, 0.0) for x in range(5)]))
    pruning.remove(graph, [1, 2, 3])
    (edge,) = graph.edges
    variances = np.diag(np.linalg.inv(edge.information))
    # Each of the four edges adds its own, and its turn moves those behind it: 9 + 4 + 1.
    assert variances[0] == pytest.approx(4e-3, rel=1e-3)
    assert variances[1] == pytest.approx(4e-3 + 14e-4, rel=1e-3)
    assert variances[2] == pytest.approx(4e-4, rel=1e-3)


def test_loops_of_removed_keyscans_go_to_neighbours() -> None:
    poses = np.array([(float(x), 1.5, 0.0) for x in range(6)])
    graph = graph_along(RING, poses)
    graph.join(Edge(0, 4, relative(poses[0], poses[4]), INFORMATION, 0.1, is_loop=True))
    pruning.remove(graph, [4])
    loops = [edge for edge in graph.edges if edge.is_loop]
    assert [{edge.first, edge.second} for edge in loops] in ([{0, 3}], [{0, 4}])
    assert squared_distances(graph.poses, edge_arrays(graph.edges)).max() < 1e-9
    assert len(np.unique(graph.components([edge for edge in graph.edges if not edge.is_loop]))) == 1


def test_oldest_and_newest_keyscans_of_a_place_stay() -> None:
    graph = KeyGraph()
    source = graph_along(RING, np.array([(1.5, 1.5, 0.0)]))
    for number in range(10):
        graph.add(source.scans[0], np.array((1.5, 1.5, 0.0)), 0, float(number))
        if number:
            graph.join(Edge(number - 1, number, np.zeros(3), INFORMATION, 1.0))
    assert pruning.surplus(graph, ()) == [2, 3, 4, 5]
    assert pruning.surplus(graph, (3,)) == [2, 4, 5]


@pytest.mark.slow
def test_graph_of_a_known_place_does_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapper_module, "PRUNE_EVERY", 10)
    monkeypatch.setattr(mapper_module, "RECENT", 15)
    corners = [(1.5, 1.5), (3.5, 1.5)]
    laps = drive([*corners * 14, corners[0]], step=0.4)
    mapper = GraphMapper(bounded=True)
    sizes = []
    for record in drive_log(RING, laps, np.random.default_rng(2), beams=91):
        mapper.add(record)
        sizes.append(len(mapper.graph))
    assert mapper.pruned > 50
    half = len(sizes) // 2
    assert max(sizes[half:]) < 1.3 * max(sizes[:half])
    assert len(mapper.graph.edges) < 4 * len(mapper.graph)
    assert len(mapper.trajectory()) == 1
    assert mapper.statistics()["scans"] == len(laps)
    assert relative(mapper.pose(), relative(laps[0], laps[-1]))[:2] == pytest.approx(0, abs=0.1)


# Joins that were wrong

OTHER = [
    *polyline((5, 0), (0, 0), (0, 10), (14, 10), (14, 0), (6, 0), (6, 0.7), (5, 0.7), (5, 0)),
    *polyline((3, 7), (3, 3), (8.5, 3)),
    *box(0.5, 9, 0.6, 0.6),
    *box(9.5, 0.2, 0.7, 0.7),
    *box(10.8, 3.2, 0.8, 0.8),
    *box(8.6, 4.0, 0.5, 1.8),
]
"""A building whose south corridor begins as that of ``RING`` does, and differs from there on."""


@pytest.mark.slow
def test_join_that_later_scans_contradict_is_undone() -> None:
    first, second = drive(RING_WAY[:5]), drive([(1.5, 8), (1.5, 1.5), (6.5, 1.6), (12.5, 2), (12.5, 8)])
    mapper = GraphMapper()
    for record in drive_log(RING, first, np.random.default_rng(1)):
        mapper.add(record, "R1")
    drawn = mapper.trajectory("R1")
    was_joined = False
    for record in drive_log(OTHER, second, np.random.default_rng(2)):
        mapper.add(record, "R2")
        was_joined |= mapper.is_joined("R2")
    assert was_joined, "the buildings are meant to look alike at first"
    assert not mapper.is_joined("R2")
    assert mapper.undone == 1
    assert mapper.is_joined("R1")
    assert mapper.trajectory("R1") == pytest.approx(drawn, abs=0.05)
    own = mapper.trajectory("R2")
    assert worst_error(compose(inverse(own[0]), own), second) < 0.15
