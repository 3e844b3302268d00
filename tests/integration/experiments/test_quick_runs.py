"""Experiments run quickly in one system each: there are figures, and nothing is left."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from rce_fleet.experiments.catalogue import EXPERIMENTS
from rce_fleet.experiments.experiment import Options, Trial
from rce_fleet.experiments.results import Condition

pytestmark = pytest.mark.needs("netns")


async def measured(name: str, system: str, **factors: object) -> dict[str, float]:
    """Run a set-up of an experiment with our own nodes; return the values by metric."""
    options = Options(software=("rce",), seconds=1.0, quick=True)
    setup = Condition.of(name, system, "rce", **factors)
    assert setup in EXPERIMENTS[name].setups(Options(software=("rce",))) + EXPERIMENTS[name].setups(options)
    found = await EXPERIMENTS[name].measure(Trial(setup, options, seed=1))
    assert left_behind() == []
    return {one.value.metric: one.value.value for one in found}


def left_behind() -> list[str]:
    shown = subprocess.run(["ip", "netns"], check=True, capture_output=True, text=True).stdout
    folders = [path.name for path in Path("/tmp").glob("rcx*")]
    return [name for name in (*shown.split(), *folders) if name.startswith(f"rcx{os.getpid()}.")]


async def test_all_robots_are_heard_and_one_takes_trips() -> None:
    found = await measured("scaling", "single_master", robots=2, containers="one")
    assert found["received"] > 0
    assert found["start"] > 0
    assert found["round_trip"] > 0.009, "twice the link's delay"
    assert found["server.memory"] > 0


async def test_robots_of_one_master_reach_each_other() -> None:
    found = await measured("isolation", "single_master")
    assert found["topics_others"] == 2
    assert found["nodes_others"] == found["parameters_others"] == 1
    assert [found[name] for name in ("can_publish", "can_call", "can_end_nodes", "can_use_core")] == 4 * [1.0]


async def test_a_container_reaches_nothing_of_another_robot() -> None:
    found = await measured("isolation", "cloud")
    assert [
        found[name]
        for name in ("topics_others", "nodes_others", "parameters_others", "can_publish", "can_call")
    ] == 5 * [0.0]
    assert found["can_end_nodes"] == found["can_use_core"] == 0.0


async def test_topics_outlive_a_killed_core() -> None:
    found = await measured("robustness", "single_master", fault="core_killed")
    assert found["topics_stopped"] < 1.0
    assert found["services_stopped"] > 1.0
    assert found["topics_came_back"] == 1.0
    assert found["lost_messages"] == 0.0


async def test_a_machine_that_was_cut_off_comes_back() -> None:
    found = await measured("robustness", "single_master", fault="machine_cut")
    assert found["topics_stopped"] > 2.0
    assert [found[f"{name}_came_back"] for name in ("topics", "services", "new_topics")] == 3 * [1.0]
