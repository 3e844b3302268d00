"""``rce experiment`` as a program, and what it leaves on the system."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TIMEOUT_S = 1500.0


def command(*words: str | Path) -> list[str]:
    return [str(Path(sys.executable).with_name("rce")), "experiment", *map(str, words)]


def run(*words: str | Path, timeout: float = TIMEOUT_S) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*words), check=False, capture_output=True, text=True, timeout=timeout)


def left_behind(pid: int) -> list[str]:
    """Return what an experiment left on the system."""
    tag = f"rcx{pid}."
    namespaces = subprocess.run(["ip", "netns"], check=True, capture_output=True, text=True).stdout
    interfaces = subprocess.run(["ip", "link"], check=True, capture_output=True, text=True).stdout
    folders = [*Path("/tmp").glob(f"{tag}*"), *Path("/sys/fs/cgroup").glob(f"*/{tag}*")]
    found = [line for line in (namespaces + interfaces).splitlines() if tag in line]
    return [*found, *map(str, folders)]


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    """Start an experiment, and wait until its first run is under way."""
    process = subprocess.Popen(command(*words, "--output", folder), stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if ", run 1 " in line:
            return process
    process.stdout.close()
    raise AssertionError(f"no run was begun: {process.wait()}")
