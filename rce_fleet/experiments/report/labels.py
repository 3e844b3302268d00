"""How systems, software, factors and numbers are written on the page and in figures."""

from __future__ import annotations

import re
from math import floor, isnan, log10
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.experiments.results import Condition
    from rce_fleet.experiments.statistics import Estimate

SYSTEMS = {"single_master": "SMS", "multi_master": "MMS", "cloud": "CRS"}
"""The paper's abbreviations of the systems, in the order of tables and figures."""
SOFTWARE = {"ros": "ROS", "roscpp": "ROS C++", "rce": "RCE"}
USUAL = frozenset({"ros", "rce"})
"""Software that the page judges even if it was not measured."""
COUNTS = frozenset({"count", ""})
"""Units of values that are counted, not measured."""
DIGITS = 3
"""Significant digits of numbers."""
_THOUSANDS = (1.0, 1e3, 1e6, 1e9)
_SCALES: dict[str, tuple[tuple[str, float], ...]] = {
    "s": (("µs", 1e-6), ("ms", 1e-3), ("s", 1.0)),
    "B": tuple(zip(("B", "kB", "MB", "GB"), _THOUSANDS, strict=True)),
    "B/s": tuple(zip(("B/s", "kB/s", "MB/s", "GB/s"), _THOUSANDS, strict=True)),
    "bit/s": tuple(zip(("bit/s", "kbit/s", "Mbit/s", "Gbit/s"), _THOUSANDS, strict=True)),
    "share": (("%", 0.01),),
}


class Scale(NamedTuple):
    """The unit in which values are shown, and how much of the unit of the raw data it is."""

    unit: str
    factor: float


def scale_for(unit: str, values: Iterable[float]) -> Scale:
    """Return the unit for values of a column: the largest one that the middle value reaches."""
    scales = _SCALES.get(unit, ((unit, 1.0),))
    sizes = sorted(abs(value) for value in values if value)
    middle = sizes[len(sizes) // 2] if sizes else 0.0
    return Scale(*max((scale for scale in scales if scale[1] <= middle), default=scales[0], key=_factor))


def number(value: float) -> str:
    """Return a number with three significant digits, never with an exponent.

    Example::

        >>> number(1234.5), number(0.01234), number(2)
        ('1234', '0.0123', '2.00')
    """
    if not value:
        return "0"
    decimals = max(0, DIGITS - 1 - floor(log10(abs(value))))
    return f"{value:.{decimals}f}"


def scaled(value: float, scale: Scale) -> str:
    """Return a value in the unit of a scale; whole counts have no decimals."""
    if scale.unit in COUNTS and value.is_integer():
        return str(int(value))
    return number(value / scale.factor)


def interval(found: Estimate, scale: Scale) -> str:
    """Return a median with its interval, ``7.50 [7.41, 7.62]``; without one, the number of runs."""
    median = scaled(found.median, scale)
    if isnan(found.low):
        return f"{median} ({found.runs} {'run' if found.runs == 1 else 'runs'})"
    return f"{median} [{scaled(found.low, scale)}, {scaled(found.high, scale)}]"


def system_label(system: str) -> str:
    """Return how a system is shown: ``SMS``."""
    return SYSTEMS.get(system, system)


def software_label(software: str) -> str:
    """Return how a software is shown: ``ROS``."""
    return SOFTWARE.get(software, software)


def factors_label(factors: Iterable[tuple[str, str]]) -> str:
    """Return factors as they are written in the raw data: ``printed=yes, rate=free``."""
    return ", ".join(f"{name}={value}" for name, value in factors) or "-"


def natural(text: str) -> tuple[tuple[float, str], ...]:
    """Return a key that sorts numbers in texts by their value: ``160x120`` before ``1920x1080``."""
    parts = re.split(r"(\d+(?:\.\d+)?)", text)
    return tuple((float(part), "") if at % 2 else (0.0, part) for at, part in enumerate(parts))


def condition_order(condition: Condition) -> tuple[object, ...]:
    """Return a key that sorts conditions: experiment, software, factors, then the order of the systems."""
    return (
        condition.experiment,
        _place(SOFTWARE, condition.software),
        condition.software,
        tuple((name, natural(value)) for name, value in condition.factors),
        _place(SYSTEMS, condition.system),
        condition.system,
    )


def _place(known: dict[str, str], name: str) -> int:
    return list(known).index(name) if name in known else len(known)


def _factor(scale: tuple[str, float]) -> float:
    return scale[1]
