"""Scans: the work of a full client, and what is measured in a run."""

import pytest

from rce_fleet.experiments.experiment import NETBOOK_CORES, Options
from rce_fleet.experiments.laser import PAPER_HZ, calibrated, most_work, parts
from rce_fleet.experiments.results import Condition

OPTIONS = Options(software=("ros", "rce"))
SETUP = Condition.of("laser", "single_master", "ros")


@pytest.mark.parametrize("robots", [1, 5, 20])
@pytest.mark.parametrize("sending_s", [0.0, 0.0002, 0.0009])
async def test_work_for_a_scan_is_found(robots: int, sending_s: float) -> None:
    """A scan costs the full client its making and its sending."""

    async def rate_with(work_s: float) -> float:
        return NETBOOK_CORES / robots / (work_s + sending_s)

    found = await calibrated(rate_with, robots)
    assert await rate_with(found) == pytest.approx(PAPER_HZ, rel=0.05)


def test_client_that_sends_nothing_else_is_full_at_the_paper_rate() -> None:
    assert most_work(5) * 5 * PAPER_HZ == pytest.approx(NETBOOK_CORES)


def test_only_a_full_client_is_limited_and_works() -> None:
    found = {part.factors["client_cpu"]: part for part in parts(OPTIONS, SETUP, 0.01)}
    assert (found["full"].client_cores, found["full"].work_s) == (NETBOOK_CORES, 0.01)
    assert (found["all"].client_cores, found["all"].work_s) == (0.0, 0.0)
    unlimited = parts(OPTIONS, SETUP, 0.0)
    assert {part.factors["client_cpu"] for part in unlimited} == {"all"}


def test_further_software_has_the_main_conditions_only() -> None:
    main = parts(OPTIONS, Condition.of("laser", "cloud", "rce"), 0.01)
    assert main == parts(OPTIONS, SETUP, 0.01)[: len(main)]
    assert {(part.factors["printed"], part.factors["rate"]) for part in main} == {("yes", "free")}
    assert {part.factors["client_cpu"] for part in main} == {"all", "full"}
