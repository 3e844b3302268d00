"""The code of the pages on planning runs, and does what the pages say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[3] / "docs"


def blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(), re.MULTILINE | re.DOTALL)


def test_the_planner_of_the_page_makes_a_right_plan(capsys: pytest.CaptureFixture[str]) -> None:
    scope: dict[str, object] = {}
    planner, use = blocks("how-to/write-a-planner.md")
    exec(planner, scope)
    exec(use, scope)
    assert re.fullmatch(r"True \d+\n", capsys.readouterr().out)  # and no faults
    body = planner[planner.index("class PriorityPlanner") :]
    assert len(body.splitlines()) <= 32
    exec("none = PriorityPlanner().plan(PlanningProblem.of(problem.graph, [], []))", scope)


def test_the_example_of_the_reference_plans(capsys: pytest.CaptureFixture[str]) -> None:
    for block in blocks("reference/planning.md"):
        exec(block, {})
    assert capsys.readouterr().out.startswith("True 28 [0, ")
