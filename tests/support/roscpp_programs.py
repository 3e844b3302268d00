"""Programs in C++ against roscpp: compiling one takes seven seconds of CPU, so a test run does it once."""

from __future__ import annotations

import fcntl
import os
import subprocess
import tempfile
from functools import cache
from pathlib import Path

RUN_FOLDER = "RCE_TEST_RUN_FOLDER"
"""Environment variable: the folder of what all workers of a test run share."""
TIMEOUT_S = 240


@cache
def compiled(source: Path, *packages: str) -> Path:
    """Return the program made of a source file, compiled by the first worker of the run that needs it.

    Args:
        source: The file.
        packages: Names that ``pkg-config`` knows, ``roscpp`` too.
    """
    program = _run_folder() / source.stem
    with program.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            find = ["pkg-config", "--cflags", "--libs", *packages]
            flags = subprocess.run(find, capture_output=True, text=True, check=True).stdout.split()
            made = program.with_suffix(".part")
            argv = ["g++", "-O0", "-pthread", "-o", str(made), str(source), *flags]
            subprocess.run(argv, check=True, timeout=TIMEOUT_S)
            made.rename(program)
    return program


def _run_folder() -> Path:
    return Path(os.environ.get(RUN_FOLDER) or tempfile.mkdtemp(prefix="rce-run-", dir="/tmp"))
