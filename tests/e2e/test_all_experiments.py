"""``rce experiment all --quick`` on real machines: interrupted and resumed; its raw data and page."""

from __future__ import annotations

import json
import os
import re
import signal
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest
from support.experiments import TIMEOUT_S, left_behind, run, started

from rce_fleet.experiments.catalogue import EXPERIMENTS
from rce_fleet.experiments.experiment import PAPER_SYSTEMS, Options
from rce_fleet.experiments.offload import tasks_of
from rce_fleet.experiments.results import DONE, Row, read_rows

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.real_time("machines"),
    pytest.mark.needs("netns", "cgroups", "rospy", "pymunk"),
    pytest.mark.timeout(TIMEOUT_S),
]

COMPARED = ("laser", "round-trip", "images")
SINGLE, MULTI, CLOUD = PAPER_SYSTEMS


class Data(NamedTuple):
    """What a run left in its folder.

    Attributes:
        folder: The folder.
        rows: Its raw data.
    """

    folder: Path
    rows: list[Row]

    def values(self, experiment: str, **factors: str) -> dict[str, float]:
        """Return values by metric of an experiment's conditions that have some factors."""
        return {
            row.metric: row.value
            for row in self.rows
            if row.condition.experiment == experiment
            and factors.items() <= {"system": row.condition.system, **dict(row.condition.factors)}.items()
        }


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Data:
    """All experiments, interrupted in the first run and gone on with."""
    folder = tmp_path_factory.mktemp("experiments") / "data"
    process = started(folder, "all", "--quick")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130
    assert left_behind(process.pid) == []

    done = run("all", "--quick", "--resume", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return Data(folder, read_rows(folder / "results.csv"))


def test_each_experiment_has_figures_of_each_system(data: Data) -> None:
    finished = Counter(row.condition.experiment for row in data.rows if row.metric == DONE)
    assert finished.keys() == EXPERIMENTS.keys()
    for experiment in COMPARED:
        for system in PAPER_SYSTEMS:
            measured = data.values(experiment, system=system)
            wanted = {"round_trip"} if experiment == "round-trip" else {"rate", "server.cpu", "delay_p50"}
            assert wanted <= measured.keys(), f"{experiment} of {system}"
    assert all(
        row.value < 0.5
        for row in data.rows
        if row.metric == "lost" and row.condition.experiment != "robustness"
    )
    assert data.values("link").keys() >= {"round_trip", "rate", "rate_back"}


def test_circumstances_are_told(data: Data) -> None:
    described = json.loads((data.folder / "environment.json").read_text())
    assert described["cores"] == len(os.sched_getaffinity(0))
    assert described["options"]["quick"] is True


def test_there_is_a_page_with_its_figures(data: Data) -> None:
    page = (data.folder / "experiments.md").read_text()
    assert "## The paper's claims" in page
    for figure in re.findall(r"]\((experiments/[^)]*)\)", page):
        assert (data.folder / figure).stat().st_size > 0


def test_a_run_that_is_done_is_not_done_again(data: Data) -> None:
    again = run("all", "--quick", "--resume", data.folder)
    assert again.returncode == 0
    assert again.stdout.count("all runs are done") == len(EXPERIMENTS)
    assert read_rows(data.folder / "results.csv") == data.rows


def test_all_robots_are_heard_and_one_takes_trips(data: Data) -> None:
    for system in PAPER_SYSTEMS:
        found = data.values("scaling", system=system)
        assert found["received"] > 0
        assert found["start"] > 0
        assert found["round_trip"] > 0.009, "twice the link's delay"
        assert found["server.memory"] > 0


def test_robots_of_one_master_reach_each_other(data: Data) -> None:
    found = data.values("isolation", system=SINGLE)
    assert found["topics_others"] == 2
    assert found["nodes_others"] == found["parameters_others"] == 1
    assert [found[name] for name in ("can_publish", "can_call", "can_end_nodes", "can_use_core")] == 4 * [1.0]


def test_a_container_reaches_nothing_of_another_robot(data: Data) -> None:
    found = data.values("isolation", system=CLOUD)
    names = ("topics_others", "nodes_others", "parameters_others", "can_publish", "can_call")
    assert [found[name] for name in (*names, "can_end_nodes", "can_use_core")] == 7 * [0.0]


def test_topics_outlive_a_killed_core_or_master(data: Data) -> None:
    for system in PAPER_SYSTEMS:
        found = data.values("robustness", system=system)
        assert (found["topics_came_back"], found["lost_messages"]) == (1.0, 0.0), f"{system}: {found}"
    assert data.values("robustness", system=SINGLE)["services_stopped"] > 1.0


@pytest.mark.parametrize("place", ["robot", "cloud"])
def test_a_robot_does_its_tasks_in_both_places(data: Data, place: str) -> None:
    tasks = {task: data.values("offload", place=place, task=task) for task in tasks_of(Options(quick=True))}
    for values in tasks.values():
        assert values["success"] == 1.0
        assert values["energy"] > 0
        assert values["robot.cpu"] > 0
    assert 0 < tasks["navigation"]["control_delay"] < tasks["navigation"]["task_time"]
    sent = [values["robot.network_out"] for values in tasks.values()]
    if place == "cloud":
        assert min(sent) > 10e3, "scans and odometry"
    else:
        assert max(sent) < 1e3
