"""Poses and angles, one by one and as arrays."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.geometry import poses
from rce_fleet.geometry.angles import circular_mean, difference, wrap, wrap_array
from rce_fleet.geometry.poses import Pose

POSES = st.builds(Pose, st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))


def close(a: Pose, b: Pose) -> bool:
    return np.allclose((a.x, a.y), (b.x, b.y), atol=1e-9) and abs(wrap(a.yaw - b.yaw)) < 1e-9


def test_a_known_pose_in_a_turned_frame() -> None:
    seen = Pose(1.0, 2.0, pi / 2).compose(Pose(1.0, 0.5, pi / 4))
    assert close(seen, Pose(0.5, 3.0, 3 * pi / 4))


@given(POSES, POSES)
def test_relative_pose_is_the_inverse_of_compose(base: Pose, other: Pose) -> None:
    assert close(base.compose(other.relative_to(base)), other)
    assert close(base.compose(base.inverse()), Pose(0.0, 0.0, 0.0))


@given(st.lists(st.tuples(POSES, POSES), min_size=1, max_size=5))
def test_arrays_of_poses_equal_single_poses(pairs: list[tuple[Pose, Pose]]) -> None:
    first = np.array([a.as_array() for a, _ in pairs])
    second = np.array([b.as_array() for _, b in pairs])
    for (a, b), composed, seen, turned in zip(
        pairs, poses.compose(first, second), poses.relative(first, second), poses.inverse(first), strict=True
    ):
        assert close(Pose.from_array(composed), a.compose(b))
        assert close(Pose.from_array(seen), b.relative_to(a))
        assert close(Pose.from_array(turned), a.inverse())


@given(POSES, st.floats(-5, 5), st.floats(-5, 5))
def test_points_are_moved_as_poses_are(frame: Pose, x: float, y: float) -> None:
    moved = poses.transform_points(frame.as_array(), [[x, y], [0.0, 0.0]])
    expected = frame.compose(Pose(x, y, 0.0))
    assert moved[0] == pytest.approx((expected.x, expected.y), abs=1e-9)
    assert moved[1] == pytest.approx((frame.x, frame.y), abs=1e-9)


def test_wrapping_an_array_equals_wrapping_numbers() -> None:
    angles = np.array([0.0, pi, -pi, 3 * pi, -7.5, 100.0])
    assert wrap_array(angles) == pytest.approx([wrap(angle) for angle in angles])
    assert wrap_array(-pi).item() == pi


def test_mean_direction_crosses_the_back() -> None:
    assert abs(difference(circular_mean([pi - 0.1, -pi + 0.2]), pi + 0.05)) < 1e-9
    assert circular_mean([0.0, 1.0], weights=[0.0, 2.0]) == pytest.approx(1.0)
