"""The raw data of experiments: one table with a row for each value that was measured in a run.

The columns of the CSV file are ``experiment``, ``system``, ``software``, ``factors`` (``name=value`` pairs,
sorted, separated by ``;``), ``run``, ``metric``, ``value`` and ``unit``. A file beside it describes the
machine.
"""

from __future__ import annotations

import csv
import os
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from rce_fleet.exceptions import ExperimentError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

TABLE = "results.csv"
"""The table's file in a folder of raw data."""
ENVIRONMENT = "environment.json"
"""The file beside it: what the rows depend on."""
NOT_ANY = "-"
"""System or software of a condition that has none."""
LINK = "link"
"""Experiment of what is measured of the links themselves."""
MACHINE = "machine"
"""Experiment of what is measured of the computer itself."""
BESIDE = frozenset({LINK, MACHINE})
"""What each folder of raw data has measured beside its experiments."""
WORK = "work"
"""Metric of the computer itself: processor time of a piece of work that is always the same, seconds."""
DONE = "done"
"""Metric of the last row of a run: how long it took, seconds."""
TRIED = "tries"
"""Metric: how often a run was tried until it succeeded."""
COLUMNS = ("experiment", "system", "software", "factors", "run", "metric", "value", "unit")


class Condition(NamedTuple):
    """What is measured in several runs: an experiment, a system, its software, and the factors."""

    experiment: str
    system: str
    software: str
    factors: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, experiment: str, system: str, software: str, **factors: object) -> Condition:
        """Make a condition; the order of the factors does not matter."""
        return cls(experiment, system, software, tuple(sorted((k, str(v)) for k, v in factors.items())))


@dataclass(frozen=True, slots=True)
class Row:
    """A value that was measured."""

    condition: Condition
    run: int
    metric: str
    value: float
    unit: str


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Append rows to a table, which is made if it does not exist. They are on disk when this returns.

    Raises:
        OSError: The file cannot be written.
        ExperimentError: A name contains a separator.
    """
    is_new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(COLUMNS)
        for row in rows:
            experiment, system, software, factors = row.condition
            writer.writerow(
                (
                    experiment,
                    system,
                    software,
                    joined_factors(factors),
                    row.run,
                    row.metric,
                    repr(row.value),
                    row.unit,
                )
            )
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[Row]:
    """Read a table. A last line that was not completely written is left out.

    Raises:
        OSError: The file cannot be read.
        ExperimentError: It is not such a table; the text names the line.
    """
    found = []
    for number, fields in read_table(path, COLUMNS, "a table of raw data"):
        try:
            experiment, system, software, factors, run, metric, value, unit = fields
            condition = Condition(experiment, system, software, split_factors(factors))
            found.append(Row(condition, int(run), metric, float(value), unit))
        except ValueError as error:
            raise ExperimentError(f"{path}:{number}: {error}") from error
    return found


def read_table(path: Path, columns: Sequence[str], what: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a CSV file after the first one, each with its number.

    A last line that was not completely written is left out.

    Args:
        path: The file.
        columns: What its first line must have.
        what: What the file must be, for errors.

    Raises:
        OSError: The file cannot be read.
        ExperimentError: It is not such a table.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets begin with the mark
    except UnicodeDecodeError as error:
        raise ExperimentError(f"{path} is not UTF-8: {error}") from error
    reader = csv.reader(text.split("\n")[:-1])
    try:
        if tuple(next(reader, ())) != tuple(columns):
            raise ExperimentError(f"{path} is not {what}: it has no columns {', '.join(columns)}")
        for fields in reader:
            yield reader.line_num, fields
    except csv.Error as error:
        raise ExperimentError(f"{path}:{reader.line_num}: {error}") from error


def by_condition(rows: Iterable[Row], metric: str) -> Mapping[Condition, list[float]]:
    """Return the values of a metric for each condition, in the order of the runs."""
    found: dict[Condition, list[tuple[int, float]]] = defaultdict(list)
    for row in rows:
        if row.metric == metric:
            found[row.condition].append((row.run, row.value))
    return {condition: [value for _, value in sorted(pairs)] for condition, pairs in found.items()}


def error_text(error: Exception) -> str:
    """Return an error's text; of an error of the system, the file and the reason; never an empty one."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__


def joined_factors(factors: tuple[tuple[str, str], ...]) -> str:
    """Return factors as they are written in tables, ``name=value;name=value``.

    Raises:
        ExperimentError: A name or value contains a separator.
    """
    for name, value in factors:
        if any(mark in f"{name}{value}" for mark in ";=\n"):
            raise ExperimentError(f"a factor must not contain ; = or a line break: {name!r} = {value!r}")
    return ";".join(f"{name}={value}" for name, value in factors)


def split_factors(text: str) -> tuple[tuple[str, str], ...]:
    """Return the factors of a text that :func:`joined_factors` made."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return tuple((name, value) for name, _, value in pairs)
