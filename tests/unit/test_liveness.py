"""When a connection counts as lost: by looks at signs of life, without a clock."""

from __future__ import annotations

import pytest

from rce.control_channel.timeouts import DEFAULT_TIMEOUTS
from rce.liveness import Liveness, Step


def steps(liveness: Liveness, seconds: float, *, heard: bool = False, moved: bool = False) -> list[Step]:
    """Look for a time; return what there was to do."""
    looks = round(seconds / liveness.period)
    found = [liveness.look(liveness.period, heard=heard, moved=moved) for _ in range(looks)]
    return [step for step in found if step is not Step.NOTHING]


def test_silent_peer_is_pinged_and_given_up() -> None:
    liveness = Liveness(2.0, 4.0)
    assert steps(liveness, 1.5) == []
    assert steps(liveness, 0.5) == [Step.PING]
    assert steps(liveness, 3.5) == []
    assert steps(liveness, 0.5) == [Step.GIVE_UP]
    assert liveness.silent == pytest.approx(6.0)


def test_task_set_leaves_a_hanging_master_soon() -> None:
    """Another master leads when the lease of 3 s has ended; task sets have 10 s from then."""
    liveness = Liveness(DEFAULT_TIMEOUTS.master_ping_interval, DEFAULT_TIMEOUTS.ping_timeout)
    liveness.look(liveness.period, heard=True)  # and the master hangs right after its last sign of life
    while liveness.look(liveness.period, heard=False) is not Step.GIVE_UP:
        pass
    assert liveness.silent + liveness.period + DEFAULT_TIMEOUTS.close < 9.0


def test_each_sign_of_life_begins_anew() -> None:
    liveness = Liveness(2.0, 4.0)
    for _ in range(10):
        assert steps(liveness, 5.5) == [Step.PING]
        assert liveness.look(liveness.period, heard=True) is Step.NOTHING


def test_peer_that_sends_is_never_pinged() -> None:
    assert steps(Liveness(2.0, 4.0), 100.0, heard=True) == []


def test_time_in_which_the_program_slept_counts_little() -> None:
    """It could not see signs of life either; they come with the next look."""
    liveness = Liveness(2.0, 4.0)
    assert liveness.look(1000.0, heard=False) is Step.NOTHING
    assert liveness.silent == 2 * liveness.period
    assert steps(liveness, 1.0) == [Step.PING]
    assert liveness.look(1000.0, heard=False) is Step.NOTHING
    assert liveness.silent < 4.0


def test_peer_that_takes_what_waits_is_not_given_up() -> None:
    liveness = Liveness(2.0, 4.0)
    assert steps(liveness, 100.0, moved=True) == []
    assert steps(liveness, 2.0) == [Step.PING]
    assert steps(liveness, 100.0, moved=True) == []  # the ping is on its way
    assert steps(liveness, 3.5) == []
    assert steps(liveness, 0.5) == [Step.GIVE_UP]


def test_without_a_limit_it_only_pings() -> None:
    assert steps(Liveness(2.0, None), 100.0) == [Step.PING]
