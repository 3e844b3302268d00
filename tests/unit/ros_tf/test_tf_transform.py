"""Rotations and rigid transforms."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.tf import Quaternion, Transform, Vector

angles = st.floats(-math.pi, math.pi)
lengths = st.floats(-100, 100)
rotations = st.builds(Quaternion.from_euler, angles, angles, angles)
vectors = st.builds(Vector, lengths, lengths, lengths)
transforms = st.builds(Transform, vectors, rotations)


def close(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a == pytest.approx(b, abs=1e-9)


def same_rotation(a: Quaternion, b: Quaternion) -> bool:
    return abs(a.dot(b)) == pytest.approx(1, abs=1e-9)


def test_a_quarter_turn_to_the_left() -> None:
    left = Transform.make(x=1, yaw=math.pi / 2)
    assert close(left.apply((1, 0, 0)), (1, 1, 0))
    assert close(left.inverse().apply((1, 1, 0)), (1, 0, 0))
    assert left.yaw == pytest.approx(math.pi / 2)
    assert [[round(value) for value in row] for row in left.matrix()] == [
        [0, -1, 0, 1],
        [1, 0, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 1],
    ]


def test_euler_angles_turn_about_fixed_axes() -> None:
    turn = Quaternion.from_euler(roll=math.pi / 2, yaw=math.pi / 2)
    assert close(turn.rotate(Vector(0, 1, 0)), (0, 0, 1))
    assert close(turn.rotate(Vector(1, 0, 0)), (0, 1, 0))


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_angles_come_back(roll: float, pitch: float, yaw: float) -> None:
    turn = Quaternion.from_euler(roll, pitch, yaw)
    assert same_rotation(turn, Quaternion.from_euler(*turn.to_euler()))


@given(transforms, transforms, vectors)
def test_a_chain_is_one_after_the_other(a: Transform, b: Transform, point: Vector) -> None:
    assert close((a @ b).apply(point), a.apply(b.apply(point)))


@given(transforms, vectors)
def test_the_inverse_takes_back(transform: Transform, point: Vector) -> None:
    assert close(transform.inverse().apply(transform.apply(point)), point)
    assert close((transform @ transform.inverse()).translation, (0, 0, 0))


@given(rotations, rotations)
def test_the_arc_has_its_ends_and_its_middle(a: Quaternion, b: Quaternion) -> None:
    assert same_rotation(a.slerp(b, 0), a)
    assert same_rotation(a.slerp(b, 1), b)
    middle = a.slerp(b, 0.5)
    assert middle.length == pytest.approx(1)
    assert abs(middle.dot(a)) == pytest.approx(abs(middle.dot(b)), abs=1e-6)


@given(rotations, st.floats(0, 1))
def test_the_arc_between_equal_rotations_is_a_point(turn: Quaternion, fraction: float) -> None:
    negative = Quaternion(*(-value for value in turn))
    assert same_rotation(turn.slerp(negative, fraction), turn)


def test_interpolation_in_a_plane() -> None:
    half = Transform.make(x=1, yaw=0.2).interpolate(Transform.make(x=3, y=4, yaw=0.6), 0.5)
    assert close(half.translation, (2, 2, 0))
    assert half.yaw == pytest.approx(0.4)
    other_way = Transform.make(yaw=3.0).interpolate(Transform.make(yaw=-3.0), 0.5)
    assert abs(other_way.yaw) == pytest.approx(math.pi)
