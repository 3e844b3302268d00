"""The paper's claims, judged by rows whose medians are known by hand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pytest
from support.experiment_rows import CRS, MMS, SMS, in_three_systems, rows_of

from rce_fleet.experiments.report.claims import CLAIMS, FROM_CONTAINER, Judgement, judge, judge_all
from rce_fleet.experiments.report.judging import Verdict
from rce_fleet.experiments.report.measurements import Measurements
from rce_fleet.experiments.results import Condition, Row

HOLDS, FAILS, DEPENDS, NOT_MEASURED = Verdict

Medians = tuple[float, float, float]
PAPER = {"robots": 5, "printed": "yes", "client_cpu": "full", "rate": "free"}
FIXED = {**PAPER, "rate": "fixed"}
FALLING, EQUAL, RISING = (3.0, 2.0, 1.0), (2.0, 2.0, 2.0), (1.0, 2.0, 3.0)


def judged(letter: str, rows: Iterable[Row], software: str = "ros") -> Judgement:
    (claim,) = (claim for claim in CLAIMS if claim.letter == letter)
    return judge(claim, Measurements.of(rows), software)


def network(
    medians: Medians, factors: Mapping[str, object], *, experiment: str = "laser", software: str = "ros"
) -> list[Row]:
    """Half of the traffic in each direction."""
    halves = (medians[0] / 2, medians[1] / 2, medians[2] / 2)
    return [
        row
        for way in ("in", "out")
        for row in in_three_systems(
            experiment, f"server.network_{way}", "B/s", halves, factors, software=software
        )
    ]


def test_claim_holds_in_all_settings() -> None:
    found = judged("a", [*network(FALLING, PAPER), *network(FALLING, FIXED)])
    assert found.verdict is HOLDS
    assert found.reason.startswith("Holds in 2 of 2 cases. Met: SMS above MMS (`server.network_in + ")
    assert found.reference is not None
    assert dict(found.reference.factors)["rate"] == "free"
    assert {check.effect for check in found.reference.checks} == {1.0}


def test_claim_holds_in_no_case() -> None:
    found = judged("a", [*network(RISING, PAPER), *network(EQUAL, FIXED)])
    assert found.verdict is FAILS
    assert "MMS above CRS (`server.network_in + server.network_out`) 0 of 2." in found.reason


def test_claim_depends_on_a_factor() -> None:
    found = judged("a", [*network(FALLING, PAPER), *network(EQUAL, FIXED)])
    assert found.verdict is DEPENDS
    assert found.reason.startswith("Depends on rate: holds with free, not with fixed.")


def test_claim_depends_on_several_factors() -> None:
    """Two factors together decide, and none of them alone."""
    both = [
        (True, FALLING, "free"),
        (True, EQUAL, "fixed"),
        (False, FALLING, "fixed"),
        (False, EQUAL, "free"),
    ]
    found = judged(
        "a", [r for printed, m, rate in both for r in network(m, {"printed": printed, "rate": rate})]
    )
    assert found.verdict is DEPENDS
    assert found.reason.startswith("Holds in 2 of 4 cases.")


def test_difference_below_five_percent_is_not_called_one() -> None:
    assert judged("a", network((1.04, 1.02, 1.0), PAPER)).verdict is FAILS


def test_overlapping_intervals_are_not_told_apart() -> None:
    wide = (0.5, 1.0, 2.0)
    rows = in_three_systems("laser", "client.cpu", "cores", (1.0, 1.5, 1.5), PAPER, spread=wide)
    assert judged("c", rows).verdict is FAILS
    assert judged("c", in_three_systems("laser", "client.cpu", "cores", (1.0, 1.5, 1.5))).verdict is HOLDS


def test_claim_without_rows_is_not_measured() -> None:
    found = judged("a", [])
    assert found.verdict is NOT_MEASURED
    assert found.reason == "No rows of `laser`."
    assert found.reference is None
    assert (
        judged("b", network(FALLING, FIXED)).reason == "No rows of `laser` with client_cpu=full, rate=free."
    )


def test_missing_system_is_named() -> None:
    rows = [row for row in network(FALLING, PAPER) if row.condition.system != CRS]
    found = judged("a", rows)
    assert found.verdict is NOT_MEASURED
    assert found.reason == "Missing: no `server.network_in + server.network_out` of CRS."


def test_two_runs_are_too_few() -> None:
    found = judged("a", [row for row in network(FALLING, PAPER) if row.run < 3])
    assert found.verdict is NOT_MEASURED
    assert "of SMS has 2 of the 3 runs that are needed" in found.reason


def test_setting_with_missing_rows_is_counted() -> None:
    rows = [*network(FALLING, PAPER), *(r for r in network(FALLING, FIXED) if r.condition.system != MMS)]
    found = judged("a", rows)
    assert found.verdict is HOLDS
    assert "Not judged, for missing systems or runs: 1 more." in found.reason


def test_software_is_judged_apart() -> None:
    rows = [*network(FALLING, PAPER), *network(RISING, PAPER, software="rce")]
    found = {(one.claim.letter, one.software): one.verdict for one in judge_all(Measurements.of(rows))}
    assert (found["a", "ros"], found["a", "rce"]) == (HOLDS, FAILS)
    assert len(found) == 2 * len(CLAIMS) == 18


def test_roscpp_is_judged_where_it_was_measured() -> None:
    rows = [*network(FALLING, PAPER), *network(EQUAL, PAPER, software="roscpp")]
    found = {(one.claim.letter, one.software): one.verdict for one in judge_all(Measurements.of(rows))}
    assert (found["a", "ros"], found["a", "roscpp"]) == (HOLDS, FAILS)
    assert [software for letter, software in found if letter == "a"] == ["ros", "roscpp", "rce"]


def test_further_software_with_two_systems_is_judged() -> None:
    rows = [*network(FALLING, PAPER, software="rapyuta"), *rows_of(Condition.of("link", "-", "-"), {})]
    assert {one.software for one in judge_all(Measurements.of(rows))} == {"ros", "rce", "rapyuta"}


def test_reason_says_that_the_rate_makes_the_difference() -> None:
    rows = [
        *network((7500.0, 4500.0, 4000.0), PAPER),
        *in_three_systems("laser", "received", "Hz", (7.5, 4.5, 4.0), PAPER),
        *in_three_systems("laser", "message_bytes", "B", (1000.0, 1000.0, 1000.0), PAPER),
    ]
    assert judged("a", rows).reason.endswith(
        "Of `server.network_in + server.network_out`, SMS and CRS have most and least, 1.88 times: "
        "`received` differs 1.88 times, `message_bytes` 1.00 times, so more messages make the difference. "
        "`received`: SMS 7.50, MMS 4.50, CRS 4.00 Hz; `message_bytes`: SMS 1.00, MMS 1.00, CRS 1.00 kB."
    )


def test_reason_says_that_each_message_costs_more() -> None:
    rows = [
        *in_three_systems("laser", "client.cpu", "cores", (0.2, 0.4, 0.5), FIXED),
        *in_three_systems("laser", "rate", "Hz", EQUAL, FIXED),
    ]
    found = judged("c", rows)
    assert found.verdict is HOLDS
    assert "`client.cpu / rate` 2.50 times, so each message costs more." in found.reason
    assert "`client.cpu / rate`: SMS 100, MMS 200, CRS 250 ms." in found.reason


def test_client_cpu_is_shown_where_it_is_not_limited() -> None:
    """All systems use the same where the client is full: that figure says nothing of them."""
    free = {**PAPER, "client_cpu": "all"}
    rows = [
        *in_three_systems("laser", "client.cpu", "cores", (0.02, 0.04, 0.08), free),
        *in_three_systems("laser", "client.cpu", "cores", (0.2, 0.2, 0.2), PAPER),
        *in_three_systems("laser", "rate", "Hz", EQUAL, free),
        *in_three_systems("laser", "rate", "Hz", EQUAL, PAPER),
    ]
    found = judged("c", rows)
    assert found.verdict is DEPENDS
    assert found.reference is not None
    assert dict(found.reference.factors) == {name: str(value) for name, value in free.items()}
    limited = "With client_cpu=full, it is limited to the same share of a core in all systems."
    assert limited in found.reason
    assert limited not in judged("c", rows[:9] + rows[18:27]).reason


@pytest.mark.parametrize(
    ("medians", "verdict"),
    [((7.5, 4.5, 4.0), HOLDS), ((7.5, 7.4, 7.3), FAILS), ((15.0, 4.5, 4.0), FAILS)],
)
def test_rates_of_the_paper(medians: Medians, verdict: Verdict) -> None:
    """Only the cases with a full processor and a free rate count."""
    rows = [
        *in_three_systems("laser", "rate", "Hz", medians, PAPER),
        *in_three_systems("laser", "rate", "Hz", (30.0, 30.0, 30.0), FIXED),
    ]
    assert judged("b", rows).verdict is verdict


@pytest.mark.parametrize(
    ("used", "expected"),
    [
        ((0.5, 0.5, 0.5), "it uses about the same, so the rate is what its CPU allows."),
        ((0.5, 0.4, 0.2), "it does not use the same, so its CPU is not all that limits the rate."),
    ],
)
def test_reason_of_the_rates_is_the_cpu_only_if_it_is_full(used: Medians, expected: str) -> None:
    rows = [
        *in_three_systems("laser", "rate", "Hz", (7.5, 4.5, 4.0), PAPER),
        *in_three_systems("laser", "client.cpu", "cores", used, PAPER),
    ]
    assert judged("b", rows).reason.endswith(expected)


def test_server_is_judged_by_cpu_and_network() -> None:
    cpu = in_three_systems("laser", "server.cpu", "cores", FALLING, PAPER)
    assert judged("d", [*cpu, *network(FALLING, PAPER)]).verdict is HOLDS
    assert judged("d", [*cpu, *network(RISING, PAPER)]).verdict is FAILS
    assert judged("d", cpu).verdict is NOT_MEASURED


def trips(size: int, medians: Medians, container: float | None = None) -> list[Row]:
    factors = {"bytes": size, "delay": 0, "origin": "server"}
    rows = in_three_systems("round-trip", "round_trip", "s", medians, factors)
    if container is not None:
        condition = Condition.of("round-trip", CRS, "ros", bytes=size, delay=0, origin="container")
        rows += rows_of(condition, {"round_trip": (container, "s")})
    return rows


def test_round_trip_grows_and_is_about_the_same() -> None:
    rows = [*trips(7, (0.001, 0.0011, 0.0012), 0.0012), *trips(100, (0.002, 0.002, 0.0021), 0.0022)]
    found = judged("e", rows)
    assert found.verdict is HOLDS
    assert len(found.cases) == 4
    assert "SMS grows with size (`round_trip`) 4 of 4" in found.reason
    assert found.reference is not None
    assert dict(found.reference.factors)["origin"] == FROM_CONTAINER
    assert found.reason.endswith(
        "with bytes=100, delay=0, origin=server, 1.05 times: SMS 2.00, MMS 2.00, CRS 2.10 ms."
    )


def test_round_trip_differs_for_some_sizes() -> None:
    found = judged("e", [*trips(7, (0.001, 0.001, 0.003)), *trips(1000, (0.02, 0.02, 0.021))])
    assert found.verdict is DEPENDS
    assert found.reason.startswith("Depends on bytes: holds with 1000, not with 7.")
    assert "The systems differ most with bytes=7, delay=0, origin=server, 3.00 times" in found.reason


def test_round_trip_that_shrinks_does_not_grow() -> None:
    found = judged("e", [*trips(7, EQUAL), *trips(100, (1.0, 1.0, 1.0)), *trips(1000, RISING)])
    assert found.verdict is FAILS
    assert judged("e", trips(7, EQUAL)).verdict is NOT_MEASURED, "one size"


def test_images_network_and_cpu() -> None:
    factors = {"size": "640x480", "encoding": "raw", "rate": "carried", "printed": "yes"}
    rows = [
        *network((1.0, 1.1, 1.2), factors, experiment="images"),
        *in_three_systems("images", "server.cpu", "cores", RISING, factors),
        *in_three_systems("images", "client.cpu", "cores", RISING, factors),
    ]
    assert judged("f", rows).verdict is HOLDS
    assert judged("g", rows).verdict is HOLDS
    raw_only = [*rows, *network((1.0, 1.1, 1.3), {**factors, "encoding": "png"}, experiment="images")]
    assert judged("f", raw_only).reason.startswith("Depends on encoding: holds with raw, not with png.")


@pytest.mark.parametrize(
    ("others", "verdict"),
    [
        ((2, 0, 0), HOLDS),
        ((2, 1, 0), FAILS),
        ((2, 0, 1), FAILS),
        ((8, 8, 0), FAILS),
        ((0, 0, 0), FAILS),
    ],
)
def test_visible_topics_need_one_run(others: Medians, verdict: Verdict) -> None:
    """They are counted, not measured. One topic that is not shared and is seen is one too many."""
    rows = in_three_systems("isolation", "topics_others", "count", others, spread=[1.0])
    found = judged("h", rows)
    assert found.verdict is verdict
    assert f"Topics of other robots that a robot sees: SMS {others[0]}" in found.reason


def stops(system: str, topics: float, services: float, fault: str = "core_killed") -> list[Row]:
    condition = Condition.of("robustness", system, "ros", fault=fault)
    return rows_of(
        condition,
        {
            "topics_stopped": (topics, "s"),
            "services_stopped": (services, "s"),
            "new_topics_stopped": (20, "s"),
        },
    )


def test_topics_that_outlive_a_dead_core() -> None:
    rows = [*stops(SMS, 0.1, 20.0), *stops(MMS, 0.1, 20.0), *stops(SMS, 20.0, 20.0, "machine_cut")]
    found = judged("i", rows)
    assert found.verdict is HOLDS
    assert "Connected topics stopped for SMS 100, MMS 100 ms; services stopped for SMS 20.0" in found.reason
    found = judged("i", [*rows, *stops(CRS, 0.1, 0.2)])
    assert found.verdict is DEPENDS
    assert found.reason.startswith("Depends on system: holds with SMS, MMS, not with CRS.")
