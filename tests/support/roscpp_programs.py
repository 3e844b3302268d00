"""Programs in C++ against roscpp: compiling one takes seven seconds of CPU, so a test run does it once."""

from __future__ import annotations

import os
import tempfile
from functools import cache
from pathlib import Path

from rce_fleet.experiments.systems.roscpp_programs import compile_program
from support.short_folders import RUN_PREFIX, TMP

RUN_FOLDER = "RCE_TEST_RUN_FOLDER"
"""Environment variable: the folder of what all workers of a test run share."""


@cache
def compiled(source: Path, *packages: str) -> Path:
    """Return the program made of a source file, compiled by the first worker of the run that needs it.

    Args:
        source: The file.
        packages: Names that ``pkg-config`` knows, ``roscpp`` too.
    """
    return compile_program(source, run_folder() / source.stem, packages, optimization="-O0")


def run_folder() -> Path:
    """Return the folder of what all workers of a test run share."""
    return Path(os.environ.get(RUN_FOLDER) or tempfile.mkdtemp(prefix=RUN_PREFIX, dir=TMP))
