"""What counts leaks in other tests does find them."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from rce_container.environment import proc
from tools.leaks import CGROUPS, Traces, sweep_cgroups

MARK = "0123456789ab"
TOKEN = "feedbeef"
TIMEOUT_S = 60.0
SLEEP = "import time; time.sleep(600)"


def vanish(traces: Traces) -> None:
    """Wait until nothing is left: what was killed needs a moment for its end, and its parent to notice."""
    deadline = time.monotonic() + TIMEOUT_S
    while left := traces.left():
        assert time.monotonic() < deadline, left
        time.sleep(0.01)


def test_processes_are_found_by_name_and_descent(folder: Path) -> None:
    """Processes are found by name and by descent and remembered."""
    traces = Traces(folder, "box_of_leaks")
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {SLEEP!r}])"
    with (
        subprocess.Popen([sys.executable, "-c", child, str(folder)]) as parent,
        subprocess.Popen([sys.executable, "-c", SLEEP, "box_of_leaks"]) as other,
    ):
        try:
            deadline = time.monotonic() + TIMEOUT_S
            while len(found := traces.look()) < 3:
                assert time.monotonic() < deadline, found
                time.sleep(0.01)
            assert {parent.pid, other.pid} < {one.pid for one in found}
            parent.kill()
            parent.wait()
            (orphan,) = {one.pid for one in found} - {parent.pid, other.pid}
            left = traces.left({other.pid})
            assert [line.split()[:2] for line in left] == [["process", str(orphan)]]
        finally:
            for one in traces.processes():
                proc.kill(one)
    vanish(traces)


def test_files_and_sockets_are_found(folder: Path) -> None:
    traces = Traces(folder)
    life = folder / "state" / "containers" / MARK
    life.mkdir(parents=True)
    (folder / "state" / "logs" / "u" / "c" / MARK).mkdir(parents=True)
    (folder / "state" / "name.new").touch()
    assert sorted(traces.left()) == [f"file {life}", f"file {folder}/state/name.new"]


@pytest.mark.needs("cgroups", "root")
def test_cgroups_are_found_and_swept(folder: Path) -> None:
    (folder / "state").mkdir()
    (folder / "state" / "run").write_text(TOKEN)
    hierarchy = next(path for path in (CGROUPS / "pids", CGROUPS) if path.is_dir())
    cgroup = hierarchy / f"rce-{TOKEN}"
    (cgroup / MARK).mkdir(parents=True)
    process = subprocess.Popen(["sleep", "600"])
    (cgroup / MARK / "cgroup.procs").write_text(str(process.pid))
    traces = Traces(folder)
    assert f"cgroup {cgroup}" in traces.left()
    assert any(line.startswith(f"process {process.pid} ") for line in traces.left())
    while sweep_cgroups(folder):
        process.wait()
    assert traces.left() == []
