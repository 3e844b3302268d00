"""The rows of raw data by condition and metric, and quantities that are computed from metrics.

Warm-ups do not count. If a run is in the table twice, as after an interrupted one, its last value counts.
Rows about the work itself, such as how long a run took, are kept apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
from typing import TYPE_CHECKING, Self

from rce_fleet.experiments.report.labels import condition_order
from rce_fleet.experiments.results import DONE, TRIED
from rce_fleet.experiments.schedule import WARM_UP
from rce_fleet.experiments.statistics import Estimate, estimate

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rce_fleet.experiments.results import Condition, Row


BOOKKEEPING = frozenset({DONE, TRIED})
"""Metrics of runs that say nothing about a system: how long a run took, how often it was tried."""
SHARES = frozenset({"lost"})
"""Metrics that are shares, 0 .. 1, and have no unit in the table."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """What is compared: a metric, or two of them that are added or divided run by run.

    Attributes:
        first: A metric.
        operator: ``+`` or ``/``; empty for one metric.
        second: The other metric.
        unit: The result's unit; empty for that of the first metric.
    """

    first: str
    operator: str = ""
    second: str = ""
    unit: str = ""

    def __str__(self) -> str:
        """Return it as a formula of metrics."""
        return f"{self.first} {self.operator} {self.second}" if self.operator else self.first

    def of(self, first: float, second: float) -> float | None:
        """Return its value in a run; ``None`` if it has none."""
        if self.operator == "+":
            return first + second
        return first / second if second else None


@dataclass(frozen=True)
class Sample:
    """The values of a quantity in the runs of a condition."""

    condition: Condition
    quantity: Quantity
    unit: str
    values: tuple[float, ...]
    estimate: Estimate

    @property
    def median(self) -> float:
        """The median of the runs."""
        return self.estimate.median


@dataclass(frozen=True)
class Measurements:
    """The table of raw data.

    Attributes:
        runs: Values by condition, metric and run.
        units: Units of the metrics by condition.
        left_out: Rows without a finite value.
        retried: Number of runs that were tried more than once.
    """

    runs: Mapping[Condition, Mapping[str, Mapping[int, float]]]
    units: Mapping[tuple[Condition, str], str]
    left_out: tuple[Row, ...] = ()
    retried: int = 0
    _estimates: dict[tuple[float, ...], Estimate] = field(default_factory=dict)

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Self:
        """Sort rows by condition, metric and run."""
        runs: dict[Condition, dict[str, dict[int, float]]] = {}
        units: dict[tuple[Condition, str], str] = {}
        left_out, retried = [], 0
        for row in rows:
            retried += row.metric == TRIED and row.value > 1
            if row.run == WARM_UP or row.metric in BOOKKEEPING:
                continue
            if not isfinite(row.value):
                left_out.append(row)
                continue
            runs.setdefault(row.condition, {}).setdefault(row.metric, {})[row.run] = row.value
            units[row.condition, row.metric] = row.unit or ("share" if row.metric in SHARES else "")
        return cls(runs, units, tuple(left_out), retried)

    @property
    def experiments(self) -> list[str]:
        """The experiments that have rows."""
        return sorted({condition.experiment for condition in self.runs})

    def conditions(self, experiment: str) -> list[Condition]:
        """Return the conditions of an experiment, sorted."""
        found = (condition for condition in self.runs if condition.experiment == experiment)
        return sorted(found, key=condition_order)

    def metrics(self, experiment: str) -> list[str]:
        """Return the metrics of an experiment, in the order of the table."""
        found = (self.runs[condition] for condition in self.conditions(experiment))
        return list(dict.fromkeys(metric for metrics in found for metric in metrics))

    def sample(self, condition: Condition, quantity: Quantity | str) -> Sample | None:
        """Return the values of a quantity, in the order of the runs; ``None`` if it was not measured."""
        quantity = Quantity(quantity) if isinstance(quantity, str) else quantity
        values = self._values(condition, quantity)
        if not values:
            return None
        unit = quantity.unit or self.units[condition, quantity.first]
        return Sample(condition, quantity, unit, values, self._estimate(values))

    def _values(self, condition: Condition, quantity: Quantity) -> tuple[float, ...]:
        metrics = self.runs.get(condition, {})
        first = metrics.get(quantity.first, {})
        if not quantity.operator:
            return tuple(first[run] for run in sorted(first))
        second = metrics.get(quantity.second, {})
        both = (quantity.of(first[run], second[run]) for run in sorted(first.keys() & second.keys()))
        return tuple(value for value in both if value is not None)

    def _estimate(self, values: tuple[float, ...]) -> Estimate:
        # The bootstrap takes milliseconds, and tables, claims and figures ask for the same samples.
        if values not in self._estimates:
            self._estimates[values] = estimate(values)
        return self._estimates[values]
