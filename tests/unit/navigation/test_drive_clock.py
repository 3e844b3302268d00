"""Which velocities of an operator are late, seen from the robot."""

from __future__ import annotations

import pytest

from rce_fleet.navigation.safety.drive_clock import LATE_S, SILENT_S, DriveClock

STATION = 5000.0
"""The station's clock has nothing to do with the robot's."""


def driven(delays: list[float]) -> DriveClock:
    """A drive with ten velocities a second that took so long."""
    clock = DriveClock()
    for number, delay in enumerate(delays):
        assert clock.take(STATION + 0.1 * number, 0.1 * number + delay)
    return clock


@pytest.mark.parametrize(
    ("delays", "is_late"),
    [
        ([], False),
        ([0.05] * 3, False),
        ([0.05, 0.05 + LATE_S - 0.01], False),
        ([0.05, 0.05 + LATE_S + 0.01], True),
        ([0.05, 0.6, 0.5, 0.4], False),
    ],
)
def test_velocities_later_than_the_fastest_are_late(delays: list[float], is_late: bool) -> None:
    assert driven(delays).is_late(0.1 * len(delays) + 1.0) is is_late


def test_after_a_silence_another_drive_begins() -> None:
    """Perhaps at another station, whose clock is behind."""
    clock = driven([0.05, 1.0])
    assert clock.is_late(1.2)
    assert not clock.is_late(1.3 + SILENT_S)
    clock.take(STATION - 100.0, 1.3 + SILENT_S)
    assert not clock.is_late(1.3 + SILENT_S)


def test_a_clock_that_goes_back_is_another_one() -> None:
    clock = driven([0.05, 0.05])
    clock.take(STATION - 100.0, 0.3)
    assert not clock.is_late(0.3)


@pytest.mark.parametrize("sent", [float("nan"), float("inf")])
def test_a_time_that_is_not_finite_is_ignored(sent: float) -> None:
    clock = DriveClock()
    assert not clock.take(sent, 1.0)
    assert not clock.is_late(1.0)
