"""``rce up`` leaves nothing, by whatever signal it ends and at whatever moment."""

from __future__ import annotations

import random
import signal

import pytest
from support.moments import PROGRAMS, Moment, run

pytestmark = [pytest.mark.e2e, pytest.mark.needs("bwrap")]

CONTAINER = PROGRAMS[-1:]


@pytest.mark.parametrize(
    ("number", "pause"),
    [(signal.SIGINT, 0.0), (signal.SIGINT, 1.0), (signal.SIGKILL, 0.0), (signal.SIGQUIT, 1.0)],
)
async def test_end_just_after_the_manager_was_killed(number: signal.Signals, pause: float) -> None:
    """The next ``rce-container`` does not run yet, or has not heard of signals yet."""
    assert (
        await run(Moment(containers=True, killed=CONTAINER, pause=pause, signals=(number,)), "namespace")
        == []
    )


async def test_end_when_all_programs_were_killed() -> None:
    signals = (signal.SIGHUP, signal.SIGINT)
    assert await run(Moment(containers=True, killed=PROGRAMS, pause=0.1, signals=signals), "process") == []


@pytest.mark.parametrize("seed", range(3))
async def test_end_at_a_random_moment(seed: int) -> None:
    moment = Moment.by_chance(random.Random(seed))
    assert await run(moment, "namespace") == [], moment
