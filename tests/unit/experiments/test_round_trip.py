"""The order of series of round trips."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rce_fleet.experiments.bench import SERVER
from rce_fleet.experiments.experiment import Options
from rce_fleet.experiments.round_trip import DELAYS_MS, TRIPS, RoundTrip, rounds_of, trips_of


@pytest.mark.parametrize("quick", [False, True])
def test_no_delay_grows_in_a_run(quick: bool) -> None:
    options = Options(quick=quick)
    seen = set()
    for setup in RoundTrip().setups(options):
        delays = [one.delay for one in rounds_of(setup, options)]
        assert all(before >= after for before, after in pairwise(delays))
        seen.update(delays)
    assert seen == (set(DELAYS_MS[:1]) if quick else set(DELAYS_MS))


def test_first_software_sends_the_largest_message() -> None:
    options = Options(software=("ros", "rce"))
    largest = {
        setup.software: max(trips_of(setup, options, SERVER, DELAYS_MS[0]))
        for setup in RoundTrip().setups(options)
    }
    assert largest["ros"] == max(TRIPS)
    assert largest["rce"] < max(TRIPS)
