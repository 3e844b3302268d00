"""Tables of medians in Markdown: each row names its condition and each column its metric."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.labels import (
    Scale,
    interval,
    natural,
    scale_for,
    software_label,
    system_label,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rce_fleet.experiments.report.measurements import Measurements, Quantity, Sample
    from rce_fleet.experiments.results import Condition

    Factors = tuple[tuple[str, str], ...]

MISSING = "-"
FOLD_ROWS = 14
"""Longer tables are folded."""
_OVER_TIME = "@"


@dataclass(frozen=True)
class TableSpec:
    """A table of an experiment.

    Attributes:
        title: What it is about.
        quantities: Its columns; with ``across``, the one that is shown.
        across: A factor whose values are the columns.
    """

    title: str
    quantities: tuple[Quantity, ...]
    across: str = ""


@dataclass(frozen=True, slots=True)
class _Line:
    """A line of a table, with its samples by the names of the columns."""

    system: str
    software: str
    factors: Factors
    samples: dict[str, Sample]


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(_cell(text) for text in line)} |" for line in lines)


def folded(title: str, table: str) -> str:
    """Return a table with its title; a long one can be opened by a click."""
    if table.count("\n") - 1 <= FOLD_ROWS:
        return f"**{title}**\n\n{table}"
    return f'<details markdown="1">\n<summary>{title}</summary>\n\n{table}\n\n</details>'


def table_of(measurements: Measurements, experiment: str, spec: TableSpec) -> str:
    """Return a table of an experiment; empty if nothing of it was measured."""
    rows, columns = (_across if spec.across else _wide)(measurements, experiment, spec)
    used = [name for name in columns if any(name in row.samples for row in rows)]
    rows = [row for row in rows if row.samples]
    if not rows:
        return ""
    scales = {name: _scale(row.samples[name] for row in rows if name in row.samples) for name in used}
    factors = list(dict.fromkeys(name for row in rows for name, _ in row.factors))
    head = ["system", "software", *factors, *(f"{name}{_unit(scales[name].unit)}" for name in used), "runs"]
    lines = []
    for row in rows:
        values = dict(row.factors)
        lines.append(
            [
                *(system_label(row.system), software_label(row.software)),
                *(values.get(name, MISSING) for name in factors),
                *(
                    interval(row.samples[name].estimate, scales[name]) if name in row.samples else MISSING
                    for name in used
                ),
                _runs(row.samples.values()),
            ]
        )
    return folded(spec.title, markdown(head, lines))


def metric_table(measurements: Measurements, wanted: Iterable[tuple[Condition, str]]) -> str:
    """Return a table with a row for each metric of each condition."""
    rows = []
    for condition, metric in wanted:
        if sample := measurements.sample(condition, metric):
            scale = scale_for(sample.unit, [sample.median])
            rows.append(
                [
                    *(
                        condition.experiment,
                        system_label(condition.system),
                        software_label(condition.software),
                    ),
                    *(
                        ", ".join(f"{name}={value}" for name, value in condition.factors) or MISSING,
                        f"`{metric}`",
                    ),
                    *(interval(sample.estimate, scale), scale.unit, str(sample.estimate.runs)),
                ]
            )
    head = ("experiment", "system", "software", "factors", "metric", "median", "unit", "runs")
    return markdown(head, rows) if rows else ""


def unlisted(
    measurements: Measurements, experiment: str, specs: Sequence[TableSpec]
) -> list[tuple[Condition, str]]:
    """Return what was measured in an experiment and is in none of its tables, except values over time."""
    listed = {part for spec in specs for one in spec.quantities for part in (one.first, one.second)}
    return [
        (condition, metric)
        for condition in measurements.conditions(experiment)
        for metric in measurements.runs[condition]
        if metric not in listed and _OVER_TIME not in metric
    ]


def _wide(measurements: Measurements, experiment: str, spec: TableSpec) -> tuple[list[_Line], list[str]]:
    """Return a line for each condition, with a column for each quantity."""
    lines = []
    for condition in measurements.conditions(experiment):
        found = ((one, measurements.sample(condition, one)) for one in spec.quantities)
        samples = {f"`{one}`": sample for one, sample in found if sample}
        lines.append(_Line(condition.system, condition.software, condition.factors, samples))
    return lines, [f"`{one}`" for one in spec.quantities]


def _across(measurements: Measurements, experiment: str, spec: TableSpec) -> tuple[list[_Line], list[str]]:
    """Return a line for each condition without one of its factors, whose values are the columns."""
    lines: dict[tuple[str, str, Factors], _Line] = {}
    columns = set()
    (quantity,) = spec.quantities
    for condition in measurements.conditions(experiment):
        value = dict(condition.factors).get(spec.across, MISSING)
        kept = tuple(pair for pair in condition.factors if pair[0] != spec.across)
        key = (condition.system, condition.software, kept)
        if sample := measurements.sample(condition, quantity):
            columns.add(value)
            lines.setdefault(key, _Line(*key, {})).samples[f"`{spec.across}={value}`"] = sample
    return list(lines.values()), [f"`{spec.across}={value}`" for value in sorted(columns, key=natural)]


def _scale(samples: Iterable[Sample]) -> Scale:
    found = list(samples)
    return scale_for(found[0].unit, (sample.median for sample in found))


def _unit(unit: str) -> str:
    return f", {unit}" if unit else ""


def _runs(samples: Iterable[Sample]) -> str:
    runs = [sample.estimate.runs for sample in samples]
    return str(runs[0]) if min(runs) == max(runs) else f"{min(runs)} to {max(runs)}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
