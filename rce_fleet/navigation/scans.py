"""Checks of what a lidar sends, before anything relies on it."""

from __future__ import annotations

from math import isfinite, pi

_SLACK = 2
"""How many beams more or fewer than its angles say a scan may have: drivers round differently."""
_SLACK_SHARE = 0.02
"""The same as a share of its beams."""
_FUTURE = 0.5
"""How far in the future a stamp may be, seconds."""


def fault_of_scan(count: int, angles: tuple[float, float, float], ranges: tuple[float, float]) -> str:
    """Return what is wrong with the header of a ``sensor_msgs/LaserScan``; empty if nothing is.

    Args:
        count: Number of ranges.
        angles: ``angle_min``, ``angle_max`` and ``angle_increment``, radians.
        ranges: ``range_min`` and ``range_max``, metres.
    """
    first, last, step = angles
    if not all(map(isfinite, (*angles, *ranges))):
        return "its angles and limits must be finite"
    if not count:
        return "it has no ranges"
    if step == 0 or abs(step) > pi:
        return f"angle_increment must not be 0 nor above pi, found {step}"
    expected = (last - first) / step + 1
    if not is_count_of(count, expected):
        return f"expected {expected:.0f} ranges from angle_min, angle_max and angle_increment, found {count}"
    if not 0 <= ranges[0] < ranges[1]:
        return f"range_min must be below range_max, found {ranges[0]} and {ranges[1]}"
    return ""


def is_count_of(count: int, expected: float) -> bool:
    """Return whether a scan's number of ranges is that of its angles, or near enough."""
    return abs(count - expected) <= max(_SLACK, _SLACK_SHARE * count)


def fault_of_stamp(stamp: float, now: float, oldest: float) -> str:
    """Return what is wrong with a message's time; empty if nothing is.

    Args:
        stamp: Its time, seconds.
        now: The time now, seconds.
        oldest: Greatest age at which it is of use, seconds.
    """
    if stamp > now + _FUTURE:
        return f"its stamp is {stamp - now:.2f} s in the future: are the clocks of the machines in step?"
    if now - stamp > oldest:
        return f"it is {now - stamp:.2f} s old (limit {oldest:.2f} s)"
    return ""
