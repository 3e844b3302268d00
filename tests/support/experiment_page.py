"""Reads the page of the experiments: its tables, and what each number of them is a median of."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from rce_fleet.experiments.results import Condition

SYSTEMS = {"SMS": "single_master", "MMS": "multi_master", "CRS": "cloud", "-": "-"}
SOFTWARE = {"ROS": "ros", "ROS C++": "roscpp", "RCE": "rce", "-": "-"}
UNITS = {"µs": 1e-6, "ms": 1e-3, "%": 0.01, "kB": 1e3, "MB": 1e6, "GB": 1e9, "kbit/s": 1e3, "Mbit/s": 1e6}
UNITS |= {f"{unit}/s": UNITS[unit] for unit in ("kB", "MB", "GB")}
NUMBER = r"[-+]?\d+(?:\.\d+)?"
CELL = re.compile(rf"({NUMBER}) (?:\[({NUMBER}), ({NUMBER})\]|\((\d+) runs?\))")


@dataclass
class Table:
    """A table of the page, with the heading and the lines of text before it."""

    heading: str
    about: str
    head: list[str]
    rows: list[dict[str, str]]


class Cell(NamedTuple):
    """A number of the page.

    Attributes:
        text: As on the page: a median and its interval; ``-``: not measured.
        condition: Of what.
        quantity: A metric, or two with an operator between them.
        unit: Of the text.
        runs: What the page says of how many runs; empty: nothing.
    """

    text: str
    condition: Condition
    quantity: str
    unit: str
    runs: str = ""


def tables_of(page: str) -> Iterator[Table]:
    heading = about = ""
    lines: list[str] = []
    for line in [*page.splitlines(), ""]:
        if line.startswith("|"):
            lines.append(line)
            continue
        if lines:
            cells = [[cell.strip() for cell in one.strip("|").split(" | ")] for one in lines]
            yield Table(
                heading, about, cells[0], [dict(zip(cells[0], one, strict=True)) for one in cells[2:]]
            )
            lines = []
        heading = line if line.startswith("## ") else heading
        about = line if line.strip() and not line.startswith("</") else about


def cells_of_experiments(page: str) -> Iterator[Cell]:
    """Yield the numbers of the tables of the experiments."""
    for table in tables_of(page):
        if table.head[:2] != ["system", "software"] or table.head[-1] != "runs":
            continue
        experiment = _experiment_of(page, table)
        titled = re.search(r"\(`(\w+)`\)(?:\*\*|</summary>)", table.about)
        for line in table.rows:
            factors = {name: line[name] for name in table.head[2:-1] if not name.startswith("`")}
            factors = {name: value for name, value in factors.items() if value != "-"}
            for column in (name for name in table.head if name.startswith("`")):
                name, unit = _unit_of(column)
                across, _, value = name.partition("=")
                more = {across: value} if value else {}
                condition = Condition.of(
                    experiment, SYSTEMS[line["system"]], SOFTWARE[line["software"]], **factors, **more
                )
                quantity = titled[1] if value and titled else name
                yield Cell(line[column], condition, quantity, unit, line["runs"])


def cells_of_cases(page: str) -> Iterator[Cell]:
    """Yield the numbers of the cases of the paper's claims."""
    for table in tables_of(page):
        if "case" not in table.head:
            continue
        (experiment,) = re.findall(r"experiment `([^`]+)`", table.about)
        for line in table.rows:
            for system in ("SMS", "MMS", "CRS"):
                if f"system={system}" in line["case"] or "system=" not in line["case"]:
                    condition = condition_of_case(experiment, line["software"], line["case"], system)
                    yield Cell(line[system], condition, line["quantity"].strip("`"), line["unit"])


def cells_of_verdicts(page: str) -> Iterator[Cell]:
    """Yield the numbers of the table of verdicts, except effect sizes and reasons."""
    (table,) = (table for table in tables_of(page) if "verdict" in table.head)
    experiments = experiments_of_claims(page)
    for line in table.rows:
        if line["verdict"] == "**not measured**":
            continue
        figures, case = case_of_figures(line["figures"])
        for part in figures.split("; "):
            found = re.fullmatch(r"`([^`]+)`: (.*\])(?: (.*))?", part)
            assert found, part
            for system, text, *_ in re.findall(rf"(\w+) ({CELL.pattern})", found[2]):
                condition = condition_of_case(experiments[line["claim"][1]], line["software"], case, system)
                yield Cell(text, condition, found[1], found[3] or "")


def experiments_of_claims(page: str) -> dict[str, str]:
    """Return the experiment of each claim, by the claim's letter."""
    return dict(re.findall(r"\((\w)\) [^\n]*: experiment `([^`]+)`", page))


def case_of_figures(text: str) -> tuple[str, str]:
    """Return the figures of a verdict, and the case that they are of."""
    found = re.fullmatch(r"(.*) \(((?:[^()]|\([^()]*\))*)\)", text)
    assert found, text
    return found[1], found[2]


def condition_of_case(experiment: str, software: str, case: str, system: str) -> Condition:
    pairs = dict(part.split("=", 1) for part in case.split(", ")) if case != "-" else {}
    pairs.pop("system", None)
    if pairs.get("origin") == "server (CRS: container)":
        pairs["origin"] = "container" if system == "CRS" else "server"
    return Condition.of(experiment, SYSTEMS[system], SOFTWARE[software], **pairs)


def _unit_of(column: str) -> tuple[str, str]:
    found = re.fullmatch(r"`([^`]+)`(?:, (.+))?", column)
    assert found, column
    return found[1], found[2] or ""


def _experiment_of(page: str, table: Table) -> str:
    of_section = rf"^{re.escape(table.heading)}\n\nExperiment `([^`]+)`"
    found = re.search(r"\(experiment `(\w+)`\)", table.about) or re.search(of_section, page, re.MULTILINE)
    assert found, table.heading
    return found[1]
