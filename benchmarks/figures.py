"""Figures of a measurement: percentiles, tables, files, plots."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from math import ceil
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

RESULTS = Path(__file__).parent / "results"


def data() -> Path:
    """Return the folder of public maps and logs: ``$RCE_DATA``, or ``shared/data`` beside the checkout.

    Raises:
        SystemExit: It does not exist.
    """
    folder = Path(os.environ.get("RCE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        raise SystemExit(
            f"folder {folder} does not exist: set RCE_DATA to the folder of public maps and logs"
        )
    return folder


def percentile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that at least ``share`` (0 to 1) of the values do not exceed."""
    assert 0 <= share <= 1, f"{share} is not a share"
    ordered = sorted(values)
    rank = ceil(round(share * len(ordered), 9))  # 0.07 * 100 is a little more than 7
    return ordered[max(rank, 1) - 1]


def own_memory(name: str) -> float:
    """Return the memory of this process in MB.

    ``ru_maxrss`` does not tell it: that of a new program begins with the size of the process that started it.

    Args:
        name: ``VmRSS`` now, or ``VmHWM`` at most since the program began.
    """
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith(f"{name}:"))
    return int(kilobytes) * 1024 / 1e6


def spread(seconds: Sequence[float]) -> dict[str, float]:
    """Median, 95th and 99th percentile of times, in milliseconds."""
    return {
        f"p{round(100 * share)}_ms": round(1e3 * percentile(seconds, share), 4) for share in (0.5, 0.95, 0.99)
    }


def machine() -> dict[str, Any]:
    """Return the machine of the measurement."""
    return {
        "commit": commit(),
        "processor": processor(),
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "cores": psutil.cpu_count(),
        "load_1min": round(psutil.getloadavg()[0], 1),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "rce": version("rce"),
    }


def commit() -> str:
    """The commit that was measured, with ``+`` if files were changed since; empty outside of a checkout."""
    folder = Path(__file__).resolve().parent
    argv = ["git", "-C", str(folder), "describe", "--always", "--abbrev=10", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(argv, check=False, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip()


def processor() -> str:
    """Return the processor's name; empty if the kernel does not report it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")


def show(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows as a table."""
    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*(f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values()))
    Console(width=120).print(table)


class Results:
    """What a program measures: rows by suite, each with the machine as it was when the suite began.

    Args:
        name: Of the file.
        quick: Whether less is measured than what the performance page shows, which does not take it then.
    """

    def __init__(self, name: str, *, quick: bool = False) -> None:
        self._name, self._quick = name, quick
        self._machine = machine()
        self._began: dict[str, dict[str, Any]] = {}
        self._is_quick: dict[str, bool] = {}
        self._rows: dict[str, Sequence[Any]] = {}

    def begin(self, *suites: str) -> None:
        """Note the machine as suites begin; without a call it is as the program began."""
        self._began |= dict.fromkeys(suites, machine())

    def keep(self, suite: str, rows: Sequence[Any], *, unfinished: bool = False) -> None:
        """Take the rows of a suite.

        Args:
            suite: Its name.
            rows: Its rows, in the place of earlier ones.
            unfinished: Whether more runs follow, so that the page does not take these rows.
        """
        self._rows[suite] = rows
        self._is_quick[suite] = self._quick or unfinished

    def save(self) -> Path:
        """Write everything as JSON; return the file."""
        machines = {
            suite: self._began.get(suite, self._machine) | ({"quick": True} if is_quick else {})
            for suite, is_quick in self._is_quick.items()
        }
        RESULTS.mkdir(exist_ok=True)
        path = RESULTS / f"{self._name}.json"
        text = json.dumps({"machine": self._machine, "machines": machines, **self._rows}, indent=1)
        path.write_text(text + "\n", encoding="utf-8")
        return path


def plot_round_trips(rows: Sequence[Mapping[str, Any]]) -> Path:
    """Draw median round trip over message size, a line per path."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 5))
    for path in dict.fromkeys(row["path"] for row in rows):
        mine = [row for row in rows if row["path"] == path]
        axes.loglog([row["bytes"] for row in mine], [row["p50_ms"] for row in mine], marker=".", label=path)
    axes.set(xlabel="message size in bytes", ylabel="median round trip in ms")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / "roundtrip.svg"
    figure.savefig(path, bbox_inches="tight")
    plt.close(figure)
    return path
