"""Keeps the newest result of each suite in ``benchmarks/summary.json``: ``python -m benchmarks.summary``.

Raw results are in ``benchmarks/results/`` and belong to a machine; the summary is committed, and the
performance page is made from it (``python -m benchmarks.page``). A suite that was not measured again, or
only in a quick or unfinished run, keeps its result.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.figures import RESULTS

SUMMARY = Path(__file__).parent / "summary.json"
_OF_ENGINE = "engine"


def merged(summary: dict[str, Any], name: str, results: dict[str, Any]) -> dict[str, Any]:
    """Return a summary with the suites of a file of results in the place of older ones; quick ones are left.

    Args:
        summary: Suite to its commit, machine and rows.
        name: Of the file; suites of others than the engine's get it before their own.
        results: What :meth:`benchmarks.figures.Results.save` wrote.
    """
    machines = results.get("machines", {})
    new = {
        suite if name == _OF_ENGINE else f"{name}.{suite}": {
            "machine": machines.get(suite, results["machine"]),
            "rows": rows,
        }
        for suite, rows in results.items()
        if isinstance(rows, list)
    }
    newer = {
        suite: entry
        for suite, entry in new.items()
        if not entry["machine"].get("quick") and _date(entry) >= _date(summary.get(suite))
    }
    return dict(sorted((summary | newer).items()))


def _date(entry: dict[str, Any] | None) -> str:
    return str(entry["machine"]["date"]) if entry else ""


def main() -> None:
    """Merge all files of results."""
    summary = json.loads(SUMMARY.read_text(encoding="utf-8")) if SUMMARY.exists() else {}
    for path in sorted(RESULTS.glob("*.json")):
        summary = merged(summary, path.stem, json.loads(path.read_text(encoding="utf-8")))
    lines = ",\n".join(f" {json.dumps(suite)}: {json.dumps(entry)}" for suite, entry in summary.items())
    SUMMARY.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
    print(f"{SUMMARY}: {', '.join(summary)}")


if __name__ == "__main__":
    main()
