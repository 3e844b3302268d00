"""``rce experiment`` with folders of raw data: which runs are made in them, and what is not mixed."""

from __future__ import annotations

import fcntl
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from rce_fleet.experiments import environment
from rce_fleet.experiments.command import _options, experiment
from rce_fleet.experiments.folders import go_on
from rce_fleet.experiments.laser import Laser
from rce_fleet.experiments.ownership import measuring
from rce_fleet.experiments.report import drawing
from rce_fleet.experiments.results import DONE, Row, write_rows
from rce_fleet.experiments.runner import USUAL_LINKS, Plan, link_condition

SYSTEMS = "single_master,cloud"
app = typer.Typer()
app.command()(experiment)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """The folder of an experiment whose first run was interrupted."""
    folder = tmp_path / "data"
    folder.mkdir()
    options = _options(SYSTEMS, "rce", 5, quick=False)
    environment.write(folder, environment.describe(options, seed=1, runs=20))
    return folder


def invoke(*words: str | Path) -> tuple[int, str]:
    shown = CliRunner().invoke(
        app, ["laser", "--systems", SYSTEMS, "--software", "rce", *map(str, words)], env={"COLUMNS": "200"}
    )
    assert shown.exception is None or isinstance(shown.exception, SystemExit), shown.exception
    return shown.exit_code, " ".join(shown.output.split())


@pytest.mark.slow
def test_as_many_runs_are_made_as_were_begun(data: Path) -> None:
    """Two set-ups, a warm-up of each, and 20 runs."""
    assert "2 set-ups 42 runs" in invoke("--resume", data, "--plan")[1]
    assert "2 set-ups 12 runs" in invoke("--resume", data, "--plan", "--runs", "5")[1]
    assert "2 set-ups 22 runs" in invoke("--plan")[1]


@pytest.mark.slow
def test_a_command_that_goes_on_needs_no_option_again(tmp_path: Path) -> None:
    """It is what is printed after Ctrl-C; an option that is given must be the same."""
    options = _options(SYSTEMS, "rce", 3, quick=True)
    environment.write(tmp_path, environment.describe(options, seed=4, runs=1))
    again = ["laser", "--plan", "--resume", str(tmp_path)]
    shown = CliRunner().invoke(app, again)
    assert shown.exit_code == 0, shown.output
    for given in (["--seed", "1"], ["--robots", "1"], ["--systems", "cloud"], ["--software", "ros"]):
        refused = CliRunner().invoke(app, [*again, *given])
        assert (refused.exit_code, "data of both cannot be in one table" in refused.output) == (1, True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"processor": "Z80"}, "its processor is Z80, now it is"),
        ({"versions": {"rce": "0.0.1"}}, 'its versions is {"rce": "0.0.1"}, now it is'),
        ({"cpu_shares": "sometimes"}, "its cpu_shares is sometimes"),
    ],
)
def test_rows_of_other_machines_and_versions_are_not_mixed(
    data: Path, change: dict[str, Any], text: str
) -> None:
    known = environment.read(data)
    environment.write(data, {**known, **change})
    code, told = invoke("--resume", data, "--plan")
    assert (code, text in told) == (1, True), told


@pytest.mark.slow
@pytest.mark.needs("netns")
def test_a_folder_is_used_by_one_command_at_a_time(data: Path) -> None:
    """Both would make the same runs, which disturb each other."""
    descriptor = os.open(data, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        code, told = invoke("--resume", data)
        assert (code, "another command runs in" in told) == (1, True), told
    finally:
        os.close(descriptor)
    assert not (data / "results.csv").exists()


def test_a_second_experiment_is_told_that_it_is_not_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with measuring() as first, measuring() as second:
        assert (first, second) == (True, False)
    with measuring() as again:
        assert again


@pytest.mark.slow
@pytest.mark.needs("netns")
def test_two_experiments_at_once_say_so(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each would spoil the figures of the other, for hours. The plan of this one is done already."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(drawing, "can_draw", lambda: False)
    options = _options(SYSTEMS, "rce", 5, quick=False)
    planned = Plan([Laser()], options, 1, seed=1)
    links = map(link_condition, USUAL_LINKS)
    done = [Row(run.condition, 1, DONE, 1.0, "s") for _, run in planned.works(Laser(), []) if run.number]
    write_rows(data / "results.csv", [*(Row(link, 1, "rate", 1.0, "bit/s") for link in links), *done])
    with measuring():
        code, told = invoke("--resume", data, "--runs", "1")
    assert (code, "the figures of both are disturbed" in told) == (0, True), told
    code, told = invoke("--resume", data, "--runs", "1")
    assert (code, "the figures of both are disturbed" in told) == (0, False), told


def test_the_commit_is_not_that_of_a_repository_around_it(tmp_path: Path) -> None:
    """As where a researcher's notes are in one, and the environment with RCE below them."""
    package = tmp_path / "venv" / "rce"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    git = ("git", "-C", str(tmp_path), "-c", "user.name=anna", "-c", "user.email=anna@example.com")
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "--message", "notes"], check=True)
    assert environment.commit(package) == "unknown"
    (tmp_path / "page.md").touch()
    subprocess.run([*git, "add", "venv", "page.md"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--message", "rce"], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    (tmp_path / "page.md").write_text("made of the data\n")
    assert environment.commit(package) == head.strip()
    (package / "__init__.py").write_text("changed\n")
    assert environment.commit(package) == f"{head.strip()}+"


@pytest.mark.slow
@pytest.mark.needs("netns")
@pytest.mark.parametrize(("runs", "noted"), [(30, 30), (5, 20)])
def test_the_description_has_all_runs_that_were_asked_for(data: Path, runs: int, noted: int) -> None:
    go_on(data, environment.read(data), Plan([], _options(SYSTEMS, "rce", 5, quick=False), runs, seed=1))
    assert environment.read(data)["runs"] == noted


@pytest.mark.slow
@pytest.mark.needs("netns")
def test_the_description_has_each_time_at_which_it_went_on(data: Path) -> None:
    """Runs of other hours are in the same table then: the computer may have been faster or slower."""
    for count in (1, 2):
        former = environment.read(data)
        go_on(data, former, Plan([], _options(SYSTEMS, "rce", 5, quick=False), 5, seed=1))
        resumed = environment.read(data)["resumed"]
        assert len(resumed) == count
        assert former["started"] <= resumed[-1] <= environment.now()
