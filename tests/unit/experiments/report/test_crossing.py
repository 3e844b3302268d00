"""Break-even of robot and cloud, computed by hand beside."""

from __future__ import annotations

import pytest
from support.experiment_rows import CRS, rows_of

from rce_fleet.experiments.report.crossing import Point, crossing, crossing_table, crossing_text
from rce_fleet.experiments.report.measurements import Measurements
from rce_fleet.experiments.results import Condition

ROBOT = [Point(5, 10.0)]


@pytest.mark.parametrize(
    ("cloud", "found"),
    [
        ([Point(5, 4.0), Point(45, 14.0)], 29.0),
        ([Point(5, 4.0), Point(25, 8.0), Point(45, 12.0)], 35.0),
        ([Point(0.3, 30.0), Point(0.5, 5.0), Point(50, 5.0)], 0.46),
        ([Point(5, 10.0), Point(45, 14.0)], 5.0),
        ([Point(5, 4.0), Point(45, 10.0)], 45.0),
        ([Point(5, 4.0), Point(45, 9.0)], None),
        ([Point(5, 11.0), Point(45, 12.0)], None),
        ([Point(5, 11.0)], None),
        ([], None),
    ],
)
def test_curves_cross_where_they_are_equal(cloud: list[Point], found: float | None) -> None:
    assert crossing(ROBOT, cloud) == (None if found is None else pytest.approx(found))


def test_a_robots_curve_is_interpolated_too() -> None:
    robot = [Point(10, 10.0), Point(30, 20.0)]
    # Between its points the robot takes 5 + 0.5 * delay, and before them 10.
    assert crossing(robot, [Point(10, 5.0), Point(20, 15.0)]) == pytest.approx(20.0)
    assert crossing(robot, [Point(0, 0.0), Point(40, 32.0)]) == pytest.approx(50 / 3)


def test_without_a_crossing_the_better_place_is_told() -> None:
    cloud = [Point(5, 4.0), Point(45, 9.0)]
    assert crossing_text(ROBOT, cloud, "ms") == "none within the measured range (cloud is better)"
    assert crossing_text([Point(5, 1.0)], cloud, "ms") == "none within the measured range (robot is better)"
    assert crossing_text([Point(5, 6.5)], cloud, "ms") == "25.0 ms"
    assert crossing_text(cloud, cloud, "ms") == "none within the measured range (both are equal)"


def test_the_table_has_each_task_and_metric_over_each_factor() -> None:
    def condition(place: str, rate: float, delay: int) -> Condition:
        return Condition.of("offload", CRS, "rce", place=place, task="mapping", rate=rate, delay=delay)

    rows = rows_of(condition("robot", 50, 5), {"task_time": (4.0, "s"), "energy": (90.0, "J")})
    for rate, delay, seconds in ((50, 5, 3.0), (50, 105, 5.0), (0.5, 5, 8.0)):
        rows += rows_of(condition("cloud", rate, delay), {"task_time": (seconds, "s"), "energy": (50.0, "J")})
    table = crossing_table(Measurements.of(rows), "offload")
    assert "| CRS | RCE | mapping | `task_time` | `delay` | rate 50 Mbit/s | 55.0 ms |" in table
    assert "| mapping | `task_time` | `rate` | delay 5 ms | 40.1 Mbit/s |" in table
    never = "none within the measured range (cloud is better)"
    assert f"| mapping | `energy` | `delay` | rate 50 Mbit/s | {never} |" in table
    assert "control_delay" not in table
    assert crossing_table(Measurements.of([]), "offload") == ""
