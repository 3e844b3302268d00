"""The performance page is what the summary of the benchmarks gives."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import exploration, figures, mapping, throughput, traffic
from benchmarks.figures import Results
from benchmarks.page import block, made
from benchmarks.roundtrip import _row
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


@pytest.mark.slow
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


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where results are saved."""
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    return tmp_path


def summary_of(results: Results) -> dict[str, Any]:
    path = results.save()
    return merged({}, path.stem, json.loads(path.read_text(encoding="utf-8")))


def test_quick_and_unfinished_runs_are_left_out(folder: Path) -> None:
    quick = Results("exploration", quick=True)
    quick.keep("exploration", [{"runs": 2}])
    assert summary_of(quick) == {}
    results = Results("localization")
    results.keep("update", [{"form": "numpy"}])
    results.keep("lidar", [{"runs": 10}], unfinished=True)
    assert set(summary_of(results)) == {"localization.update"}
    results.keep("lidar", [{"runs": 100}])
    assert summary_of(results)["localization.lidar"]["rows"] == [{"runs": 100}]


def test_a_suite_has_the_load_of_its_start(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loads = iter((0.1, 0.2, 0.3))
    monkeypatch.setattr(figures, "machine", lambda: machine("2026-01-01") | {"load_1min": next(loads)})
    results = Results("light")
    results.keep("world", [])
    results.begin("fleet")
    results.keep("fleet", [])
    found = summary_of(results)
    assert [found[f"light.{name}"]["machine"]["load_1min"] for name in ("world", "fleet")] == [0.1, 0.2]


@pytest.mark.parametrize(
    ("options", "saved"),
    [
        ([], True),
        (["--with", "graph", "gmapping"], True),
        (["--with", "graph"], False),
        (["--sensor", "depth_camera"], False),
    ],
)
def test_partial_explorations_are_not_saved(
    options: list[str], saved: bool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exploration, "compile_kernels", lambda: True)
    monkeypatch.setattr(exploration, "measure", lambda runs, name, _: [{"with": name, "runs": runs}])
    monkeypatch.setattr(sys, "argv", ["exploration", *options])
    exploration.main()
    assert (folder / "exploration.json").exists() == saved


@pytest.mark.parametrize(
    ("options", "saved"), [([], True), (["--only", "intel"], False), (["--scans", "9"], False)]
)
def test_partial_mappings_are_not_saved(
    options: list[str], saved: bool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RCE_DATA", str(folder))
    monkeypatch.setattr(mapping, "compile_kernels", lambda: True)
    monkeypatch.setattr(mapping, "measure", lambda name, _: ([{"log": name}], {}))
    monkeypatch.setattr(sys, "argv", ["mapping", *options])
    mapping.main()
    assert (folder / "mapping.json").exists() == saved


@pytest.mark.parametrize(("options", "saved"), [([], True), (["--planner", "dijkstra"], False)])
def test_traffic_of_another_planner_is_not_saved(
    options: list[str], saved: bool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(traffic, "Traffic", lambda *_: None)
    monkeypatch.setattr(traffic, "tick_times", lambda *_: {"robots": 10})
    monkeypatch.setattr(traffic, "block_times", lambda *_: [{"robots": 10}])
    monkeypatch.setattr(traffic, "memory", lambda *_: {"robots": 10})
    monkeypatch.setattr(sys, "argv", ["traffic", *options])
    traffic.main()
    assert (folder / "traffic.json").exists() == saved


@pytest.mark.parametrize(("options", "robots"), [([], 100), (["--robots", "9"], None)])
def test_goals_of_dijkstra_stand_beside_those_of_lacam(
    options: list[str], robots: int | None, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(throughput, "compile_kernels", lambda: True)
    monkeypatch.setattr(throughput, "measure", lambda *_: 7)
    monkeypatch.setattr(sys, "argv", ["throughput", *options])
    throughput.main()
    results = json.loads((folder / "throughput.json").read_text(encoding="utf-8"))
    table = block("throughput.goals", merged({}, "throughput", results))
    if robots is None:
        assert table == "Not measured yet: `.venv/bin/python -m benchmarks.throughput`.\n"
    else:
        assert f"| lacam | paths as planned | {robots} | [7, 7, 7] | 84 |" in table
        assert f"| dijkstra | shortest paths | {robots} | [7, 7, 7] | 84 |" in table


@pytest.mark.parametrize(
    ("figure", "line"),
    [
        (249.5, "| 249.5 ms | ≤ 250 ms | met | 2026-01-01, abc, A processor |"),
        (250.5, "| 250.5 ms | ≤ 250 ms | **missed** | 2026-01-01, abc, A processor |"),
    ],
)
def test_missed_target_is_marked(figure: float, line: str) -> None:
    summary = {"start": {"machine": machine("2026-01-01"), "rows": [{"containers": 5, "p50_ms": figure}]}}
    table = block("targets", summary)
    assert f"| container start to first message, p50 {line}" in table
    assert "| 100 containers at once | not measured | ≤ 20 s |  |  |" in table


@pytest.mark.parametrize(("figure", "verdict"), [(0.5, "**missed**"), (3.0, "met"), (6.5, "**missed**")])
def test_target_with_two_limits(figure: float, verdict: str) -> None:
    rows = [{"sensor": "lidar", "NEES": figure}]
    summary = {"localization.lidar": {"machine": machine("2026-01-01"), "rows": rows}}
    line = f"lidar: NEES, mean | {figure:g} | 1 to 6 | {verdict} |"
    assert line in block("targets", summary)


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


def test_processor_time_is_shown_for_each_process() -> None:
    """Where it was measured: older summaries have the sum only."""
    old = {"path": "converter", "bytes": 20, "engine cpu_ms": 0.305}
    parts = {"rce-robot cpu_ms": 0.15, "environment cpu_ms": 0.1, "node cpu_ms": 0.055}
    for row, cell in ((old, "0.305"), (old | parts, "0.305 (0.150 + 0.100 + 0.055)")):
        summary = {"roundtrip": {"machine": machine("2026-01-01"), "rows": [row]}}
        assert f"| 20 |  |  | {cell} |  |" in block("roundtrip_cpu", summary)


def test_round_trips_have_the_processor_time_of_each_process() -> None:
    key = ("bare websockets echo", 20)
    costs = [{"rce-robot cpu_ms": robot, "node cpu_ms": 0.5} for robot in (1.0, 2.0, 9.0)]
    row = _row(key, {key: [0.001, 0.002]}, {key: costs})
    assert {name: row[name] for name in row if "cpu" in name} == {
        "engine cpu_ms": 2.5,
        "rce-robot cpu_ms": 2.0,
        "node cpu_ms": 0.5,
    }


def test_ros_libraries_are_shown_side_by_side() -> None:
    rows = [
        {"path": "ours", "bytes": 3, "p50_ms": 0.5, "of rospy": 0.25},
        {"path": "rospy", "bytes": 3, "p50_ms": 2.0, "of rospy": 1.0},
    ]
    summary = {"ros.echo": {"machine": machine("2026-01-01"), "rows": rows}}
    table = block("ros.echo", summary)
    assert "| bytes | ours, p50 ms | rospy, p50 ms | ours, x rospy |\n|---:|---:|---:|---:|\n" in table
    assert "\n| 3 | 0.5 | 2 | 0.25 |\n" in table
    assert block("ros.echo", {}) == "Not measured yet: `.venv/bin/python -m benchmarks.ros`.\n"
    assert block("rate", {}) == 'Not measured yet: `make bench ARGS="--only rate"`.\n'


def test_slowest_command_line_tool_is_a_target() -> None:
    """The suite also says so itself, in each row."""
    rows = [{"nodes": "alive", "command": name, "ratio": ratio} for name, ratio in (("a", 1.3), ("b", 1.0))]
    summary = {"ros.tools": {"machine": machine("2026-01-01"), "rows": rows}}
    line = "| slowest ROS tool at our core | 1.3 x rosmaster | ≤ 1.2 x rosmaster | **missed** |"
    assert line in block("targets", summary)


def test_each_suite_of_the_ros_graph_is_on_the_page() -> None:
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"<!-- figures: ros\.(\w+) -->", page))
    assert shown == {"echo", "rate", "fanout", "services", "registration", "joining", "memory", "tools"}
