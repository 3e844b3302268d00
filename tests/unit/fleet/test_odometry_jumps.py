"""Which odometry is taken for one that jumped."""

from __future__ import annotations

import pytest

from rce_fleet.geometry.jumps import OdometryWatch
from rce_fleet.geometry.poses import Pose

ORIGIN = Pose(0.0, 0.0, 0.0)


@pytest.mark.parametrize("before", [Pose(8.0, 0.0, 0.0), Pose(0.3, 0.0, 3.0)], ids=["away", "turned"])
def test_a_driver_that_restarts_is_a_jump(before: Pose) -> None:
    """In its pause of four seconds the robot could have driven there."""
    watch = OdometryWatch()
    assert watch.check(before, 0.0) == ""
    assert "jumped to its origin" in watch.check(ORIGIN, 4.0)
    assert watch.check(Pose(0.02, 0.0, 0.0), 4.1) == ""


@pytest.mark.parametrize(
    ("before", "after", "seconds"),
    [
        (Pose(2.0, 0.0, 0.0), Pose(0.5, 0.0, 0.0), 4.0),
        (Pose(0.9, 0.0, 0.0), ORIGIN, 0.2),
        (Pose(0.4, 0.0, 0.1), ORIGIN, 4.0),
        (Pose(0.05, 0.0, 1.0), ORIGIN, 4.0),
    ],
    ids=["elsewhere", "without a pause", "slipped", "was there"],
)
def test_what_can_be_driven_is_no_jump(before: Pose, after: Pose, seconds: float) -> None:
    watch = OdometryWatch()
    assert watch.check(before, 0.0) == ""
    assert watch.check(after, seconds) == ""


def test_a_log_of_few_poses_has_no_pauses() -> None:
    """A robot that returns to where it began, with a pose every two seconds."""
    watch = OdometryWatch()
    for number, x in enumerate((0.0, 1.0, 2.0, 1.0, 0.0)):
        assert watch.check(Pose(x, 0.0, 0.0), 2.0 * number) == ""
