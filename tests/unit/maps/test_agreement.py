"""How maps are compared."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.agreement import compare_maps
from rce_fleet.maps.occupancy_map import UNKNOWN, OccupancyMap


def room() -> OccupancyMap:
    """Return a room of 2 x 1 m with walls of a cell, and unknown cells around."""
    data = np.full((30, 50), UNKNOWN, np.int8)
    data[4:26, 4:46] = 100
    data[5:25, 5:45] = 0
    data[5:12, 30:36] = 100  # a box in a corner: the room has no symmetry
    return OccupancyMap(data, 0.05)


def test_a_map_agrees_with_itself() -> None:
    found = compare_maps(room(), room())
    assert (found.explored, found.right, found.wall_error_m, found.wall_error_p95_m) == (1.0, 1.0, 0.0, 0.0)
    assert found.as_json()["right"] == 1.0


def test_a_shift_within_a_cell_is_forgiven() -> None:
    """Walls fall into the next cell by rounding; the error of the walls tells of it."""
    shifted = replace(room(), origin=Pose(0.05, 0.0, 0.0))
    found = compare_maps(shifted, room())
    assert found.right == 1.0
    assert 0.0 < found.wall_error_m <= 0.05


def test_a_greater_shift_is_an_error() -> None:
    found = compare_maps(replace(room(), origin=Pose(0.2, 0.0, 0.0)), room())
    assert found.right < 0.97
    assert found.wall_error_p95_m == pytest.approx(0.2)


def test_unexplored_space_is_told() -> None:
    data = room().data.copy()
    data[:, 25:] = UNKNOWN
    found = compare_maps(OccupancyMap(data, 0.05), room())
    assert found.explored == pytest.approx(0.5, abs=0.05)
    assert found.right == pytest.approx(0.5, abs=0.05)
    assert found.wall_error_m == 0.0


def test_maps_of_other_sizes_and_directions_are_compared() -> None:
    """A mapper that begins turned by 90 degrees draws the same room in other cells."""
    true = room()
    turned = OccupancyMap(np.rot90(true.data, -1), 0.05, Pose(0.0, true.size[1], -pi / 2))
    found = compare_maps(turned, true)
    assert found.explored == 1.0
    assert found.right > 0.99


def test_a_wall_outside_of_the_true_map_counts_with_its_distance() -> None:
    data = np.full((30, 110), UNKNOWN, np.int8)
    data[:30, :50] = room().data
    data[10, 100] = 100
    found = compare_maps(OccupancyMap(data, 0.05), room())
    assert found.wall_error_m > 0.0
    empty = OccupancyMap(np.full((5, 5), UNKNOWN, np.int8), 0.05)
    assert compare_maps(empty, room()).explored == 0.0
