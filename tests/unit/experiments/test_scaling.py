"""What the experiment ``scaling`` runs: which set-ups, how often, and how robots are spread over programs."""

from __future__ import annotations

import pytest

from rce_fleet.experiments.experiment import Options
from rce_fleet.experiments.runner import Plan
from rce_fleet.experiments.scaling import ROBOTS, Scaling, shares


def test_only_the_cloud_has_a_container_for_each_robot() -> None:
    setups = Scaling().setups(Options())
    assert {setup.software for setup in setups} == {"ros"}
    factors = [(setup.system, *(value for _, value in setup.factors)) for setup in setups]
    assert {system for system, containers, _ in factors if containers == "each"} == {"cloud"}
    assert len(setups) == 4 * len(ROBOTS)
    assert len(Scaling().setups(Options(quick=True))) == 3


def test_each_number_of_robots_runs_as_often() -> None:
    works = Plan([Scaling()], Options(systems=("single_master",)), 10, 1).works(Scaling(), [])
    numbers: dict[str, list[int]] = {}
    for _, (setup, number) in works:
        numbers.setdefault(dict(setup.factors)["robots"], []).append(number)
    assert numbers == {str(robots): list(range(11)) for robots in ROBOTS}
    assert (min(ROBOTS), max(ROBOTS)) == (1, 50)


@pytest.mark.parametrize(("robots", "expected"), [([1], [[1]]), ([1, 2, 3, 4, 5, 6], [[1, 3, 5], [2, 4, 6]])])
def test_programs_simulate_about_as_many_robots(robots: list[int], expected: list[list[int]]) -> None:
    assert shares(robots) == expected
