"""What stops a robot that is driven by hand."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.station.commands.driving import (
    DEAD_S,
    LATE_S,
    MAX_SPEED,
    MAX_TURN_RATE,
    ROUND_TRIP_S,
    DriveFrame,
    DriveGuard,
    RobotRoundTrip,
)

PAGE_CLOCK = 5000.0
"""The page's clock has nothing to do with the station's."""


def frame(number: int, **fields: float | bool) -> DriveFrame:
    known = {"sent": PAGE_CLOCK + 0.1 * number, "held": True, "speed": 0.3, "turn_rate": -0.2}
    return DriveFrame.model_validate({"number": number, **known, **fields})


def test_a_held_switch_lets_frames_pass() -> None:
    guard = DriveGuard()
    assert [guard.take(frame(n), 100.0 + 0.1 * n) for n in range(3)] == [(0.3, -0.2)] * 3
    assert guard.reason == ""


def test_a_released_switch_stops() -> None:
    guard = DriveGuard()
    guard.take(frame(0), 100.0)
    assert guard.take(frame(1, held=False), 100.1) == (0.0, 0.0)
    assert "released" in guard.reason


def test_missing_frames_stop() -> None:
    guard = DriveGuard()
    assert guard.check(0.0), "before the first frame, too"
    guard.take(frame(0), 100.0)
    assert not guard.check(100.0 + 0.5 * DEAD_S)
    assert guard.check(100.0 + DEAD_S)
    assert guard.reason == "no frame came"


def test_late_frames_stop_whatever_the_clocks_say() -> None:
    guard = DriveGuard()
    guard.take(frame(0), 100.0)
    assert guard.take(frame(1), 100.1 + LATE_S + 0.01) == (0.0, 0.0)
    assert guard.reason == "frames are late"
    assert guard.take(frame(9), 100.9 + 0.5 * LATE_S) == (0.3, -0.2), "and drive on when they are not"


def test_a_slow_round_trip_stops() -> None:
    guard = DriveGuard()
    assert guard.take(frame(0, round_trip=ROUND_TRIP_S + 0.1), 100.0) == (0.0, 0.0)
    assert "round trip" in guard.reason


def test_the_round_trip_goes_on_to_the_robot() -> None:
    """A network with seconds of queue shows nothing between page and station."""
    robot = RobotRoundTrip()
    guard = DriveGuard(robot)
    robot.sent(100.0)
    assert guard.take(frame(0), 100.0) == (0.3, -0.2), "a robot that never answers is not measured"
    robot.answered(100.0, 100.1)
    robot.sent(100.1)
    assert guard.take(frame(1, round_trip=0.2), 100.2) == (0.3, -0.2)
    assert guard.take(frame(2, round_trip=ROUND_TRIP_S - 0.1), 100.3) == (0.0, 0.0)
    assert guard.reason == "a round trip to the robot takes 0.7 s"


def test_a_robot_whose_answer_is_awaited_stops() -> None:
    """Without a frame, too: the station looks again and again."""
    robot = RobotRoundTrip()
    guard = DriveGuard(robot)
    for number in range(3):
        robot.sent(100.0 + 0.1 * number)
    robot.answered(100.0, 100.05)
    assert robot.seconds(100.2) == pytest.approx(0.1)
    at = 100.1 + ROUND_TRIP_S
    guard.take(frame(7), at - 0.01)
    assert [guard.check(at - 0.01), guard.check(at + 0.01)] == [False, True]
    robot.answered(100.2, at)
    assert robot.seconds(at + 1) == pytest.approx(at - 100.2)


@pytest.mark.parametrize("sent", [float("nan"), float("-inf"), 200.0])
def test_an_answer_that_cannot_be_is_ignored(sent: float) -> None:
    robot = RobotRoundTrip()
    robot.answered(sent, 100.0)
    assert robot.seconds(100.0) is None


@pytest.mark.parametrize("number", [0, 4, 5])
def test_a_frame_out_of_order_stops(number: int) -> None:
    guard = DriveGuard()
    guard.take(frame(5), 100.0)
    assert guard.take(frame(number), 100.1) == (0.0, 0.0)


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_velocities_stay_within_their_limits(speed: float, turn_rate: float) -> None:
    got = DriveGuard().take(frame(0, speed=speed, turn_rate=turn_rate), 100.0)
    assert abs(got[0]) <= MAX_SPEED
    assert abs(got[1]) <= MAX_TURN_RATE
    assert got[0] * speed >= 0
