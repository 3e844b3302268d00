"""``rce experiment`` from outside: a killed run, a system of one's own, the plan, bad input."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from functools import cache
from pathlib import Path

import psutil
import pytest
from support.engine import command_line
from support.experiments import TIMEOUT_S, command, left_behind, run, started

from rce_fleet.experiments.catalogue import EXPERIMENTS
from rce_fleet.experiments.ownership import sweep
from rce_fleet.experiments.results import read_rows

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[2]
needs_machines = pytest.mark.needs("netns")


@needs_machines
def test_what_a_killed_experiment_leaves_is_removed_by_the_next_one(tmp_path: Path) -> None:
    process = started(
        tmp_path / "one", "round-trip", "--quick", "--systems", "single_master", "--software", "rce"
    )
    deadline = time.monotonic() + TIMEOUT_S
    while not left_behind(process.pid):
        assert time.monotonic() < deadline, "it makes no machines"
        time.sleep(0.05)
    process.kill()
    process.communicate()
    assert left_behind(process.pid) != []
    done = run(
        *("round-trip", "--quick", "--systems", "single_master", "--software", "rce"),
        *("--output", tmp_path / "two"),
    )
    assert done.returncode == 0, done.stderr
    assert left_behind(process.pid) == []


@needs_machines
def test_no_program_outlives_a_killed_experiment(tmp_path: Path) -> None:
    """While the link is measured: the program that measures would wait for an answer that does not come."""
    words = command("round-trip", "--quick", "--software", "rce", "--output", tmp_path / "data")
    process = subprocess.Popen(words)
    deadline = time.monotonic() + TIMEOUT_S
    while not (found := children(process.pid, "link_probe measure")):
        assert time.monotonic() < deadline, "the link is not measured"
        time.sleep(0.02)
    found += children(process.pid, "")
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(found, timeout=60)
    assert alive == []
    sweep()
    assert left_behind(process.pid) == []


def children(pid: int, text: str) -> list[psutil.Process]:
    """Return the descendants of a process whose command line has a text."""
    found = psutil.Process(pid).children(recursive=True)
    return [child for child in found if text in " ".join(command_line(child))]


@needs_machines
def test_the_system_of_the_page_takes_part(tmp_path: Path) -> None:
    """As in a package of its own, which is installed beside RCE."""
    page = (ROOT / "docs" / "how-to" / "add-a-system.md").read_text()
    (code,) = re.findall(
        r"<!-- file: robot_master.py -->\n```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL
    )
    (toml,) = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    points = tomllib.loads(toml)["project"]["entry-points"]["rce.systems"]
    (tmp_path / "robot_master.py").write_text(code)
    info = tmp_path / "robot_master-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: robot_master\nVersion: 1\n")
    lines = "".join(f"{name} = {value}\n" for name, value in points.items())
    (info / "entry_points.txt").write_text(f"[rce.systems]\n{lines}")
    words = ("round-trip", "--quick", "--systems", "robot_master", "--software", "rce", "--output")
    done = subprocess.run(
        command(*words, tmp_path / "data"),
        check=False,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        timeout=TIMEOUT_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = read_rows(tmp_path / "data" / "results.csv")
    assert {row.condition.system for row in rows if row.metric == "round_trip"} == {"robot_master", "-"}


def test_a_plan_says_what_would_run_and_runs_nothing(tmp_path: Path) -> None:
    done = subprocess.run(
        command("all", "--plan", "--software", "rce"),
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    lines = {line.split()[0]: line for line in done.stdout.splitlines()}
    assert lines.keys() == {*EXPERIMENTS, "all"}
    assert float(lines["all"].split()[-2]) <= 120.0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["lasers"], "there is no experiment lasers; there is laser, round-trip, images"),
        (["laser", "--systems", "cloud,peer"], "there is no system peer; there is cloud, multi_master"),
        (["laser", "--software", "ros2"], "there is no software ros2; there is ros, roscpp, rce"),
        (["laser", "--systems", ","], "--systems needs at least one name"),
        (["laser", "--resume", "absent"], "--resume absent: it is not the folder of an experiment"),
        (["laser", "--resume", "file"], "--resume file: it is not the folder of an experiment"),
        (["laser", "--resume", "absent", "--plan"], "there is no environment.json"),
        (["laser", "--runs", "0"], "should be greater than or equal to 1"),
        (["offload", "--systems", "multi_master"], "it has nothing to measure with the systems multi_master"),
        (["laser", "--output", "file"], "file exists already; name a new folder"),
        (
            ["laser", "--page", "file/page.md"],
            "--page file/page.md cannot be written: file/page: Not a directory",
        ),
        (["laser", "--second", "absent"], "absent is not a folder with raw data: there is no results.csv"),
        (["laser", "--output", "there"], "there exists already; go on in it with --resume there"),
        (["laser", "--output", "a", "--resume", "b"], "give one of both"),
        (["laser", "there"], "only page takes folders"),
        (["page"], "page needs at least one folder of raw data"),
        (["page", "there"], "there is not a folder with raw data: there is no results.csv"),
        (["laser", "--robots", "50"], "should be less than or equal to 20"),
        (["laser", "--resume", "there", "--seed", "2"], "--resume there: its seed is 1, now it is 2"),
    ],
)
def test_bad_input_is_named(tmp_path: Path, words: list[str], text: str) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "file").touch()
    commit = {"commit": described_commit(), "seed": 1}
    (tmp_path / "there" / "environment.json").write_text(json.dumps(commit))
    done = subprocess.run(command(*words), check=False, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode in (1, 2)
    assert text in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "there"]


@needs_machines
@pytest.mark.parametrize(
    ("kept", "text"),
    [
        (("tc", "setpriv"), "making them needs the program ip"),
        (("ip", "tc"), "making them needs the program setpriv"),
    ],
)
def test_missing_programs_are_named(tmp_path: Path, kept: tuple[str, ...], text: str) -> None:
    for name in kept:
        found = shutil.which(name)
        assert found is not None
        (tmp_path / name).symlink_to(found)
    done = refused(tmp_path, command("laser", "--quick", "--software", "rce", "--output", tmp_path / "data"))
    assert text in done.stderr
    assert not (tmp_path / "data").exists()


@needs_machines
def test_missing_rights_are_named(tmp_path: Path) -> None:
    words = command("laser", "--quick", "--software", "rce", "--output", tmp_path / "data")
    setpriv = shutil.which("setpriv")
    assert setpriv is not None
    done = refused(Path(os.environ["PATH"]), [setpriv, "--bounding-set", "-sys_admin,-net_admin", *words])
    assert "needs the capabilities CAP_SYS_ADMIN and CAP_NET_ADMIN" in done.stderr
    assert not (tmp_path / "data").exists()


def refused(path: Path, words: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a command with a ``PATH``, which must end with an error without a traceback."""
    done = subprocess.run(
        words, check=False, capture_output=True, text=True, env=os.environ | {"PATH": str(path)}
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    return done


@cache
def described_commit() -> str:
    code = "from rce_fleet.experiments.environment import commit; print(commit())"
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.strip()
