"""The summary of raw data, small enough to commit: medians with intervals by condition and metric."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from math import inf, isfinite, isnan
from typing import TYPE_CHECKING

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.report.labels import condition_order
from rce_fleet.experiments.results import Condition, joined_factors, read_table, split_factors
from rce_fleet.experiments.statistics import Estimate

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from rce_fleet.experiments.report.measurements import Measurements

COLUMNS = (
    "experiment",
    "system",
    "software",
    "factors",
    "metric",
    "unit",
    "runs",
    "median",
    "low",
    "high",
)
DIGITS = 6
"""Significant digits of a summary's numbers: more than any measurement has."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What the runs of a condition gave for a metric."""

    condition: Condition
    metric: str
    unit: str
    estimate: Estimate


def summarize(measurements: Measurements) -> list[Summary]:
    """Return the estimate of each metric of each condition, sorted."""
    found = []
    for condition in sorted(measurements.runs, key=condition_order):
        for metric in sorted(measurements.runs[condition]):
            if sample := measurements.sample(condition, metric):
                median, low, high = (float(_digits(value)) for value in sample.estimate[:3])
                rounded = Estimate(median, low, high, sample.estimate.runs)
                found.append(Summary(condition, metric, sample.unit, rounded))
    return found


def write_summary(path: Path, summaries: Iterable[Summary]) -> None:
    """Write a summary; intervals are empty where there were too few runs.

    Raises:
        OSError: The file cannot be written.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for one in summaries:
            experiment, system, software, factors = one.condition
            median, low, high, runs = one.estimate
            writer.writerow(
                (
                    *(experiment, system, software, joined_factors(factors), one.metric, one.unit, runs),
                    *("" if isnan(value) else _digits(value) for value in (median, low, high)),
                )
            )


def read_summary(path: Path) -> list[Summary]:
    """Read a summary.

    Raises:
        OSError: The file cannot be read.
        ExperimentError: It is not a summary; the text names the line.
    """
    found = []
    for number, fields in read_table(path, COLUMNS, "a summary"):
        try:
            experiment, system, software, factors, metric, unit, runs, *numbers = fields
            median, low, high = (float(text or "nan") for text in numbers)
            condition = Condition(experiment, system, software, split_factors(factors))
            estimate = _checked(Estimate(median, low, high, int(runs)))
            found.append(Summary(condition, metric, unit, estimate))
        except ValueError as error:
            raise ExperimentError(f"{path}:{number}: {error}") from error
    return found


def _checked(found: Estimate) -> Estimate:
    """Return an estimate that runs can give.

    Raises:
        ValueError: They cannot.
    """
    median, low, high, runs = found
    has_interval = not (isnan(low) and isnan(high))
    if not isfinite(median) or (has_interval and not -inf < low <= high < inf) or runs < 1:
        raise ValueError(
            "runs must be 1 or more, the median a number, and low and high in rising order or both empty"
        )
    return found


def _digits(value: float) -> str:
    return f"{value:.{DIGITS}g}"
