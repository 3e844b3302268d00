"""What move_base takes for the robot's present place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest

from rce.ros.tf import Buffer, StampedTransform, Transform
from rce.ros.types import Time
from rce_fleet.geometry.poses import Pose
from rce_fleet.nodes.robot_place import Place, RobotPlace


@dataclass
class Known:
    """Transforms that a test inserts, and a clock that it sets."""

    now: float = 100.0
    prefix: str = ""
    buffer: Buffer = field(default_factory=Buffer)

    def time(self) -> float:
        return self.now

    def resolve(self, frame: str) -> str:
        return frame.strip("/")

    def lookup(self, target: str, source: str) -> StampedTransform:
        return self.buffer.lookup(target, source)

    def tell(self, odom: float, map_: float | None = None, x: float = 0.0) -> None:
        """Insert where the robot is, ``x`` metres ahead by odometry, with the stamps of both edges."""
        edges = (("odom", "base_link", x, odom), ("map", "odom", 0.0, odom if map_ is None else map_))
        for parent, child, at, stamp in edges:
            self.buffer.insert(StampedTransform(parent, child, Transform.make(at), Time.from_sec(stamp)))


def place_of(known: Known) -> RobotPlace:
    stand_in: Any = known
    return RobotPlace(stand_in, stand_in, ("map", "odom", "base_link"), 0.5, stand_in)


def test_a_place_of_now_counts() -> None:
    """Localization dates its transform into the future, by its transform_tolerance."""
    known = Known()
    known.tell(99.8, 102.0, x=1.5)
    assert place_of(known).look() == Place(Pose(1.5, 0.0, 0.0), Pose(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("odom", "map_", "reason"),
    [
        (99.0, 100.0, "from base_link to odom is 1.00 s old (transform_tolerance 0.50 s)"),
        (102.0, 100.0, "from base_link to odom is 2.00 s in the future: are the clocks"),
        (100.0, 200.0, "from map to odom is 100.00 s in the future"),
    ],
    ids=["late", "clock", "reset"],
)
def test_a_place_of_another_time_is_a_problem(odom: float, map_: float, reason: str) -> None:
    known = Known()
    known.tell(odom, map_)
    assert reason in place_of(known).look().problem


def test_a_clock_that_is_set_back_is_forgotten() -> None:
    """While there are transforms of the future, the buffer takes none of now."""
    known = Known()
    place = place_of(known)
    known.tell(7300.0)
    assert "7200.00 s in the future" in place.look().problem
    known.tell(100.1, x=2.0)
    known.now = 100.1
    assert place.look() == Place(Pose(2.0, 0.0, 0.0), Pose(0.0, 0.0, 0.0))
