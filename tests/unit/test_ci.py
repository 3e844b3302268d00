"""What continuous integration runs: lint, docs, tests, each once, and any failure fails the run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.ports import END, FIRST, free_ports, slice_of

ROOT = Path(__file__).parents[2]

TOGETHER = """
import os
import time
from pathlib import Path

import pytest

@pytest.fixture(scope="module")
def made(tmp_path_factory):
    with Path("made").open("a") as file:
        file.write(os.environ["PYTEST_XDIST_WORKER"] + "\\n")

@pytest.mark.parametrize("number", range(6))
def test_uses_it(made, number):
    time.sleep(0.1)
"""


def test_packages_that_tests_need_are_in_the_list() -> None:
    """Those that a skipped test names are what ``.ci/run`` installs."""
    text = (ROOT / ".ci" / "packages.txt").read_text()
    listed = {name for line in text.splitlines() for name in line.partition("#")[0].split()}
    checks = (ROOT / "tests" / "conftest.py").read_text()
    named = {name for group in re.findall(r"\(Debian: ([^);]*)", checks) for name in group.split()}
    assert len(named) > 20
    assert named - {"..."} <= listed


def run_ci(
    folder: Path,
    lint: int,
    docs: int,
    loops: int,
    tests: int,
    *,
    packages: str = "dpkg",
    path: str = os.environ["PATH"],
) -> subprocess.CompletedProcess[str]:
    """Run ``.ci/run`` where ``make`` only notes what it is asked for."""
    (folder / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", folder / ".ci" / "run")
    (folder / ".ci" / "packages.txt").write_text(f"# none\n\n{packages}  # why\n")
    rules = "{0}:\n\t@echo {0} >> asked; exit {1}\n"
    ends = {"packages": 0, "lint": lint, "docs": docs, "install": loops, "collect": 0, "test-all": tests}
    (folder / "Makefile").write_text("".join(rules.format(name, code) for name, code in ends.items()))
    environ = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    environ["PATH"] = path
    return subprocess.run(
        [folder / ".ci" / "run"], env=environ, capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.skipif(shutil.which("dpkg-query") is None, reason=".ci/run is for Debian")
@pytest.mark.parametrize(
    ("lint", "docs", "loops", "tests"),
    [(0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (1, 1, 1, 1)],
)
def test_any_failure_fails_the_run_and_nothing_runs_twice(
    tmp_path: Path, lint: int, docs: int, loops: int, tests: int
) -> None:
    done = run_ci(tmp_path, lint, docs, loops, tests)
    assert (done.returncode == 0) == (lint == docs == loops == tests == 0), done
    asked = (tmp_path / "asked").read_text().split()
    assert sorted(asked) == ["collect", "docs", "install", "lint", "packages", "test-all"]
    asked.remove("lint")  # it runs beside the others
    assert asked == ["packages", "docs", "install", "collect", "test-all"]


@pytest.mark.skipif(shutil.which("dpkg-query") is None, reason=".ci/run is for Debian")
@pytest.mark.parametrize("code", [0, 7])
def test_debian_packages_are_installed_beside_the_others(tmp_path: Path, code: int) -> None:
    """What needs them waits, and a failure fails the run."""
    tools = tmp_path / "tools"
    tools.mkdir()
    wait = f"until grep -q packages {tmp_path}/asked; do sleep 0.05; done"
    end = f"{wait}; echo installed >>{tmp_path}/asked; exit {code}"
    for name, text in (("sudo", 'exec "$@"'), ("apt-get", f"case $1 in install) {end};; esac")):
        (tools / name).write_text(f"#!/bin/sh\n{text}\n")
        (tools / name).chmod(0o755)
    done = run_ci(tmp_path, 0, 0, 0, 0, packages="rce-no-such-package", path=f"{tools}:{os.environ['PATH']}")
    assert (done.returncode == 0) == (code == 0), done
    asked = (tmp_path / "asked").read_text().split()
    assert asked.index("installed") < asked.index("test-all")


def test_random_moments_are_as_many_as_asked() -> None:
    argv = ["make", "--dry-run", "--no-print-directory", "moments", "SEED=7", "COUNT=3"]
    done = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "-m support.moments 7 3" in done.stdout.splitlines()[-1]


def test_workers_have_ports_of_their_own() -> None:
    for workers in (1, 2, 7):
        slices = [slice_of(f"gw{number}", workers) for number in range(workers)]
        ports = [port for ports in slices for port in ports]
        assert len(ports) == len(set(ports))
        assert FIRST <= min(ports) <= max(ports) < END
    assert slice_of("", 1) == range(FIRST, END)
    found = free_ports(500)
    assert len(set(found)) == 500


@pytest.mark.slow
def test_a_parallel_run_makes_once_what_a_module_shares(tmp_path: Path) -> None:
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "pytest.ini").write_text(f"[pytest]\npythonpath = {ROOT / 'tests'}\n")
    (tmp_path / "test_together.py").write_text(TOGETHER)
    environ = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "xdist", "-n", "2", "--dist", "loadgroup"],
        cwd=tmp_path,
        env=environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "6 passed" in done.stdout
    assert len((tmp_path / "made").read_text().split()) == 1
