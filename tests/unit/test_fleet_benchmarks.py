"""Benchmarks of a fleet: targets read what they measure, and what the page asks for is answered."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from benchmarks.__main__ import OTHERS
from benchmarks.day import DURATION_S, ROBOTS, command, row_of
from benchmarks.station import ManagedLink, Traffic, is_graphics_card
from benchmarks.targets import TARGETS

ROOT = Path(__file__).parents[2]
REPORT = {
    "ok": True,
    "tasks_done": 400,
    "tasks_per_hour": 2000.0,
    "tasks_lost": 0,
    "planner_kills": 2,
    "longest_standstill_s": 46.0,
    "collisions": 0,
    "real_time_factor": 1.0,
}


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, []),
        ({"ok": False, "longest_standstill_s": 61.0}, ["the run is ok (1)", "longest standstill"]),
        ({"tasks_lost": 1, "tasks_per_hour": 900.0}, ["tasks lost", "tasks done"]),
    ],
)
def test_a_day_of_the_fleet_is_judged(changes: dict[str, Any], missed: list[str]) -> None:
    rows = [row_of({**REPORT, **changes}, ROBOTS, DURATION_S)]
    targets = [target for target in TARGETS if target.suite == "day.run"]
    figures = {target.what.rpartition(": ")[2]: (target, target.read(rows)) for target in targets}
    assert len(figures) == 4
    assert [
        what for what, (target, figure) in figures.items() if figure is not None and not target.is_met(figure)
    ] == missed


def test_a_day_is_the_run_that_the_documentation_names(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    words = command(ROBOTS, DURATION_S, tmp_path / "report.json")
    assert words[-2:] == ["--report", str(tmp_path / "report.json")]
    for text in (page, " ".join(words)):
        for option in ("--world warehouse", "--robots 100", "--headless", "--duration 600"):
            assert option in text


@pytest.mark.parametrize("program", sorted({words[0] for parts in OTHERS.values() for words in parts}))
def test_each_program_of_the_benchmarks_exists(program: str) -> None:
    assert find_spec(f"benchmarks.{program}") is not None


@pytest.mark.parametrize(
    ("renderer", "is_card"),
    [
        ("", False),
        ("ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (Subzero)), SwiftShader driver)", False),
        ("llvmpipe (LLVM 15.0.6, 256 bits)", False),
        ("ANGLE (NVIDIA, NVIDIA GeForce RTX 3060, OpenGL 4.5)", True),
    ],
)
def test_frames_are_a_target_with_a_graphics_card(renderer: str, is_card: bool) -> None:
    assert is_graphics_card(renderer) is is_card


async def test_the_manager_of_the_page_benchmark_answers(tmp_path: Path) -> None:
    """Each robot has a task; robots that only drove are not sent again."""
    traffic = Traffic(5)
    link = ManagedLink(traffic, tmp_path)

    async def ask(path: str) -> Any:
        fields = {"body": "", "user": "", "role": "viewer", "key": "", "revision": ""}
        answer = await link.request({"method": "GET", "path": path, **fields})
        assert answer["status"] == 200, answer
        return json.loads(answer["body"])

    robots = await ask("/robots?since=0")
    assert all(robot["task"] and robot["battery"] is not None for robot in robots["robots"])
    assert len((await ask("/tasks?state=open&limit=200"))["tasks"]) == 5
    for robot in traffic.ways:
        traffic.advance(robot)
    link.advance(traffic, list(traffic.ways), 0.0)
    assert (await ask(f"/robots?since={robots['version']}"))["robots"] == []
    link.advance(traffic, ["Robot2"], 100.0)
    assert [one["id"] for one in (await ask(f"/robots?since={robots['version']}"))["robots"]] == ["Robot2"]
    await link.manager.close()
