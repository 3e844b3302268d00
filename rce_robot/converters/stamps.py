"""``time`` and ``duration`` as JSON.

A time is an ISO 8601 string in UTC with microseconds and without a zone, ``2013-09-02T12:00:00.000000``,
which is what the original engine's clients read; a received time may have a zone; without one it is UTC. A
duration is a number of seconds. Both may come as ``{"secs": ..., "nsecs": ...}``, which keeps the
nanoseconds.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import Any

from rce_robot.converters.values import describe

_NANOSECONDS = 1_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def time_to_json(secs: int, nsecs: int) -> str:
    """Format a time."""
    if nsecs >= _NANOSECONDS:
        secs, nsecs = secs + nsecs // _NANOSECONDS, nsecs % _NANOSECONDS
    return f"{_to_second(secs)}.{nsecs // 1000:06d}"


@lru_cache(maxsize=256)
def _to_second(secs: int) -> str:
    # Many messages have the same second; the date is the expensive part.
    return (_EPOCH + timedelta(seconds=secs)).strftime("%Y-%m-%dT%H:%M:%S")


def time_from_json(value: Any) -> tuple[int, int]:
    """Read a time into seconds and nanoseconds.

    Raises:
        ValueError: It is not a time, or not one between 1970 and 2106.
    """
    if value.__class__ is dict:
        return _parts(value, "time", 0, 0xFFFFFFFF)
    if value.__class__ is not str:
        raise ValueError(f"{describe(value)} is not a time (an ISO 8601 string)")
    try:
        moment = datetime.fromisoformat(value)
    except ValueError:
        raise ValueError(f"{describe(value)} is not an ISO 8601 time") from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    since = moment - _EPOCH
    secs = since.days * 86400 + since.seconds
    if not 0 <= secs <= 0xFFFFFFFF:  # noqa: PLR2004
        raise ValueError(f"{describe(value)} is out of the range of time (1970 to 2106)")
    return secs, since.microseconds * 1000


def duration_to_json(secs: int, nsecs: int) -> float:
    """Return a duration as the nearest float."""
    return (secs * _NANOSECONDS + nsecs) / _NANOSECONDS


def duration_from_json(value: Any) -> tuple[int, int]:
    """Read a duration into seconds and nanoseconds; the nanoseconds are never negative.

    Raises:
        ValueError: It is not a duration, or out of range.
    """
    if value.__class__ is dict:
        return _parts(value, "duration", -0x80000000, 0x7FFFFFFF)
    if value.__class__ is int:
        secs, nsecs = value, 0
    elif value.__class__ is float and math.isfinite(value):
        whole = math.floor(value)
        carry, nsecs = divmod(round((value - whole) * _NANOSECONDS), _NANOSECONDS)
        secs = whole + carry
    else:
        raise ValueError(f"{describe(value)} is not a duration (a number of seconds)")
    if not -0x80000000 <= secs <= 0x7FFFFFFF:  # noqa: PLR2004
        raise ValueError(f"{describe(value)} is out of the range of duration")
    return secs, nsecs


def _parts(value: dict[str, Any], kind: str, low: int, high: int) -> tuple[int, int]:
    secs, nsecs = _whole(value.get("secs", 0)), _whole(value.get("nsecs", 0))
    if len(value) != ("secs" in value) + ("nsecs" in value):
        raise ValueError(
            f"an object that is a {kind} has secs and nsecs, this one has {', '.join(value)[:80]}"
        )
    # On the wire both have the range of the seconds.
    for name, part in (("secs", secs), ("nsecs", nsecs)):
        if part.__class__ is not int or not low <= part <= high:
            raise ValueError(
                f"{name} of a {kind} is {describe(part)}, must be an integer from {low} to {high}"
            )
    return secs, nsecs


def _whole(value: Any) -> Any:
    """Convert a number without fraction to an integer; leave other values for the check."""
    return int(value) if value.__class__ is float and value.is_integer() else value
