"""Makes the page of the experiments, its figures and the summary, from folders of raw data."""

from __future__ import annotations

import os
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

from rce_fleet.experiments.report import drawing
from rce_fleet.experiments.report.break_even import break_even_table
from rce_fleet.experiments.report.breaking import breaking_table
from rce_fleet.experiments.report.claims import judge_all
from rce_fleet.experiments.report.claims_part import cases, verdicts
from rce_fleet.experiments.report.figures import figures_of
from rce_fleet.experiments.report.measurements import Measurements
from rce_fleet.experiments.report.parts import (
    differences_table,
    environment_table,
    environments_of,
    read_environments,
    read_parts,
    rows_of,
    write_environments,
)
from rce_fleet.experiments.report.repeat import compare, machine_work
from rce_fleet.experiments.report.repeat_part import comparison_text, machine_text
from rce_fleet.experiments.report.schematics import schematics
from rce_fleet.experiments.report.sections import LINK_TABLE, MACHINE_TABLE, READING, SECTIONS, limits
from rce_fleet.experiments.report.summary import Summary, read_summary, summarize, write_summary
from rce_fleet.experiments.report.tables import folded, metric_table, table_of, unlisted
from rce_fleet.experiments.results import LINK, MACHINE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from rce_fleet.experiments.report.drawing import Drawing

SUMMARY = "summary.csv"
SECOND = "second"
"""Folder of the second run's summary, beside the first one's."""
ENVIRONMENTS = "environments.json"
"""What the summary's raw data depend on, beside it."""
NOT_MEASURED = "Not measured."
_BESIDE = {LINK: LINK_TABLE, MACHINE: MACHINE_TABLE}
"""Tables of what is measured beside the experiments."""
_ANALYSES = {"scaling": breaking_table, "offload": break_even_table}
"""Tables that say what follows from an experiment's medians."""


class OtherRun(NamedTuple):
    """Another full run, which the page compares with its own."""

    summary: list[Summary]
    environments: dict[str, Mapping[str, Any]]
    """What it depends on, by experiments; empty if that was not kept."""


def make_report(folders: Sequence[Path], *, page: Path, figures: Path, second: Sequence[Path] = ()) -> None:
    """Make the page of the experiments, its figures and the summary of the raw data.

    Args:
        folders: Have the raw data, ``results.csv``, and what they depend on, ``environment.json``. Each
            experiment with one software is in one of them.
        page: The page that is written.
        figures: Folder for figures and ``summary.csv``; made if it does not exist. Its folder ``second``
            gets the ``summary.csv`` of the second run.
        second: Folders with the raw data of another full run, or its ``summary.csv``, which is compared with
            this one.

    Raises:
        OSError: A file cannot be read or written.
        ExperimentError: A file is not what it must be, or two folders have the same experiment with the
            same software; the text names them.
    """
    parts = read_parts(folders)
    measurements = Measurements.of(rows_of(parts))
    again = read_second(second) if second else None
    figures.mkdir(parents=True, exist_ok=True)
    write_summary(figures / SUMMARY, summarize(measurements))
    environments = environments_of(parts)
    write_environments(figures / ENVIRONMENTS, environments)
    if again is not None:
        (figures / SECOND).mkdir(exist_ok=True)
        write_summary(figures / SECOND / SUMMARY, again.summary)
        write_environments(figures / SECOND / ENVIRONMENTS, again.environments)
    drawings = figures_of(measurements)
    if drawing.can_draw():
        for one in (*schematics(), *(one for found in drawings.values() for one in found)):
            drawing.save(one, figures)
    where = quote(PurePath(os.path.relpath(figures, page.parent)).as_posix())
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(page_text(measurements, environments, drawings, where, again), encoding="utf-8")


def read_second(paths: Sequence[Path]) -> OtherRun:
    """Return another run, of folders with its raw data or of summaries that were kept of it.

    Raises:
        OSError: A file cannot be read.
        ExperimentError: A file is not what it must be, or two folders have the same experiment with the
            same software.
    """
    files = [path for path in paths if path.is_file()]
    kept = [one for path in files for one in read_summary(path)]
    parts = read_parts([path for path in paths if path not in files])
    environments = environments_of(parts)
    for path in files:
        found = read_environments(path.parent / ENVIRONMENTS)
        environments |= {
            f"{path.parent}: {name}" if name in environments else name: one for name, one in found.items()
        }
    return OtherRun(kept + summarize(Measurements.of(rows_of(parts))), environments)


def page_text(
    measurements: Measurements,
    environments: Mapping[str, Mapping[str, Any]],
    drawings: Mapping[str, Sequence[Drawing]],
    figures: str,
    again: OtherRun | None = None,
) -> str:
    """Return the page.

    Args:
        measurements: The raw data.
        environments: What they depend on, by the heads of the table's columns.
        drawings: Figures by experiment.
        figures: Folder of the figures as the page links to it.
        again: Another full run.
    """
    judgements = judge_all(measurements)
    parts = [
        _opening(figures),
        "## How this page is read",
        READING,
        "## How it was measured",
        _measured(measurements, environments),
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
    parts += ["## Another full run", _repeated(measurements, environments, again, figures)]
    parts += ["## Limits", limits()]
    return "\n\n".join(part.strip("\n") for part in parts if part) + "\n"


def _opening(figures: str) -> str:
    return f"""\
# Experiments

For researchers who want to know how a Single Master System (SMS), a Multi Master System (MMS) and a Cloud
Robotics System (CRS) compare, and which claims of "Managing a Fleet of Autonomous Mobile Robots using Cloud
Robotics Platform" (Singhal et al., 2017) hold. `rce experiment` made this page from raw data; do not edit
it. All medians are in [{SUMMARY}]({figures}/{SUMMARY})."""


def _measured(measurements: Measurements, environments: Mapping[str, Mapping[str, Any]]) -> str:
    parts = [environment_table(environments)]
    parts += [
        table_of(measurements, name, spec) or f"{spec.title}: not measured." for name, spec in _BESIDE.items()
    ]
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
    known = {section.experiment for section in SECTIONS} | _BESIDE.keys()
    further = [
        wanted
        for experiment in measurements.experiments
        if experiment not in known
        for wanted in unlisted(measurements, experiment, ())
    ]
    further += [one for name, spec in _BESIDE.items() for one in unlisted(measurements, name, (spec,))]
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


def _repeated(
    measurements: Measurements,
    environments: Mapping[str, Mapping[str, Any]],
    again: OtherRun | None,
    figures: str,
) -> str:
    if again is None:
        return NOT_MEASURED
    where = f"Medians of the second run are in [{SECOND}/{SUMMARY}]({figures}/{SECOND}/{SUMMARY})."
    first = summarize(measurements)
    differences = differences_table(environments, again.environments)
    machine = machine_text(machine_work(first), machine_work(again.summary))
    compared = comparison_text(compare(first, again.summary))
    return "\n\n".join(filter(None, (where, differences, machine, compared)))
