"""``rce experiment`` from outside: all experiments quickly, interrupted and killed runs, bad input."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from rce_fleet.experiments.catalogue import EXPERIMENTS
from rce_fleet.experiments.experiment import PAPER_SYSTEMS
from rce_fleet.experiments.results import read_rows
from rce_fleet.experiments.runner import DONE

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 550.0
COMPARED = ("laser", "round-trip", "images")
needs_machines = pytest.mark.needs("netns")
needs_ros = pytest.mark.needs("rospy")


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
    raise AssertionError(f"no run was begun: {process.wait()}")


@needs_machines
@needs_ros
@pytest.mark.needs("pymunk")
@pytest.mark.timeout(TIMEOUT_S)
def test_all_experiments_quickly_with_an_interruption(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    process = started(folder, "all", "--quick")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130
    assert left_behind(process.pid) == []

    done = run("all", "--quick", "--resume", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = read_rows(folder / "results.csv")
    finished = Counter(row.condition.experiment for row in rows if row.metric == DONE)
    assert finished.keys() == EXPERIMENTS.keys()
    for experiment in COMPARED:
        values = {
            (row.condition.system, row.metric) for row in rows if row.condition.experiment == experiment
        }
        for system in PAPER_SYSTEMS:
            for metric in (
                ("round_trip",) if experiment == "round-trip" else ("rate", "server.cpu", "delay_p50")
            ):
                assert (system, metric) in values, f"{experiment} has no {metric} of {system}"
    assert all(
        row.value < 0.5 for row in rows if row.metric == "lost" and row.condition.experiment != "robustness"
    )
    assert {row.metric for row in rows if row.condition.experiment == "link"} >= {"round_trip", "rate"}
    described = json.loads((folder / "environment.json").read_text())
    assert described["cores"] == len(os.sched_getaffinity(0))
    assert described["options"]["quick"] is True

    page = (folder / "experiments.md").read_text()
    assert "## The paper's claims" in page
    for figure in re.findall(r"]\((experiments/[^)]*)\)", page):
        assert (folder / figure).stat().st_size > 0

    again = run("all", "--quick", "--resume", folder)
    assert again.returncode == 0
    assert again.stdout.count("all runs are done") == len(EXPERIMENTS)
    assert read_rows(folder / "results.csv") == rows


@needs_machines
def test_what_a_killed_experiment_leaves_is_removed_by_the_next_one(tmp_path: Path) -> None:
    process = started(
        tmp_path / "one", "round-trip", "--quick", "--systems", "single_master", "--software", "rce"
    )
    time.sleep(1.0)
    process.kill()
    process.communicate()
    assert left_behind(process.pid) != []
    done = run(
        *("round-trip", "--quick", "--systems", "single_master", "--software", "rce"),
        *("--output", tmp_path / "two"),
    )
    assert done.returncode == 0, done.stderr
    assert f"removed what an experiment left that was killed: rcx{process.pid}." in done.stdout
    assert left_behind(process.pid) == []


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
        (["laser", "--software", "ros2"], "there is no software ros2; there is ros, rce"),
        (["laser", "--systems", ","], "--systems needs at least one name"),
        (["laser", "--resume", "absent"], "--resume absent: "),
        (["laser", "--output", "there"], "there exists already; go on in it with --resume there"),
        (["laser", "--output", "a", "--resume", "b"], "give one of both"),
        (["laser", "--robots", "50"], "should be less than or equal to 20"),
        (["laser", "--resume", "there", "--seed", "2"], "--resume there: its seed is 1, now it is 2"),
    ],
)
def test_bad_input_is_named(tmp_path: Path, words: list[str], text: str) -> None:
    (tmp_path / "there").mkdir()
    commit = {"commit": described_commit(), "seed": 1}
    (tmp_path / "there" / "environment.json").write_text(json.dumps(commit))
    done = subprocess.run(command(*words), check=False, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode in (1, 2)
    assert text in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there"]


def described_commit() -> str:
    code = "from rce_fleet.experiments.environment import commit; print(commit())"
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.strip()
