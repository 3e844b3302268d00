"""The optimizer against graphs whose solution is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.geometry.poses import compose, relative
from rce_fleet.mapping.graph.pose_graph import Edges, edge_errors, optimize, squared_distances

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from support.walls import Poses


def ring(count: int = 24, radius: float = 5.0) -> Poses:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    yaws = (angles + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack((radius * np.cos(angles), radius * np.sin(angles), yaws))


def edges_of(poses: Poses, ends: list[tuple[int, int]], robust: float = np.inf) -> Edges:
    first, second = np.array(ends).T
    count = len(first)
    return Edges(
        first,
        second,
        relative(poses[first], poses[second]),
        np.tile(np.diag((100.0, 100.0, 400.0)), (count, 1, 1)),
        np.full(count, robust),
    )


def fixed_first(count: int) -> NDArray[np.bool_]:
    fixed = np.zeros(count, np.bool_)
    fixed[0] = True
    return fixed


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), spread=st.floats(0.01, 0.3))
def test_exact_edges_give_true_poses(seed: int, spread: float) -> None:
    true = ring()
    count = len(true)
    edges = edges_of(true, [(i, (i + 1) % count) for i in range(count)] + [(0, 12), (5, 17)])
    start = true + np.random.default_rng(seed).normal(0, spread, true.shape)
    start[0] = true[0]
    found = optimize(start, edges, fixed=fixed_first(count), iterations=50, settled=1e-9)
    assert np.abs(edge_errors(found, edges)).max() < 1e-5
    assert np.abs(found[:, :2] - true[:, :2]).max() < 1e-4


def test_drift_is_spread_over_the_loop() -> None:
    true = np.column_stack((np.arange(11.0), np.zeros(11), np.zeros(11)))
    edges = edges_of(true, [(i, i + 1) for i in range(10)] + [(0, 10)])
    edges.poses[-1] = (11.0, 0.0, 0.0)
    found = optimize(true, edges, fixed=fixed_first(11))
    # 11 springs of equal strength share one metre.
    assert found[10, 0] == pytest.approx(10 + 10 / 11, abs=1e-3)
    assert np.diff(found[:, 0]) == pytest.approx(np.full(10, 1 + 1 / 11), abs=1e-3)


def test_robust_edge_yields_to_the_others() -> None:
    true = ring()
    count = len(true)
    good = [(i, (i + 1) % count) for i in range(count)] + [(0, 12), (5, 17)]
    edges = edges_of(true, [*good, (3, 15)])
    edges.poses[-1] = compose(edges.poses[-1], np.array((4.0, 3.0, 1.0)))
    plain = optimize(true, edges, fixed=fixed_first(count))
    edges.robust[-1] = 1.0
    robust = optimize(true, edges, fixed=fixed_first(count))
    assert np.abs(plain - true).max() > 0.5
    assert np.abs(robust - true).max() < 0.05


def test_fixed_poses_stay() -> None:
    true = ring()
    edges = edges_of(true, [(i, i + 1) for i in range(len(true) - 1)])
    start = true + np.random.default_rng(2).normal(0, 0.1, true.shape)
    fixed = fixed_first(len(true))
    fixed[7] = True
    found = optimize(start, edges, fixed=fixed)
    assert (found[[0, 7]] == start[[0, 7]]).all()


def test_optimum_costs_less_than_neighbours() -> None:
    rng = np.random.default_rng(5)
    true = ring()
    count = len(true)
    edges = edges_of(true, [(i, (i + 1) % count) for i in range(count)] + [(2, 14)], robust=2.0)
    edges.poses[:] += rng.normal(0, 0.05, edges.poses.shape)
    found = optimize(true, edges, fixed=fixed_first(count), iterations=50, settled=1e-8)
    cost = np.log1p(squared_distances(found, edges) / 4).sum()
    for _ in range(30):
        moved = found + rng.normal(0, 1e-3, found.shape)
        moved[0] = found[0]
        assert np.log1p(squared_distances(moved, edges) / 4).sum() > cost


def test_graph_without_edges_stays() -> None:
    poses = ring(5)
    empty = Edges(
        np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
    )
    assert (optimize(poses, empty, fixed=fixed_first(5)) == poses).all()
