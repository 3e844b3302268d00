"""``nav_msgs/OccupancyGrid`` as a map, also as other programs fill it in."""

from __future__ import annotations

from math import nan, pi
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.geometry.poses import Pose
from rce_fleet.nodes.planar import pose_fields, read_map, read_pose

if TYPE_CHECKING:
    from rce.ros.types import Message

TYPES = TypeRegistry(PackageIndex([]))


def grid(origin: dict[str, Any]) -> Message:
    info = {"width": 3, "height": 2, "resolution": 0.5, "origin": origin}
    return TYPES.message("nav_msgs/OccupancyGrid").new(info=info, data=[0, 100, -1, 0, 0, 0])


def test_a_map_keeps_its_cells_and_origin() -> None:
    found = read_map(grid(pose_fields(Pose(1.0, -2.0, pi / 2))))
    assert np.array_equal(found.data, [[0, 100, -1], [0, 0, 0]])
    assert found.resolution == 0.5
    assert found.origin.as_array() == pytest.approx((1.0, -2.0, pi / 2))


def test_an_origin_without_orientation_is_not_turned() -> None:
    """As octomap_server publishes it."""
    assert read_map(grid({"position": {"x": 1.0, "y": -2.0}})).origin == Pose(1.0, -2.0, 0.0)


@pytest.mark.parametrize(
    ("origin", "words"),
    [
        ({"position": {"x": nan}}, "not finite"),
        ({"orientation": {"w": nan}}, "not finite"),
        ({"orientation": {"z": 1e-5}}, "not a rotation"),
        ({"orientation": {"x": 1.0}}, "not a rotation about z"),
    ],
)
def test_a_map_with_a_wrong_origin_is_refused(origin: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        read_map(grid(origin))


def test_a_pose_without_orientation_is_refused() -> None:
    with pytest.raises(ValueError, match="straight ahead"):
        read_pose(TYPES.message("geometry_msgs/Pose").new(position={"x": 1.0}))
