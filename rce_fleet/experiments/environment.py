"""Where raw data come from: the machine, the versions, the commit, the options."""

from __future__ import annotations

import datetime as dt
import json
import os
import platform
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rce
from rce_fleet.experiments.ownership import new_tag
from rce_fleet.experiments.results import ENVIRONMENT
from rce_fleet.experiments.systems.software import ROSCPP
from rce_fleet.experiments.usage import make_meter

if TYPE_CHECKING:
    from rce_fleet.experiments.experiment import Options

PACKAGES = ("numpy", "uvloop", "websockets", "aiohttp", "msgspec")
PROGRAMS = {
    "roscore": ("rosversion", "roslaunch"),
    "roscpp": ("pkg-config", "--modversion", "roscpp"),
    "g++": ("g++", "-dumpfullversion"),
    "bwrap": ("bwrap", "--version"),
}
"""Programs that take part, and what prints their versions."""
DECISIVE = (
    *("commit", "seed", "options"),
    *("machine", "processor", "cores", "kernel", "python", "cpu_shares", "versions"),
)
"""What must be the same for all rows of a table, by its name in the description."""


def describe(options: Options, seed: int, runs: int) -> dict[str, Any]:
    """Return what raw data depend on, as a JSON document."""
    return {
        "machine": platform.machine(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "kernel": platform.release(),
        "python": sys.version.split()[0],
        "cpu_shares": "limited" if can_limit() else "not limited",
        "versions": _versions(),
        "commit": commit(),
        "seed": seed,
        "runs": runs,
        "started": now(),
        "options": {
            "systems": list(options.systems),
            "software": list(options.software),
            "robots": options.robots,
            "seconds": options.seconds,
            "quick": options.quick,
        },
    }


def now() -> str:
    """Return the time as descriptions tell it, in UTC: ``2026-11-30T19:00:29+00:00``."""
    return dt.datetime.now(dt.UTC).isoformat(timespec="seconds")


def write(folder: Path, description: dict[str, Any]) -> None:
    """Write a description beside the raw data."""
    (folder / ENVIRONMENT).write_text(json.dumps(description, indent=2) + "\n")


def read(folder: Path) -> dict[str, Any]:
    """Read the description of raw data.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is not one.
    """
    found = json.loads((folder / ENVIRONMENT).read_text())
    if not isinstance(found, dict):
        raise ValueError(f"{folder / ENVIRONMENT} is not a JSON object")  # noqa: TRY004 - it is the file's fault
    return found


def can_limit() -> bool:
    """Return whether a machine's processor time can be limited here."""
    meter = make_meter(new_tag(), "")
    meter.close()
    return meter.limits


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        name, _, value = line.partition(":")
        if name.strip() == "model name":
            return value.strip()
    return platform.processor()


def _versions() -> dict[str, str]:
    found = {"rce": rce.__version__}
    for name in PACKAGES:
        found[name] = metadata.version(name)
    for name, argv in PROGRAMS.items():
        if shutil.which(name) is not None or (name == "roscpp" and not ROSCPP.missing()):
            done = subprocess.run(argv, check=False, capture_output=True, text=True, timeout=30)  # noqa: S603
            found[name] = done.stdout.strip().removeprefix("bubblewrap ") or "unknown"
    return found


def commit(folder: Path = Path(rce.__file__).parent) -> str:
    """Return the commit of the checkout that this package is in; with ``+`` if files of it were changed.

    Args:
        folder: Of the package.

    Returns:
        ``unknown`` if it was installed; also below a repository of something else.
    """
    git = ("git", "-C", str(folder))
    if shutil.which("git") is None or _output(*git, "ls-files", "--error-unmatch", "__init__.py") is None:
        return "unknown"
    head = _output(*git, "rev-parse", "HEAD")
    if head is None:
        return "unknown"
    packages = ("--", f"../{folder.name}*")  # a page, or a note beside them, changes no figure
    return head + ("+" if _output(*git, "status", "--porcelain", "--untracked-files=no", *packages) else "")


def _output(*argv: str) -> str | None:
    """Return what a program prints; None: it failed."""
    done = subprocess.run(argv, check=False, capture_output=True, text=True)  # noqa: S603
    return None if done.returncode else done.stdout.strip()
