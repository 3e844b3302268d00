"""The folders of raw data that a page is made of: each experiment with one software is in one of them."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.report.labels import number
from rce_fleet.experiments.report.tables import markdown
from rce_fleet.experiments.results import BESIDE, ENVIRONMENT, NOT_ANY, TABLE, Row, read_rows

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

SET_UP = ("machine", "processor", "cores", "memory_bytes", "kernel", "python", "cpu_shares", "versions")
"""What must be the same in two runs, by its name in the description, or not only chance differs."""
MISSING = "-"


@dataclass(frozen=True)
class Part:
    """A folder of raw data.

    Attributes:
        folder: The folder.
        rows: Its rows.
        environment: What they depend on; empty if the folder does not say.
    """

    folder: Path
    rows: Sequence[Row]
    environment: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path) -> Part:
        """Read a folder.

        Raises:
            OSError: A file cannot be read.
            ExperimentError: A file is not what it must be, or the folder has none; the text names it.
        """
        try:
            rows = read_rows(folder / TABLE)
        except (FileNotFoundError, NotADirectoryError):
            raise ExperimentError(f"{folder} is not a folder with raw data: there is no {TABLE}") from None
        return cls(folder, rows, _environment(folder / ENVIRONMENT))

    @property
    def experiments(self) -> list[str]:
        """Its experiments, in the order in which they were done."""
        return list(dict.fromkeys(experiment for experiment, _ in self.measured))

    @property
    def measured(self) -> list[tuple[str, str]]:
        """Its experiments with the software of each, in the order in which they were done."""
        pairs = ((row.condition.experiment, row.condition.software) for row in self.rows)
        return list(
            dict.fromkeys(
                (experiment, software) for experiment, software in pairs if experiment not in BESIDE
            )
        )

    def title(self, shared: Collection[str]) -> str:
        """Return what it is called in a table: its experiments, those that are shared with their software."""
        names = []
        for experiment in self.experiments:
            software = [name for one, name in self.measured if one == experiment and name != NOT_ANY]
            names.append(f"{experiment} ({', '.join(software)})" if experiment in shared else experiment)
        return ", ".join(names) or str(self.folder)


def read_parts(folders: Sequence[Path]) -> list[Part]:
    """Read folders that have different experiments, or the same one with different software.

    Raises:
        OSError: A file cannot be read.
        ExperimentError: A file is not what it must be, or two folders have the same experiment with the same
            software.
    """
    found: dict[tuple[str, str], Path] = {}
    parts = [Part.read(folder) for folder in folders]
    for part in parts:
        for measured in part.measured:
            if measured in found:
                experiment, software = measured
                raise ExperimentError(
                    f"the experiment {experiment} with the software {software} is in {found[measured]} and "
                    f"in {part.folder}; a page is made of one of them, and --second compares two runs of it"
                )
            found[measured] = part.folder
    return parts


def rows_of(parts: Sequence[Part]) -> list[Row]:
    """Return the rows of all parts; all measurements of the same link, and of the machine, count as runs."""
    rows = []
    runs: Counter[tuple[object, str]] = Counter()
    for row in (row for part in parts for row in part.rows):
        if row.condition.experiment in BESIDE:
            key = (row.condition, row.metric)
            runs[key] += 1
            rows.append(replace(row, run=runs[key]))
        else:
            rows.append(row)
    return rows


def environments_of(parts: Sequence[Part]) -> dict[str, Mapping[str, Any]]:
    """Return what rows depend on, by the experiments of each part; ``value`` if there is one part only."""
    if len(parts) == 1:
        return {"value": parts[0].environment} if parts[0].environment else {}
    folders = Counter(experiment for part in parts for experiment in part.experiments)
    shared = {experiment for experiment, count in folders.items() if count > 1}
    return {part.title(shared): part.environment for part in parts}


def environment_table(environments: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of what rows depend on: a column for each part."""
    if not environments:
        return f"There is no `{ENVIRONMENT}` beside the raw data."
    names = dict.fromkeys(name for environment in environments.values() for name in environment)
    rows = [
        [name, *(_value(name, environment.get(name, MISSING)) for environment in environments.values())]
        for name in names
    ]
    return markdown(("what", *environments), rows)


def differences_table(first: Mapping[str, Mapping[str, Any]], second: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of what differs between what two runs depend on; empty if nothing is known to.

    Where a run was made in parts, it has all values that a part has.
    """
    if not first or not second:
        return ""
    rows = _differences(first, second)
    if not rows:
        return ""
    table = markdown(("what differs", "first run", "second run"), rows)
    other = [f"`{row[0]}`" for row in rows if row[0] in SET_UP]
    if not other:
        return table
    return (
        f"{table}\n\nThe two runs were not made with the same {', '.join(other)}: how well they agree "
        "does not tell how well a run repeats itself."
    )


def _differences(
    first: Mapping[str, Mapping[str, Any]], second: Mapping[str, Mapping[str, Any]]
) -> list[list[str]]:
    names = dict.fromkeys(name for part in (*first.values(), *second.values()) for name in part)
    found = ([name, *(_values(name, run) for run in (first, second))] for name in names)
    return [row for row in found if row[1] != row[2]]


def _values(name: str, parts: Mapping[str, Mapping[str, Any]]) -> str:
    return "; ".join(dict.fromkeys(_value(name, part.get(name, MISSING)) for part in parts.values()))


def write_environments(path: Path, environments: Mapping[str, Mapping[str, Any]]) -> None:
    """Write what rows depend on, to be kept with their summary.

    Raises:
        OSError: The file cannot be written.
    """
    path.write_text(json.dumps(environments, indent=2) + "\n", encoding="utf-8")


def read_environments(path: Path) -> dict[str, Mapping[str, Any]]:
    """Read what :func:`write_environments` wrote; nothing if the file is missing.

    Raises:
        OSError: The file cannot be read.
        ExperimentError: It is not such a file.
    """
    found = _environment(path)
    if not all(isinstance(one, dict) for one in found.values()):
        raise ExperimentError(f"{path} is not what a page kept beside its summary")
    return found


def _environment(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise ExperimentError(f"{path} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise ExperimentError(f"{path} must have a JSON object, not {type(found).__name__}")
    return found


def _value(name: str, value: object) -> str:
    match value:
        case dict():
            return ", ".join(f"{key} {_value(key, one)}" for key, one in value.items())
        case list():
            return ", ".join(_value("", one) for one in value)
        case bool():
            return "yes" if value else "no"
        case int() if name == "memory_bytes":
            return f"{number(value / 1e9)} GB"
        case _:
            return str(value)
