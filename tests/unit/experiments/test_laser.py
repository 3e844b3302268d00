"""Scans: the work of a full client, and what is measured in a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import pytest

from rce_fleet.experiments import environment, usage
from rce_fleet.experiments import laser as module
from rce_fleet.experiments.bench import CLIENT
from rce_fleet.experiments.experiment import NETBOOK_CORES, Options, Trial
from rce_fleet.experiments.laser import PAPER_HZ, Laser, calibrated, most_work, parts
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.streaming import Part
from rce_fleet.experiments.usage import make_meter

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


class Course:
    """Stands for a bench with the best meter that there is, and for the streams on it."""

    def __init__(self, *, seed: int = 0) -> None:
        del seed
        self.meters = {CLIENT: make_meter("rcx-course", "rcx-course")}

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None: ...

    async def measure(self, wanted: Sequence[Part], seconds: float) -> list[tuple[Part, list[Value]]]:
        del seconds
        for part in wanted:
            self.meters[CLIENT].limit(part.client_cores)
        return [(part, [Value("rate", 30.0, "Hz")]) for part in wanted]


async def test_without_control_groups_no_client_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All other conditions are measured, and the description says why these are missing."""
    monkeypatch.setattr(usage, "ROOT", tmp_path)
    assert not environment.can_limit()
    course = Course()

    async def start(*_: object) -> Course:
        return course

    monkeypatch.setattr(module, "Bench", lambda **_: course)
    monkeypatch.setattr(module, "start", start)
    options = Options(systems=("single_master",), software=("rce",))
    assert await Laser().prepare(options, 1) == []
    (setup,) = Laser().setups(options)
    found = await Laser().measure(Trial(setup, options, 1, prepared={"scan_work": 0.01}))
    factors = [dict(one.condition.factors) for one in found]
    assert {one["client_cpu"] for one in factors} == {"all"}
    assert {(one["printed"], one["rate"]) for one in factors} == {
        ("yes", "free"),
        ("yes", "fixed"),
        ("no", "free"),
    }
