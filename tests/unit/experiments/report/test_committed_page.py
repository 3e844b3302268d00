"""The committed page of the experiments has the numbers of the summary that is committed with it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import pytest
from support.experiment_page import (
    CELL,
    UNITS,
    Cell,
    cells_of_cases,
    cells_of_experiments,
    cells_of_verdicts,
    condition_of_case,
    tables_of,
)

from rce_fleet.experiments.report.summary import read_summary
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.statistics import Estimate

pytestmark = pytest.mark.slow
"""They need what reads summaries, which takes long to load."""

DOCS = Path(__file__).parents[4] / "docs"
Known = dict[tuple[Condition, str], Estimate]


@pytest.fixture(scope="module")
def page() -> str:
    return (DOCS / "experiments.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def known() -> Known:
    return read_known(DOCS / "experiments" / "summary.csv")


def read_known(path: Path) -> Known:
    return {(one.condition, one.metric): one.estimate for one in read_summary(path)}


def check(cells: Iterable[Cell], known: Known) -> int:
    """Compare medians and intervals with the summary; return how many were compared.

    A quantity of two metrics is computed run by run, which a summary cannot tell.
    """
    checked = 0
    for cell in cells:
        estimate = known.get((cell.condition, cell.quantity))
        if " " in cell.quantity:
            continue
        assert (estimate is None) == (cell.text == "-"), cell
        if estimate is None:
            continue
        found = CELL.fullmatch(cell.text)
        assert found, cell
        shown = [float(number) for number in found.groups()[:3] if number]
        numbers = [number / UNITS.get(cell.unit, 1.0) for number in estimate[: len(shown)]]
        assert shown == [pytest.approx(number, rel=0.006) for number in numbers], cell
        if found[4] or cell.runs.isdigit():
            assert int(found[4] or cell.runs) == estimate.runs, cell
        checked += 1
    return checked


def test_committed_tables_are_those_of_the_summary(page: str, known: Known) -> None:
    assert check(cells_of_experiments(page), known) > 1000


def test_committed_claims_are_those_of_the_summary(page: str, known: Known) -> None:
    assert check(cells_of_cases(page), known) > 100
    assert check(cells_of_verdicts(page), known) > 20


def test_committed_comparison_is_that_of_the_summary(page: str, known: Known) -> None:
    """Its first run is the one of the summary, its second one that of the summary beside."""
    other = read_known(DOCS / "experiments" / "second" / "summary.csv")
    (table,) = (table for table in tables_of(page) if {"first", "second", "change"} <= {*table.head})
    for run, summary in (("first", known), ("second", other)):
        cells = [
            Cell(
                line[run],
                condition_of_case(line["experiment"], line["software"], line["factors"], line["system"]),
                line["metric"].strip("`"),
                line["unit"],
            )
            for line in table.rows
        ]
        assert check(cells, summary) == len(cells) > 50


def test_changed_numbers_of_a_page_are_noticed(page: str, known: Known) -> None:
    """In each kind of table: a median that is 2 % larger."""
    for cells in (cells_of_experiments, cells_of_cases, cells_of_verdicts):
        cell = next(one for one in cells(page) if " " not in one.quantity and one.text != "-")
        median = float(cell.text.split()[0])
        changed = cell._replace(text=re.sub(r"^\S+", f"{1.02 * median:.4g}", cell.text))
        with pytest.raises(AssertionError):
            check([changed], known)
