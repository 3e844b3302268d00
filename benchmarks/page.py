"""Makes the tables of the performance page from the summary of the benchmarks: ``python -m benchmarks.page``.

Each table is between ``<!-- figures: NAME -->`` and ``<!-- end -->``: the name of a suite, ``roundtrips`` for
round trips side by side, ``roundtrip_cpu`` for their processor time, or ``targets``. With ``--check`` the
page is not written; the program ends with 1 if it differs.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.summary import SUMMARY
from benchmarks.target import Target
from benchmarks.targets import TARGETS

PAGE = Path(__file__).resolve().parent.parent / "docs" / "performance.md"

_BLOCK = re.compile(r"(<!-- figures: (?P<name>[\w.]+) -->\n).*?(<!-- end -->)", re.DOTALL)
_PATHS = ("bare websockets echo", "forwarder", "forwarder, one frame", "converter", "service")
_CPU_PARTS = ("rce-robot cpu_ms", "environment cpu_ms", "node cpu_ms")


def made(page: str, summary: dict[str, Any]) -> str:
    """Return a page with updated tables."""

    def fill(found: re.Match[str]) -> str:
        return f"{found[1]}\n{block(found['name'], summary)}\n{found[3]}"

    return _BLOCK.sub(fill, page)


def block(name: str, summary: dict[str, Any]) -> str:
    """Return a table and the machine of its measurement."""
    if name == "targets":
        return "\n".join(_targets(summary)) + "\n"
    suite, table = _TABLES.get(name, (name, _table))
    if suite not in summary:
        return f"Not measured yet: `{_program(suite)}`.\n"
    return f"{_measured(summary[suite]['machine'])}\n\n" + "\n".join(table(summary[suite]["rows"])) + "\n"


def _program(suite: str) -> str:
    """Return the command that measures a suite."""
    program, dot, _ = suite.partition(".")
    return f".venv/bin/python -m benchmarks.{program}" if dot else f'make bench ARGS="--only {suite}"'


def _measured(machine: dict[str, Any]) -> str:
    commit = f", commit {machine['commit']}" if machine.get("commit") else ""
    return (
        f"{machine['date'][:10]}{commit}; {machine['cores']} cores{_processor(machine)},"
        f" {machine['memory_gb']:g} GB, Python {machine['python']}; load {machine['load_1min']:g}."
    )


def _processor(machine: dict[str, Any]) -> str:
    return f" ({machine['processor']})" if machine.get("processor") else ""


def _table(rows: list[dict[str, Any]]) -> Iterator[str]:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    yield f"| {' | '.join(columns)} |"
    yield "|" + "---|" * len(columns)
    for row in rows:
        yield f"| {' | '.join(_shown(row.get(name, '')) for name in columns)} |"


def _round_trips(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Paths side by side, p10 / p50 in ms; then the median in times of the bare echo's."""
    found = {(row["path"], row["bytes"]): row for row in rows}
    engine = _PATHS[1:]
    yield f"| bytes | {' | '.join(_PATHS)} | {' | '.join(f'{path}, x bare' for path in engine)} |"
    yield "|" + "---:|" * (1 + len(_PATHS) + len(engine))
    for size in dict.fromkeys(row["bytes"] for row in rows):
        control_groups = [str(size)]
        for path in _PATHS:
            row = found.get((path, size))
            control_groups.append(f"{row['p10_ms']:.2f} / {row['p50_ms']:.2f}" if row else "")
        control_groups += [_shown(found.get((path, size), {}).get("x bare", "")) for path in engine]
        yield f"| {' | '.join(control_groups)} |"


def _processor_times(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Processor time of round trips, paths side by side; of each process where that was measured."""
    found = {(row["path"], row["bytes"]): row for row in rows}
    engine = _PATHS[1:]
    yield f"| bytes | {' | '.join(engine)} |"
    yield "|" + "---:|" * (1 + len(engine))
    for size in dict.fromkeys(row["bytes"] for row in rows):
        yield f"| {size} | {' | '.join(_processor_time(found.get((path, size), {})) for path in engine)} |"


def _processor_time(row: dict[str, Any]) -> str:
    if not row:
        return ""
    parts = [f"{row[name]:.3f}" for name in _CPU_PARTS if name in row]
    return f"{row['engine cpu_ms']:.3f}" + (f" ({' + '.join(parts)})" if parts else "")


def _echoes(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Median round trips of ROS's libraries side by side, in ms; then ours in times of rospy's."""
    found = {(row["path"], row["bytes"]): row for row in rows}
    paths = list(dict.fromkeys(row["path"] for row in rows))
    yield f"| bytes | {' | '.join(f'{path}, p50 ms' for path in paths)} | ours, x rospy |"
    yield "|" + "---:|" * (2 + len(paths))
    for size in dict.fromkeys(row["bytes"] for row in rows):
        medians = [_shown(found.get((path, size), {}).get("p50_ms", "")) for path in paths]
        ratio = _shown(found.get(("ours", size), {}).get("of rospy", ""))
        yield f"| {size} | {' | '.join(medians)} | {ratio} |"


_TABLES: dict[str, tuple[str, Callable[[list[dict[str, Any]]], Iterator[str]]]] = {
    "roundtrips": ("roundtrip", _round_trips),
    "roundtrip_cpu": ("roundtrip", _processor_times),
    "ros.echo": ("ros.echo", _echoes),
}
"""Tables other than the plain one of a suite's rows: the suite, and what makes the table."""


def _targets(summary: dict[str, Any]) -> Iterator[str]:
    yield "| | measured | target | | date, commit, processor |"
    yield "|---|---:|---:|---|---|"
    for target in TARGETS:
        entry = summary.get(target.suite)
        figure = None if entry is None else target.read(entry["rows"])
        of = "" if entry is None or figure is None else _measured_briefly(entry["machine"])
        yield f"| {target.what} | {_judged(target, figure)} | {of} |"


def _judged(target: Target, figure: float | None) -> str:
    if figure is None:
        return f"not measured | {target.wanted} | "
    verdict = "met" if target.is_met(figure) else "**missed**"
    return f"{f'{figure:g} {target.unit}'.rstrip()} | {target.wanted} | {verdict}"


def _measured_briefly(machine: dict[str, Any]) -> str:
    return ", ".join(filter(None, (machine["date"][:10], machine.get("commit"), machine.get("processor"))))


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main(check: bool) -> int:
    """Write the page, or check whether it is current."""
    summary = json.loads(SUMMARY.read_text(encoding="utf-8"))
    page = PAGE.read_text(encoding="utf-8")
    wanted = made(page, summary)
    if page == wanted:
        return 0
    if check:
        print(f"{PAGE.name} is not what {SUMMARY.name} gives: run `python -m benchmarks.page`")
        return 1
    PAGE.write_text(wanted, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main("--check" in sys.argv[1:]))
