"""Correlative matching and alignment of scans against known poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.walls import box, polyline, scan_at

from rce_fleet.geometry.poses import relative
from rce_fleet.mapping.graph import search
from rce_fleet.mapping.graph.alignment import Reference, align
from rce_fleet.mapping.graph.correlative import Window, find_match
from rce_fleet.mapping.graph.fields import make_field, paint
from rce_fleet.mapping.graph.scan_points import ScanPoints, prepare_scan
from rce_fleet.mapping.graph.visibility import seen_through

if TYPE_CHECKING:
    from collections.abc import Sequence

    from support.walls import Poses


ROOM = [*box(-4, -3, 9, 7), *box(2, 1, 1, 1), *polyline((-4, 1), (-2.5, 1), (-2.5, 1.4))]


def scan_points(pose: Sequence[float] | Poses, beams: int = 181) -> ScanPoints:
    return prepare_scan(scan_at(ROOM, pose, beams=beams), farthest=30.0, cell=0.04)


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(-0.4, 0.4),
    y=st.floats(-0.4, 0.4),
    yaw=st.floats(-0.3, 0.3),
    beams=st.sampled_from((91, 181, 361)),
)
def test_match_finds_known_transform(x: float, y: float, yaw: float, beams: int) -> None:
    base, pose = np.array((0.3, -0.2, 0.4)), np.array((0.3 + x, -0.2 + y, 0.4 + yaw))
    reference, scan = scan_points(base), scan_points(pose, beams=beams)
    field = make_field(reference.points, cell=0.05, spread=0.06, levels=5)
    match = find_match(field, scan.points, np.zeros(3), Window(0.6, 0.5, 0.012, 0.05))
    assert match is not None
    true = relative(base, pose)
    assert np.abs(match.pose - true).max() < 0.1
    aligned = align(scan, Reference(reference.line_points, reference.line_normals), match.pose)
    assert np.abs(aligned.pose - true).max() < 0.02
    assert aligned.inliers > 0.6


def random_search(seed: int) -> tuple[Any, ...]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.5, 1.5, (20, 2))
    field = make_field(points[:12], cell=0.1, spread=0.1, levels=4)
    yaws = rng.uniform(-0.2, 0.2, 5)
    turned = np.stack([points @ np.array(((np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a)))) for a in yaws])
    cells = field.cells(turned)
    excluded = np.array((2, 0, 0, 1, 2) if seed % 2 else (-1,) * 5, np.int64)
    return (
        field.levels,
        np.ascontiguousarray(cells[..., 0]),
        np.ascontiguousarray(cells[..., 1]),
        int(rng.integers(1, 9)),
        rng.integers(0, 50, 5).astype(np.int64),
        int(rng.integers(0, 300_000)),
        excluded,
        int(rng.integers(0, 1500)),
    )


@pytest.mark.parametrize("seed", range(12))
def test_numpy_search_equals_loop(seed: int) -> None:
    arguments = random_search(seed)
    assert search.search.numpy(*arguments).tolist() == search.search.loop(*arguments).tolist()


@pytest.mark.parametrize("seed", range(6))
def test_search_equals_trying_everything(seed: int) -> None:
    levels, columns, rows, reach, costs, weight, excluded, floor = random_search(seed)
    best = (floor - 1, -1, 0, 0)
    for turn in range(len(columns)):
        for row in range(-reach, reach + 1):
            for column in range(-reach, reach + 1):
                apart = (abs(turn - excluded[0]), abs(row - excluded[1]), abs(column - excluded[2]))
                if apart[0] <= excluded[3] and max(apart[1:]) <= excluded[4]:
                    continue
                y, x = rows[turn] + row, columns[turn] + column
                inside = (y >= 0) & (y < levels.shape[1]) & (x >= 0) & (x < levels.shape[2])
                score = int(levels[0][y[inside], x[inside]].sum(dtype=int)) - int(costs[turn])
                score -= sum(weight * shift**2 // reach**2 // search.SCALE for shift in (row, column))
                if score > best[0]:
                    best = (score, turn, row, column)
    expected = best if best[1] >= 0 else (-1, -1, 0, 0)
    assert search.search.numpy(levels, columns, rows, reach, costs, weight, excluded, floor).tolist() == list(
        expected
    )


def test_paint_numpy_equals_loop() -> None:
    rng = np.random.default_rng(3)
    cells = np.unique(rng.integers(3, 20, 60) * 24 + rng.integers(3, 20, 60))
    stamp = rng.integers(0, 256, (7, 7)).astype(np.uint8)
    one, two = np.zeros((24, 24), np.uint8), np.zeros((24, 24), np.uint8)
    paint.numpy(one, cells // 24, cells % 24, stamp)
    paint.loop(two, cells // 24, cells % 24, stamp)
    assert one.any()
    assert (one == two).all()


def test_pyramid_holds_maxima() -> None:
    field = make_field(np.random.default_rng(0).uniform(0, 2, (30, 2)), cell=0.05, spread=0.06, levels=4)
    for level in range(4):
        for row, column in ((5, 7), (20, 30), (30, 12)):
            window = field.levels[0][row : row + (1 << level), column : column + (1 << level)]
            assert field.levels[level][row, column] == window.max()


def test_match_below_least_score_is_none() -> None:
    field = make_field(scan_points((0, 0, 0)).points, cell=0.05, spread=0.06, levels=5)
    elsewhere = np.random.default_rng(1).uniform(-3, 3, (100, 2))
    assert find_match(field, elsewhere, np.zeros(3), Window(0.3, 0.2, 0.02), at_least=0.6) is None


def test_align_without_points_tells_nothing() -> None:
    empty = prepare_scan(scan_at(ROOM, (0, 0, 0), farthest=0.5), farthest=30.0, cell=0.04)
    room = scan_points((0, 0, 0))
    aligned = align(empty, Reference(room.line_points, room.line_normals), np.array((1.0, 2.0, 0.5)))
    assert aligned.inliers == 0
    assert aligned.pose.tolist() == [1.0, 2.0, 0.5]


def test_align_in_corridor_knows_no_way_along() -> None:
    corridor = [(-50, -1, 50, -1), (-50, 1, 50, 1)]
    one = prepare_scan(scan_at(corridor, (0, 0, 0)), farthest=30.0, cell=0.04)
    aligned = align(one, Reference(one.line_points, one.line_normals), np.array((0.05, 0.03, 0.02)))
    along, across = aligned.information[0, 0], aligned.information[1, 1]
    assert across > 1000 * along


def test_normals_point_to_the_laser() -> None:
    scan = scan_points((0.5, 0.2, 1.0))
    assert (np.einsum("nd,nd->n", scan.line_points, scan.line_normals) < 0).all()
    assert len(scan.line_points) > 0.8 * len(scan)


def test_scan_leaves_out_what_is_no_range() -> None:
    record = scan_at(ROOM, (0, 0, 0), beams=181)
    record.ranges[:5] = (np.nan, np.inf, -1.0, 0.0, 99.0)
    scan = prepare_scan(record, farthest=30.0, cell=0.01)
    assert len(scan) == 176
    assert np.isfinite(scan.points).all()


@pytest.mark.parametrize("turn", [1.0, -1.0], ids=["upright", "upside down"])
def test_a_full_circle_from_0_sees_to_all_sides(turn: float) -> None:
    """Upside down, its beams go clockwise from 0, so that those to the left come last."""
    nothing, step = np.zeros((0, 2)), turn * np.pi / 180
    scan = ScanPoints(nothing, nothing, np.full(360, 4.0, np.float32), 0.0, step)
    around = np.deg2rad(np.arange(3, 358))
    points = 2.0 * np.column_stack((np.cos(around), np.sin(around)))
    assert seen_through(points, scan, np.zeros(3)).all()
    assert not seen_through(2.5 * points, scan, np.zeros(3)).any()
