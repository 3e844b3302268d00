"""Maps of tiles: drawing and matching, compiled and in numpy, against brute force."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rce_fleet.compiled import Kernel, is_available
from rce_fleet.exceptions import MapError
from rce_fleet.mapping.draw_kernels import register
from rce_fleet.mapping.match_kernels import align, evaluate
from rce_fleet.mapping.occupancy_mapping import draw_map, draw_record, map_of
from rce_fleet.mapping.records import LaserRecord
from rce_fleet.mapping.scan_matching import match, scores
from rce_fleet.mapping.tiles import RANKS, REACH, SELF, SPAN, TILE, VISITS_PER_HIT, TileStore
from rce_fleet.maps.occupancy_map import FREE, OCCUPIED, UNKNOWN

HALF = 3.0
"""Half the edge of the square room, metres."""
FORMS = [False, pytest.param(True, marks=pytest.mark.skipif(not is_available(), reason="needs numba"))]
KERNELS: tuple[Kernel[..., Any], ...] = (register, evaluate, align)


def use(*, compiled: bool) -> None:
    for each in KERNELS:
        if compiled:
            each.use_compiled()
        else:
            each.use_numpy()


def scan(pose: NDArray[np.float64], index: int = 0, *, noise: float = 0.0, beams: int = 90) -> LaserRecord:
    """What a laser sees in the square room."""
    draw = np.random.default_rng(index)
    angles = np.linspace(-2.0, 2.0, beams) + pose[2]
    ways = np.column_stack((np.cos(angles), np.sin(angles)))
    borders = np.where(ways > 0, HALF - pose[:2], -HALF - pose[:2])
    ranges = (borders / np.where(np.abs(ways) < 1e-9, 1e-9, ways)).min(axis=1) + draw.normal(0, noise, beams)
    return LaserRecord(index, index, ranges, -2.0, 4.0 / (beams - 1), 20.0, (pose[0], pose[1], pose[2]))


def way(number: int) -> NDArray[np.float64]:
    steps = np.arange(number)
    return np.column_stack((0.15 * steps - 1, 0.4 * np.sin(steps), 0.3 * steps))


def draw(*, compiled: bool, number: int = 12) -> TileStore:
    """Two maps, of which one is drawn anew from the other; walls come and go."""
    use(compiled=compiled)
    store = TileStore(2, 0.05)
    for record, pose in zip(
        [scan(p, k, noise=0.02) for k, p in enumerate(way(number))], way(number), strict=True
    ):
        if record.index == 5:
            store.choose(np.array([1, 1]))
        bent = pose + np.array((0.02, 0.0, 0.01))
        draw_record(store, record, np.vstack((pose, bent)), farthest=2.5 if record.index % 3 == 2 else 20.0)
    return store


def dense_owners(store: TileStore, number: int) -> NDArray[np.int64]:
    table = store.tables[number]
    result = np.zeros((table.shape[0], TILE, table.shape[1], TILE), np.int64)
    for row, column in np.argwhere(table >= 0):
        result[row, :, column] = store.owner[table[row, column]].reshape(TILE, TILE)
    return result.reshape(table.shape[0] * TILE, -1)


@pytest.mark.parametrize("compiled", FORMS)
def test_the_nearest_occupied_cell_is_exact(compiled: bool) -> None:
    store = draw(compiled=compiled)
    for number in range(2):
        hits, visits = np.moveaxis(store.dense_counts(number), -1, 0)
        occupied = (hits > 0) & (hits * VISITS_PER_HIT >= visits)
        nearest = np.zeros(occupied.shape, np.int64)
        for code in range(1, SPAN * SPAN + 1):
            dy, dx = (code - 1) // SPAN - REACH, (code - 1) % SPAN - REACH
            if dx * dx + dy * dy <= REACH * REACH:
                shifted = np.roll(occupied, (-dy, -dx), (0, 1))  # the margin is wider than the reach
                better = shifted & (RANKS[code] < RANKS[nearest])
                nearest[better] = code
        assert occupied.sum() > 100
        assert (dense_owners(store, number) == nearest).all()
        assert ((dense_owners(store, number) == SELF) == occupied).all()


@pytest.mark.skipif(not is_available(), reason="needs numba")
def test_compiled_loops_give_the_answers_of_numpy() -> None:
    found = []
    pose = way(12)[-1]
    beams = scan(pose, 99).points()
    candidates = pose + np.random.default_rng(1).normal(0, 0.1, (2, 20, 3))
    for compiled in (False, True):
        store = draw(compiled=compiled)
        values = scores(store, slice(None), beams, candidates, sigma=0.05, lsigma=0.075)
        prior = np.tile(np.eye(3) * 10, (2, 1, 1))
        matches = match(store, slice(None), beams, candidates[:, 0], candidates[:, 1], prior, sigma=0.05)
        found.append((store, values, matches))
    (first, values, matches), (second, other_values, other_matches) = found
    assert first.origin == second.origin
    for number in range(2):
        assert (first.dense_counts(number) == second.dense_counts(number)).all()
        mine, others = first.only(number), second.only(number)
        for row, column in np.argwhere(mine.tables[0] >= 0):
            tile, other = mine.tables[0, row, column], others.tables[0, row, column]
            assert np.allclose(mine.points[tile], others.points[other], atol=1e-6)
    assert np.allclose(values, other_values)
    assert np.allclose(matches.poses, other_matches.poses)
    assert np.allclose(matches.information, other_matches.information)


def test_copies_share_tiles_until_they_are_written() -> None:
    store = draw(compiled=False)
    store.choose(np.array([0, 0]))
    shared = store.tiles
    before = store.dense_counts(0)
    assert (store.tables[0] == store.tables[1]).all()
    draw_record(store, scan(way(1)[0], 50), np.array([[9.0, 0, 0], [0.0, 0, 0]]), farthest=20.0)
    assert store.tiles > shared
    assert (store.references[store.tables[store.tables >= 0]] >= 1).all()
    assert store.references.sum() == (store.tables >= 0).sum()
    assert store.dense_counts(1)[..., 1].sum() > before[..., 1].sum()
    store.choose(np.array([1, 1]))
    assert store.tiles == (store.tables[0] >= 0).sum()


def test_a_match_finds_the_pose() -> None:
    store = TileStore(1, 0.05)
    for record, pose in zip([scan(p, k) for k, p in enumerate(way(9))], way(9), strict=True):
        draw_record(store, record, pose[None], farthest=20.0)
    pose = np.array((0.3, -0.2, 0.4))
    start = pose + np.array((0.12, -0.1, 0.08))
    found = match(
        store, slice(None), scan(pose).points(), start[None], start[None], np.eye(3)[None] * 10, sigma=0.05
    )
    assert np.abs(found.poses[0] - pose).max() < 0.01
    assert found.matched[0] > 80
    assert np.linalg.eigvalsh(found.information[0]).min() > 10


def test_a_map_has_free_occupied_and_unknown_cells() -> None:
    poses = way(15)
    drawn = draw_map([scan(pose, k) for k, pose in enumerate(poses)], poses)
    walls = np.array([[HALF, 0.0], [0.0, HALF]])
    assert (drawn.values_at(poses[:, :2]) == FREE).all()
    assert (drawn.values_at(walls + 0.001) == OCCUPIED).all()
    assert (drawn.values_at(walls * 1.2) == UNKNOWN).all()


def test_long_beams_are_free_up_to_the_usable_range() -> None:
    store = TileStore(1, 0.05)
    draw_record(store, scan(np.zeros(3)), np.zeros((1, 3)), farthest=2.0)
    drawn = map_of(store, 0)
    assert (drawn.values_at(np.array([[1.9, 0.0], [0.0, 1.9]])) == FREE).all()
    assert not drawn.occupied.any()


def test_no_beams_leave_the_map_as_it_is() -> None:
    store = TileStore(1, 0.05)
    empty = LaserRecord(0, 0.0, np.full(5, np.inf), -1.0, 0.5, 20.0, (0.0, 0.0, 0.0))
    draw_record(store, empty, np.zeros((1, 3)), farthest=20.0)
    assert map_of(store, 0).unknown.all()


def test_a_map_of_impossible_size_is_refused() -> None:
    store = TileStore(1, 0.05)
    draw_record(store, scan(np.zeros(3)), np.zeros((1, 3)), farthest=20.0)
    with pytest.raises(MapError, match="odometry or readings are wrong"):
        draw_record(store, scan(np.zeros(3)), np.array([[1e6, 1e6, 0.0]]), farthest=20.0)


def test_maps_grow_in_all_directions() -> None:
    store = TileStore(1, 0.05)
    far = [np.array((x, y, 0.0)) for x, y in ((0, 0), (-20, 0), (0, -20), (20, 20))]
    for pose in far:
        draw_record(store, scan(np.zeros(3)), pose[None], farthest=20.0)
    drawn = map_of(store, 0)
    assert (drawn.values_at(np.array(far)[:, :2]) == FREE).all()
