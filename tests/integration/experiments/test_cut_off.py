"""A machine that is cut off for a while: what stops, and that it comes back."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from rce_fleet.experiments.experiment import Options, Trial
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.robustness import Robustness


def left_behind() -> list[str]:
    shown = subprocess.run(["ip", "netns"], check=True, capture_output=True, text=True).stdout
    folders = [path.name for path in Path("/tmp").glob("rcx*")]
    return [name for name in (*shown.split(), *folders) if name.startswith(f"rcx{os.getpid()}.")]


@pytest.mark.needs("netns")
async def test_a_machine_that_was_cut_off_comes_back() -> None:
    setup = Condition.of("robustness", "single_master", "rce", fault="machine_cut")
    assert setup in Robustness().setups(Options(software=("rce",)))
    options = Options(software=("rce",), seconds=1.0, quick=True)
    measured = await Robustness().measure(Trial(setup, options, seed=1))
    assert left_behind() == []
    found = {one.value.metric: one.value.value for one in measured}
    assert found["topics_stopped"] > 2.0
    assert [found[f"{name}_came_back"] for name in ("topics", "services", "new_topics")] == 3 * [1.0]
