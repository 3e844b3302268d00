"""A robot's tasks, on the robot and in the cloud: the quick variant of the experiment `offload`."""

from __future__ import annotations

import os
import subprocess

import pytest

from rce_fleet.experiments.experiment import Options, Trial
from rce_fleet.experiments.offload import Offload, tasks_of


@pytest.mark.needs("netns", "cgroups")
@pytest.mark.timeout(240)
@pytest.mark.parametrize("place", ["robot", "cloud"])
async def test_a_robot_does_its_tasks_in_both_places(place: str) -> None:
    experiment, options = Offload(), Options(quick=True)
    (setup,) = (one for one in experiment.setups(options) if dict(one.factors)["place"] == place)
    found = await experiment.measure(Trial(setup, options, seed=1))
    metrics: dict[str, dict[str, float]] = {}
    for condition, value in found:
        metrics.setdefault(dict(condition.factors)["task"], {})[value.metric] = value.value
    assert set(metrics) == set(tasks_of(options))
    for values in metrics.values():
        assert values["success"] == 1.0
        assert values["energy"] > 0
        assert values["robot.cpu"] > 0
    assert 0 < metrics["navigation"]["control_delay"] < metrics["navigation"]["task_time"]
    sent = [values["robot.network_out"] for values in metrics.values()]
    if place == "cloud":
        assert min(sent) > 10e3, "scans and odometry"
    else:
        assert max(sent) < 1e3
    left = subprocess.run(["ip", "netns"], check=True, capture_output=True, text=True).stdout
    assert f"rcx{os.getpid()}." not in left
