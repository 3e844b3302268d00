"""Occupancy maps: cells and places, distances, rays."""

from __future__ import annotations

from math import cos, inf, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.compiled import compile_kernels
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps import distance, ray_casting
from rce_fleet.maps.distance import distance_field, squares_to_nearest
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ray_casting import cast_rays


def random_map(seed: int, rows: int = 12, columns: int = 17, origin: Pose | None = None) -> OccupancyMap:
    draw = np.random.default_rng(seed)
    data = draw.choice(np.array([0, 0, 0, 0, 100, -1], np.int8), (rows, columns))
    return OccupancyMap(data, 0.25, origin or Pose(-1.0, 2.0, 0.4))


def test_row_0_is_the_lowest_y() -> None:
    grid = OccupancyMap(np.array([[0, 100], [-1, 50]], np.int8), 0.5, Pose(1.0, 1.0, 0.0))
    assert grid.world_to_cell([1.6, 1.1]).tolist() == [0, 1]
    assert grid.values_at([[1.6, 1.1], [1.1, 1.6], [0.9, 1.1]]).tolist() == [100, -1, -1]
    assert grid.cell_to_world([1, 0]).tolist() == [1.25, 1.75]
    assert grid.occupied.tolist() == [[False, True], [False, False]]
    assert grid.free.tolist() == [[True, False], [False, False]]
    assert grid.unknown.tolist() == [[False, False], [True, True]]


@given(st.floats(-4, 4), st.integers(-5, 40), st.integers(-5, 40))
def test_cells_survive_the_way_to_the_world(yaw: float, row: int, column: int) -> None:
    grid = random_map(1, origin=Pose(3.0, -2.0, yaw))
    assert grid.world_to_cell(grid.cell_to_world([row, column])).tolist() == [row, column]
    assert grid.inside([row, column]) == (0 <= row < grid.rows and 0 <= column < grid.columns)


def test_a_map_cannot_be_changed() -> None:
    values = np.zeros((2, 2), np.int8)
    grid = OccupancyMap(values)
    values[0, 0] = 100
    assert grid.data[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        grid.data[0, 0] = 100


@pytest.mark.parametrize(
    ("width", "values", "resolution", "fault"),
    [
        (3, [0, 0], 0.05, "3 x 1 cells came with 2 values"),
        (0, [], 0.05, "0 x 1 cells"),
        (2, [0, 101], 0.05, "must be within -1 .. 100"),
        (2, [0, -2], 0.05, "must be within -1 .. 100"),
        (2, [0, 0], 0.0, "must be a positive number of metres"),
        (2, [0, 0], inf, "must be a positive number of metres"),
    ],
)
def test_a_message_that_is_no_map(width: int, values: list[int], resolution: float, fault: str) -> None:
    with pytest.raises(MapError, match=fault):
        OccupancyMap.from_message(width, 1, values, resolution, Pose(0.0, 0.0, 0.0))


def test_distances_are_those_of_brute_force() -> None:
    grid = random_map(3)
    occupied = np.argwhere(grid.occupied)
    cells = np.indices(grid.data.shape).transpose(1, 2, 0).reshape(-1, 1, 2)
    away = np.sqrt(((cells - occupied) ** 2).sum(-1)).min(1).reshape(grid.data.shape) * grid.resolution
    assert distance_field(grid) == pytest.approx(away)
    assert distance_field(grid, 0.3) == pytest.approx(np.minimum(away, 0.3))
    assert (distance_field(OccupancyMap(np.zeros((2, 3), np.int8)), 2.0) == 2.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("reach", [0, 1, 3, 25, 300])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.3])
def test_squares_computed_in_bands_are_those_of_the_whole(
    monkeypatch: pytest.MonkeyPatch, reach: int, share: float
) -> None:
    monkeypatch.setattr(distance, "_BAND", 1)
    mask = np.random.default_rng(reach).random((150, 37)) < share
    cells = np.indices(mask.shape).transpose(1, 2, 0).reshape(-1, 1, 2)
    places = np.argwhere(mask)
    exact = ((cells - places) ** 2).sum(-1).min(1, initial=10**9).reshape(mask.shape)
    found = squares_to_nearest(mask, reach)
    assert (found == np.minimum(exact, reach * reach + 1)).all()
    assert found.itemsize == (2 if reach < 256 else 4)


def test_free_cells_have_the_numbers_of_a_list_of_them() -> None:
    grid = random_map(5)
    free = np.argwhere(grid.free)
    numbers = np.random.default_rng(1).integers(len(free), size=200)
    assert grid.free_count == len(free)
    assert (grid.free_cells(numbers) == free[numbers]).all()
    assert grid.free_cells(numbers[:0]).shape == (0, 2)


# Rays


def entry_by_boxes(grid: OccupancyMap, x: float, y: float, angle: float, limit: float) -> float:
    """Nearest entry into any occupied cell, each intersected as a box of its own (slabs)."""
    local = Pose(x, y, angle).relative_to(grid.origin)
    direction = (cos(local.yaw), sin(local.yaw))
    best = limit
    for row, column in np.argwhere(grid.occupied):
        near, far = 0.0, inf
        for start, along, index in ((local.x, direction[0], column), (local.y, direction[1], row)):
            low, high = index * grid.resolution, (index + 1) * grid.resolution
            if along == 0:
                near, far = (near, far) if low <= start < high else (inf, -inf)
                continue
            first, second = sorted(((low - start) / along, (high - start) / along))
            near, far = max(near, first), min(far, second)
        if near < far:
            best = min(best, near)
    return best


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 20), st.floats(-3, 7), st.floats(-1, 8), st.floats(-pi, pi), st.floats(0.1, 8))
def test_rays_enter_the_first_occupied_cell(seed: int, x: float, y: float, a: float, limit: float) -> None:
    grid = random_map(seed)
    found = cast_rays(grid, [x, y], [a], limit)
    assert found == pytest.approx([entry_by_boxes(grid, x, y, a, limit)], abs=1e-6)


def test_rays_along_the_axes() -> None:
    data = np.zeros((5, 5), np.int8)
    data[2, 4] = data[4, 2] = 100
    grid = OccupancyMap(data, 1.0)
    angles = np.array([0.0, pi / 2, pi, -pi / 2])
    assert cast_rays(grid, [2.5, 2.5], angles, 10.0) == pytest.approx([1.5, 1.5, 10.0, 10.0])
    assert cast_rays(grid, [4.5, 2.5], angles, 10.0).tolist() == [0.0] * 4


def test_compiled_rays_equal_those_of_numpy() -> None:
    pytest.importorskip("numba")
    draw = np.random.default_rng(7)
    starts, angles = draw.uniform(-5, 25, (400, 2)), draw.uniform(-7, 7, 400)
    occupied = random_map(5, 20, 20).occupied
    loop = ray_casting.cast_in_cells.compile()
    for limit in (0.0, 3.0, 60.0):
        expected = ray_casting.cast_in_cells.numpy(occupied, starts, angles, limit)
        assert loop(occupied, starts, angles, limit) == pytest.approx(expected, abs=1e-12)


def test_kernels_run_in_numpy_when_turned_off(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = ray_casting.cast_in_cells
    monkeypatch.setattr(kernel, "_used", kernel.numpy)  # other tests may have compiled it
    monkeypatch.setenv("RCE_COMPILED", "no")
    assert not compile_kernels()
    assert not ray_casting.cast_in_cells.is_compiled
