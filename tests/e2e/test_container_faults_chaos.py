"""Kill -9 at random moments of containers' lives: what is desired comes back, and nothing is left."""

from __future__ import annotations

import os

import pytest
from support import chaos

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(180)]

ROUNDS = 12


@pytest.mark.parametrize(
    ("runtime", "seed"),
    [("process", 3), pytest.param("namespace", 4, marks=pytest.mark.needs("bwrap"))],
)
async def test_chaos_leaves_what_is_wanted_and_nothing_else(runtime: str, seed: int) -> None:
    groups = runtime == "namespace" and os.geteuid() == 0
    story = await chaos.run(runtime, seed, ROUNDS, groups=groups)
    assert len([line for line in story if line.startswith("kill")]) >= ROUNDS / 2
