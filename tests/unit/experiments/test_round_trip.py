"""The order of series of round trips."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rce_fleet.experiments.experiment import Options
from rce_fleet.experiments.round_trip import DELAYS_MS, RoundTrip, rounds_of


@pytest.mark.parametrize("quick", [False, True])
def test_no_delay_grows_in_a_run(quick: bool) -> None:
    options = Options(quick=quick)
    seen = set()
    for setup in RoundTrip().setups(options):
        delays = [one.delay for one in rounds_of(setup, options)]
        assert all(before >= after for before, after in pairwise(delays))
        seen.update(delays)
    assert seen == (set(DELAYS_MS[:1]) if quick else set(DELAYS_MS))
