"""Programs in C++ on roscpp: what compiling them needs; the experiments' program, compiled once."""

from __future__ import annotations

import fcntl
import hashlib
import platform
import shutil
import subprocess
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

from rce_fleet.exceptions import ExperimentError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

PROGRAMS = frozenset({"asker", "camera", "echo", "listener", "robots"})
"""Programs of the experiments that have a form in C++; all are one binary."""
PACKAGES = ("roscpp", "std_msgs", "sensor_msgs")
"""Names by which ``pkg-config`` knows what it is compiled against."""
DEBIAN = {"roscpp": "libroscpp-dev", "std_msgs": "libstd-msgs-dev", "sensor_msgs": "libsensor-msgs-dev"}
"""Debian's packages of these."""
COMPILER, FINDER = "g++", "pkg-config"
OPTIMIZED = "-O2"
"""As Debian compiles its own packages."""
TIMEOUT_S = 600.0
ERROR_LINES = 5


def missing(packages: Sequence[str] = PACKAGES) -> str:
    """Return what is missing on this machine to compile programs; empty: nothing.

    Args:
        packages: Names that ``pkg-config`` knows.
    """
    for tool in (COMPILER, FINDER):
        if shutil.which(tool) is None:
            return f"the program {tool} (Debian: {tool})"
    for package in packages:
        if _run((FINDER, "--exists", package)).returncode:
            return f"the headers of {package} (Debian: {DEBIAN.get(package, package)})"
    return ""


def compile_program(
    source: Path, program: Path, packages: Sequence[str] = PACKAGES, *, optimization: str = OPTIMIZED
) -> Path:
    """Compile a program, if it does not exist; return its path.

    Of several processes that want the same program at the same time, one compiles it.

    Args:
        source: The file with ``main``.
        program: The program that is made; its folder exists.
        packages: Names that ``pkg-config`` knows, ``roscpp`` too.
        optimization: The compiler's option.

    Raises:
        ExperimentError: It cannot be compiled; the text has what the compiler says.
    """
    with program.with_name(f"{program.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            found = _run((FINDER, "--cflags", "--libs", *packages))
            if found.returncode:
                raise ExperimentError(f"{source} cannot be compiled: {found.stderr.strip()}")
            made = program.with_name(f"{program.name}.part")
            options = ("-std=c++17", "-pthread", optimization)
            done = _run((COMPILER, *options, "-o", str(made), str(source), *found.stdout.split()))
            if done.returncode:
                said = "".join(f"\n    {line}" for line in done.stderr.splitlines()[:ERROR_LINES])
                raise ExperimentError(f"{source} cannot be compiled:{said}")
            made.rename(program)
    return program


def compiled_workloads(say: Callable[[str], None] | None = None) -> Path:
    """Return the experiments' program for this machine, which is compiled if its sources are new.

    Args:
        say: Called with a line before it is compiled, which takes some seconds.

    Raises:
        ExperimentError: It cannot be compiled.
    """
    program = _cached()
    if not program.exists():
        if say is not None:
            say(f"compiling the programs of roscpp: {program}")
        try:
            program.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ExperimentError(f"{program.parent} cannot be made: {error}") from error
        compile_program(sources() / "main.cpp", program)
    return program


def sources() -> Path:
    """Return the folder of the experiments' sources in C++."""
    file = import_module("rce_fleet.experiments.workloads").__file__
    assert file is not None
    return Path(file).parent / "roscpp"


@cache
def _cached() -> Path:
    """Return the path of the experiments' program, which names its sources and what it is compiled by."""
    found = hashlib.sha256(platform.machine().encode())
    for tool in ((COMPILER, "-dumpfullversion"), (FINDER, "--modversion", *PACKAGES)):
        found.update(_run(tool).stdout.encode())
    for file in sorted(sources().iterdir()):
        found.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return platformdirs.user_cache_path("rce") / f"roscpp-workloads-{found.hexdigest()[:16]}"


def _run(argv: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(argv, check=False, capture_output=True, text=True, timeout=TIMEOUT_S)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ExperimentError(f"{argv[0]} cannot be run: {error}") from error
