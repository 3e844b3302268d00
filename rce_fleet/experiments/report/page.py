"""Makes the page of the experiments, its figures and the summary, from a folder of raw data."""

from __future__ import annotations

import json
import os
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.report import drawing
from rce_fleet.experiments.report.break_even import break_even_table
from rce_fleet.experiments.report.breaking import breaking_table
from rce_fleet.experiments.report.claims import judge_all
from rce_fleet.experiments.report.claims_part import cases, verdicts
from rce_fleet.experiments.report.figures import figures_of
from rce_fleet.experiments.report.labels import number
from rce_fleet.experiments.report.measurements import Measurements
from rce_fleet.experiments.report.repeat import compare
from rce_fleet.experiments.report.repeat_part import comparison_text
from rce_fleet.experiments.report.schematics import schematics
from rce_fleet.experiments.report.sections import LIMITS, LINK, READING, SECTIONS
from rce_fleet.experiments.report.summary import summarize, write_summary
from rce_fleet.experiments.report.tables import folded, markdown, metric_table, table_of, unlisted
from rce_fleet.experiments.results import read_rows

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from rce_fleet.experiments.report.drawing import Drawing

TABLE = "results.csv"
ENVIRONMENT = "environment.json"
SUMMARY = "summary.csv"
NOT_MEASURED = "Not measured."
_LINK = "link"
_ANALYSES = {"scaling": breaking_table, "offload": break_even_table}
"""Tables that say what follows from an experiment's medians."""


def make_report(folder: Path, *, page: Path, figures: Path, second: Path | None = None) -> None:
    """Make the page of the experiments, its figures and the summary of the raw data.

    Args:
        folder: Has the raw data, ``results.csv``, and what they depend on, ``environment.json``.
        page: The page that is written.
        figures: Folder for figures and ``summary.csv``; made if it does not exist.
        second: Folder with the raw data of a second full run, which is compared with the first one.

    Raises:
        OSError: A file cannot be read or written.
        ExperimentError: A file is not what it must be; the text names it.
    """
    measurements = Measurements.of(read_rows(folder / TABLE))
    again = Measurements.of(read_rows(second / TABLE)) if second else None
    environment = _environment(folder / ENVIRONMENT)
    figures.mkdir(parents=True, exist_ok=True)
    write_summary(figures / SUMMARY, summarize(measurements))
    drawings = figures_of(measurements)
    if drawing.can_draw():
        for one in (*schematics(), *(one for found in drawings.values() for one in found)):
            drawing.save(one, figures)
    where = PurePath(os.path.relpath(figures, page.parent)).as_posix()
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(page_text(measurements, environment, drawings, where, again), encoding="utf-8")


def page_text(
    measurements: Measurements,
    environment: Mapping[str, Any],
    drawings: Mapping[str, Sequence[Drawing]],
    figures: str,
    again: Measurements | None = None,
) -> str:
    """Return the page.

    Args:
        measurements: The raw data.
        environment: What they depend on.
        drawings: Figures by experiment.
        figures: Folder of the figures as the page links to it.
        again: The raw data of a second full run.
    """
    judgements = judge_all(measurements)
    parts = [
        _opening(figures),
        "## How this page is read",
        READING,
        "## How it was measured",
        _measured(measurements, environment),
        "## The three set-ups",
        _pictures(schematics(), figures),
        "## The paper's claims",
        "Figures and effect sizes are those of the case that is most like the paper's; all cases follow.",
        verdicts(judgements),
        cases(judgements),
    ]
    for section in SECTIONS:
        parts += [f"## {section.title}", f"Experiment `{section.experiment}`. {section.text}"]
        parts += _section(measurements, section.experiment, drawings.get(section.experiment, ()), figures)
    parts += ["## Other data", _other(measurements)]
    parts += ["## A second full run", _repeated(measurements, again)]
    parts += ["## Limits", LIMITS]
    return "\n\n".join(part.strip("\n") for part in parts if part) + "\n"


def _opening(figures: str) -> str:
    return f"""\
# Experiments

For researchers who want to know how a Single Master System (SMS), a Multi Master System (MMS) and a Cloud
Robotics System (CRS) compare, and which claims of "Managing a Fleet of Autonomous Mobile Robots using Cloud
Robotics Platform" (Singhal et al., 2017) hold. `rce experiment` made this page from raw data; do not edit
it. All medians are in [{SUMMARY}]({figures}/{SUMMARY})."""


def _measured(measurements: Measurements, environment: Mapping[str, Any]) -> str:
    table = markdown(("what", "value"), ([name, _value(name, value)] for name, value in environment.items()))
    parts = [table if environment else f"There is no `{ENVIRONMENT}` beside the raw data."]
    parts.append(table_of(measurements, _LINK, LINK) or f"The link (experiment `{_LINK}`): not measured.")
    if measurements.retried:
        parts.append(f"Runs that were tried more than once (`tries`): {measurements.retried}.")
    return "\n\n".join(parts)


def _section(
    measurements: Measurements, experiment: str, drawings: Iterable[Drawing], figures: str
) -> list[str]:
    (section,) = (one for one in SECTIONS if one.experiment == experiment)
    tables = [table_of(measurements, experiment, spec) for spec in section.tables]
    further = metric_table(measurements, unlisted(measurements, experiment, section.tables))
    tables.append(folded("Further metrics", further) if further else "")
    if make := _ANALYSES.get(experiment):
        tables.insert(0, make(measurements, experiment))
    shown = [table for table in tables if table]
    return [_pictures(drawings, figures), *shown] if shown else [NOT_MEASURED]


def _pictures(drawings: Iterable[Drawing], figures: str) -> str:
    found = list(drawings)
    if found and not drawing.can_draw():
        return f"Figures are missing: {drawing.MISSING}."
    return "\n\n".join(
        f"![{one.caption}]({figures}/{one.name}.png)\n\n*{one.caption}* ([SVG]({figures}/{one.name}.svg))"
        for one in found
    )


def _other(measurements: Measurements) -> str:
    """List what no section shows, and the values that were left out."""
    known = {section.experiment for section in SECTIONS} | {_LINK}
    further = [
        wanted
        for experiment in measurements.experiments
        if experiment not in known
        for wanted in unlisted(measurements, experiment, ())
    ]
    further += unlisted(measurements, _LINK, (LINK,))
    parts = [
        folded("Further experiments and metrics", table)
        if (table := metric_table(measurements, further))
        else ""
    ]
    if measurements.left_out:
        names = ", ".join(
            dict.fromkeys(f"`{row.metric}` of `{row.condition.experiment}`" for row in measurements.left_out)
        )
        parts.append(f"{len(measurements.left_out)} values are not finite and were left out: {names}.")
    return "\n\n".join(filter(None, parts)) or "None."


def _repeated(measurements: Measurements, again: Measurements | None) -> str:
    if again is None:
        return NOT_MEASURED
    return comparison_text(compare(summarize(measurements), summarize(again)))


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
