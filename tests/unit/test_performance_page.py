"""The performance page is what the summary of the benchmarks gives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.page import block, made
from benchmarks.summary import merged
from benchmarks.targets import TARGETS

ROOT = Path(__file__).parents[2]


def machine(date: str) -> dict[str, Any]:
    return {
        "date": date,
        "commit": "abc",
        "processor": "A processor",
        "cores": 2,
        "memory_gb": 4.0,
        "python": "3.11.7",
        "load_1min": 0.5,
    }


def test_page_is_current() -> None:
    argv = [sys.executable, "-m", "benchmarks.page", "--check"]
    done = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_newest_result_of_each_suite_is_kept() -> None:
    first = {"machine": machine("2026-01-01"), "rate": [{"messages/s": 1}], "start": [{"p50_ms": 1.0}]}
    second = {"machine": machine("2026-01-02"), "rate": [{"messages/s": 2}]}
    summary = merged(merged({}, "engine", first), "engine", second)
    assert summary["rate"]["rows"] == [{"messages/s": 2}]
    assert summary["start"]["machine"]["date"] == "2026-01-01"
    assert merged(summary, "engine", first)["rate"]["rows"] == [{"messages/s": 2}], "an older result"
    assert set(merged({}, "ros", {"machine": machine("2026-01-01"), "echo": []})) == {"ros.echo"}


@pytest.mark.parametrize(
    ("figure", "line"),
    [
        (249.5, "| 249.5 ms | ≤ 250 ms | met |"),
        (250.5, "| 250.5 ms | ≤ 250 ms | **missed** |"),
    ],
)
def test_missed_target_is_marked(figure: float, line: str) -> None:
    summary = {"start": {"machine": machine("2026-01-01"), "rows": [{"containers": 5, "p50_ms": figure}]}}
    table = block("targets", summary)
    assert f"| container start to first message, p50 {line}" in table
    assert "| 100 containers at once | not measured | ≤ 20 s |" in table


def test_targets_read_the_rows_of_the_suites() -> None:
    rows = [{"path": "converter", "bytes": 20, "p10_ms": 1.0, "p50_ms": 2.0, "x bare": 3.5}]
    summary = {"roundtrip": {"machine": machine("2026-01-01"), "rows": rows}}
    (target,) = [each for each in TARGETS if each.what == "converter, 20 bytes, p50"]
    assert target.read(rows) == 3.5
    assert "| converter, 20 bytes, p50 | 3.5 x bare echo | ≤ 2.9 x bare echo | **missed** |" in block(
        "targets", summary
    )


def test_block_says_where_and_when() -> None:
    rows = [{"load": "idle", "rce-ros PSS MB": 30.25}]
    summary = {"bridge": {"machine": machine("2026-01-01T10:00:00Z"), "rows": rows}}
    page = "before\n<!-- figures: bridge -->\nold\n<!-- end -->\nafter\n"
    assert made(page, summary) == (
        "before\n<!-- figures: bridge -->\n\n"
        "2026-01-01, commit abc; 2 cores (A processor), 4 GB, Python 3.11.7; load 0.5.\n\n"
        "| load | rce-ros PSS MB |\n|---|---|\n| idle | 30.25 |\n\n<!-- end -->\nafter\n"
    )
    assert "Not measured yet" in made(page, {})
