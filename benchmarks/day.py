"""Measure a fleet that does tasks: ``python -m benchmarks.day [--quick]``. It starts an engine of its own.

``run`` is ``rce demo --world warehouse --robots 100 --headless --duration 600``: real programs and messages.
Tasks are streamed, the planner's container is killed twice, and the report tells whether tasks were lost,
robots touched, or one with a task stood for longer than a minute.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.figures import Results, show

ROBOTS, DURATION_S = 100, 600.0
QUICK_ROBOTS, QUICK_S = 24, 60.0
RCE = Path(sys.executable).with_name("rce")


def command(robots: int, duration: float, report: Path) -> list[str]:
    """Return the command of a run, whose report is written to a file."""
    words = ["demo", "--world", "warehouse", "--headless", "--robots", robots, "--duration", f"{duration:g}"]
    return [str(RCE), *map(str, words), "--report", str(report)]


def row_of(report: dict[str, Any], robots: int, duration: float) -> dict[str, Any]:
    """Return the figures of a report.

    Args:
        report: What the demo wrote.
        robots: Number of robots.
        duration: Seconds for which tasks were sent.
    """
    return {
        "robots": robots,
        "duration s": duration,
        "ok": int(report["ok"]),
        "tasks done": report["tasks_done"],
        "tasks/h": report["tasks_per_hour"],
        "tasks lost": report["tasks_lost"],
        "planner kills": report["planner_kills"],
        "longest standstill s": report["longest_standstill_s"],
        "contacts": "unknown" if report["collisions"] is None else report["collisions"],
        "x real time": report["real_time_factor"],
    }


def measure(robots: int, duration: float) -> dict[str, Any]:
    """Run the demo; return its figures, also of a run that is not ok.

    Raises:
        SystemExit: It wrote no report of its tasks.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.json"
        done = subprocess.run(command(robots, duration, path), check=False)
        try:
            report = json.loads(path.read_text(encoding="utf-8"))
            row = row_of(report, robots, duration)
        except (OSError, ValueError, KeyError) as error:
            raise SystemExit(
                f"the demo ended with {done.returncode} and without a report: {error}"
            ) from error
    for fault in report["faults"]:
        print(f"not ok: {fault}", file=sys.stderr)
    return row


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.day", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_ROBOTS} robots for {QUICK_S:g} seconds")
    options = parser.parse_args()
    robots, duration = (QUICK_ROBOTS, QUICK_S) if options.quick else (ROBOTS, DURATION_S)
    results = Results("day", quick=options.quick)
    rows = [measure(robots, duration)]
    show("A fleet that does tasks, the planner killed twice", rows)
    results.keep("run", rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
