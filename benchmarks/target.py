"""A target of the benchmarks, and how its figure is found in the rows of a suite."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Target:
    """A target figure."""

    what: str
    suite: str
    read: Callable[[Rows], float | None]
    """Finds the figure; None if the rows do not contain it."""
    limit: float
    unit: str
    at_least: bool = False
    lower: float | None = None
    """A second limit, which the figure is not below."""

    @property
    def wanted(self) -> str:
        """The limits in words."""
        if self.lower is not None:
            return f"{self.lower:g} to {self.limit:g} {self.unit}".rstrip()
        return f"{'≥' if self.at_least else '≤'} {self.limit:g} {self.unit}".rstrip()

    def is_met(self, figure: float) -> bool:
        """Return whether a figure reaches the target."""
        if self.lower is not None and figure < self.lower:
            return False
        return figure >= self.limit if self.at_least else figure <= self.limit


def read_last(column: str, **where: object) -> Callable[[Rows], float | None]:
    """Read a column of the last row in which other columns have these values."""

    def read(rows: Rows) -> float | None:
        found = [row for row in rows if all(row.get(key) == value for key, value in where.items())]
        return _number(found[-1].get(column)) if found else None

    return read


def read_greatest(column: str, **where: object) -> Callable[[Rows], float | None]:
    """Read the greatest value of a column in the rows in which other columns have these values."""
    return lambda rows: max(_values(rows, column, where), default=None)


def read_least(column: str, **where: object) -> Callable[[Rows], float | None]:
    """Read the least value of a column in the rows in which other columns have these values."""
    return lambda rows: min(_values(rows, column, where), default=None)


def _values(rows: Rows, column: str, where: Mapping[str, object]) -> list[float]:
    found = [row for row in rows if all(row.get(key) == value for key, value in where.items())]
    return [number for row in found if (number := _number(row.get(column))) is not None]


def _number(value: object) -> float | None:
    """Read a figure; texts such as ``7.6 s`` by their number."""
    return None if value is None else float(str(value).split()[0])
