"""The fault suite, its short form; ``make faults`` is the long one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from faults.catalogue import SCENARIOS, Scenario
from faults.goals import Times
from faults.world import world

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.needs("root", "netns", "etcd", "iptables"),
    pytest.mark.real_time("machines"),
]

SEED = 1
SHORT = [each for each in SCENARIOS if each.short]


@pytest.mark.parametrize("scenario", SHORT, ids=[each.name for each in SHORT])
async def test_nothing_is_lost_and_no_link_is_cut(
    scenario: Scenario, folder: Path, record_property: Callable[[str, object], None]
) -> None:
    times = Times()
    async with world(folder, SEED, times, robot=scenario.robot) as made:
        await scenario.run(made)
    record_property("figures", "\n".join(times.table()))
