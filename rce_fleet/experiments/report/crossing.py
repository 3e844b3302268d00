"""Where the figures of a task on the robot and in the cloud cross, over delay or rate of the link."""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from rce_fleet.experiments.report.labels import number, software_label, system_label
from rce_fleet.experiments.report.tables import folded, markdown

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.experiments.report.measurements import Measurements

METRICS = ("task_time", "control_delay", "energy")
"""The less, the better."""
UNITS = {"delay": "ms", "rate": "Mbit/s"}
"""The factors that change, with their units."""


class Point(NamedTuple):
    """A median at a delay or a rate."""

    at: float
    median: float


class _Curve(NamedTuple):
    """What is compared: a metric of a task over a factor, at a value of the other factor."""

    system: str
    software: str
    task: str
    metric: str
    over: str
    fixed: str


def crossing(robot: Sequence[Point], cloud: Sequence[Point]) -> float | None:
    """Return the lowest value of the factor at which both are equal, by linear interpolation.

    Args:
        robot: Points in rising order; outside of them, and if there is one only, the nearest one counts.
        cloud: Points in rising order.

    Returns:
        The value within the range of ``cloud``; None if the curves do not cross there, or are the same.
    """
    if not cloud:
        return None
    places = {point.at for point in (*robot, *cloud) if cloud[0].at <= point.at <= cloud[-1].at}
    apart = [(at, _value(cloud, at) - _value(robot, at)) for at in sorted(places)]
    if len(apart) > 1 and not any(difference for _, difference in apart):
        return None
    for (before, first), (after, second) in pairwise(apart):
        if first == 0:
            return before
        if first * second < 0:
            return before + (after - before) * first / (first - second)
    return apart[-1][0] if apart[-1][1] == 0 else None


def crossing_text(robot: Sequence[Point], cloud: Sequence[Point], unit: str) -> str:
    """Return where the curves cross; if they do not, which place is better."""
    found = crossing(robot, cloud)
    if found is not None:
        return f"{number(found)} {unit}"
    there, here = cloud[0].median, _value(robot, cloud[0].at)
    better = "both are equal" if there == here else f"{'cloud' if there < here else 'robot'} is better"
    return f"none within the measured range ({better})"


def crossing_table(measurements: Measurements, experiment: str) -> str:
    """Return a table of all crossings; empty if no factor was changed."""
    robot: dict[_Curve, list[Point]] = {}
    cloud: dict[_Curve, list[Point]] = {}
    known: dict[tuple[str, str, str, str], list[Point]] = {}
    for condition in measurements.conditions(experiment):
        factors = dict(condition.factors)
        if not {"place", "task", *UNITS} <= set(factors):
            continue
        for metric in METRICS:
            sample = measurements.sample(condition, metric)
            if sample is None:
                continue
            head = (condition.system, condition.software, factors["task"], metric)
            for over, other in (("delay", "rate"), ("rate", "delay")):
                curve = _Curve(*head, over, f"{other} {factors[other]} {UNITS[other]}")
                place = robot if factors["place"] == "robot" else cloud
                place.setdefault(curve, []).append(Point(float(factors[over]), sample.median))
            if factors["place"] == "robot":
                known.setdefault(head, []).append(Point(0.0, sample.median))
    rows = []
    for curve, points in cloud.items():
        # On the robot nothing crosses the link: it may have been measured with one link only.
        others = robot.get(curve) or known.get(curve[:4], [])[:1]
        if len(points) > 1 and others:
            text = crossing_text(sorted(others), sorted(points), UNITS[curve.over])
            rows.append([*_names(curve), text])
    head_row = ("system", "software", "task", "metric", "over", "at", "break-even")
    return folded("Break-even by interpolation of medians", markdown(head_row, rows)) if rows else ""


def _names(curve: _Curve) -> list[str]:
    return [
        system_label(curve.system),
        software_label(curve.software),
        curve.task,
        f"`{curve.metric}`",
        f"`{curve.over}`",
        curve.fixed,
    ]


def _value(points: Sequence[Point], at: float) -> float:
    """Return a curve's value by linear interpolation; beyond its ends, that of the nearest point."""
    place = bisect_left([point.at for point in points], at)
    if place == 0 or place == len(points):
        return points[min(place, len(points) - 1)].median
    before, after = points[place - 1], points[place]
    share = (at - before.at) / (after.at - before.at)
    return before.median + share * (after.median - before.median)
