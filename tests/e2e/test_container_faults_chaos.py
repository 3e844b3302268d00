"""Kill -9 at random moments of containers' lives: what is desired comes back, and nothing is left."""

from __future__ import annotations

import os

import pytest
from support import chaos

pytestmark = [pytest.mark.e2e]


@pytest.mark.parametrize(
    ("runtime", "seed", "rounds"),
    [("process", 3, 4), pytest.param("namespace", 4, 10, marks=pytest.mark.needs("bwrap"))],
)
async def test_chaos_leaves_what_is_wanted_and_nothing_else(runtime: str, seed: int, rounds: int) -> None:
    groups = runtime == "namespace" and os.geteuid() == 0
    story = await chaos.run(runtime, seed, rounds, groups=groups)
    assert len([line for line in story if line.startswith("kill")]) >= rounds / 2
