"""Summaries of raw data, and the comparison of two full runs."""

from __future__ import annotations

from math import inf, isnan, nan
from pathlib import Path

import pytest

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.report.labels import natural, number, scale_for
from rce_fleet.experiments.report.measurements import Measurements, Quantity
from rce_fleet.experiments.report.repeat import compare
from rce_fleet.experiments.report.repeat_part import comparison_text
from rce_fleet.experiments.report.summary import read_summary, summarize, write_summary
from rce_fleet.experiments.results import Condition, Row

SMS = Condition.of("laser", "single_master", "ros", printed="yes")
MMS = Condition.of("laser", "multi_master", "ros", printed="yes")


def rows(condition: Condition, metric: str, values: list[float], unit: str = "Hz") -> list[Row]:
    return [Row(condition, run, metric, value, unit) for run, value in enumerate(values, 1)]


def test_warm_ups_and_values_that_are_not_finite_are_left_out() -> None:
    found = Measurements.of(
        [Row(SMS, 0, "rate", 99.0, "Hz"), *rows(SMS, "rate", [7.0, 8.0, inf]), *rows(MMS, "rate", [nan])]
    )
    sample = found.sample(SMS, "rate")
    assert sample is not None
    assert sample.values == (7.0, 8.0)
    assert found.sample(MMS, "rate") is None
    assert len(found.left_out) == 2


def test_last_value_of_a_repeated_run_counts() -> None:
    sample = Measurements.of([*rows(SMS, "rate", [1.0, 2.0]), *rows(SMS, "rate", [3.0])]).sample(SMS, "rate")
    assert sample is not None
    assert sample.values == (3.0, 2.0)


def test_quantities_are_computed_run_by_run() -> None:
    found = Measurements.of([*rows(SMS, "a", [1.0, 2.0, 3.0]), *rows(SMS, "b", [10.0, 0.0])])
    sums, shares = found.sample(SMS, Quantity("a", "+", "b")), found.sample(SMS, Quantity("a", "/", "b", "s"))
    assert sums is not None
    assert sums.values == (11.0, 2.0)
    assert shares is not None
    assert (shares.values, shares.unit, str(shares.quantity)) == ((0.1,), "s", "a / b")


def test_summary_is_read_as_it_was_written(tmp_path: Path) -> None:
    found = summarize(
        Measurements.of([*rows(SMS, "rate", [7.1, 7.123456789, 7.3]), *rows(MMS, "rate", [4.0])])
    )
    write_summary(tmp_path / "summary.csv", found)
    again = read_summary(tmp_path / "summary.csv")
    assert [one.condition for one in again] == [SMS, MMS]
    assert again[0] == found[0]
    assert again[0].estimate.median == 7.12346
    assert isnan(again[1].estimate.low)
    assert again[1].estimate.runs == 1


@pytest.mark.parametrize("text", ["", "a,b\n", "x\n"])
def test_other_tables_are_not_summaries(tmp_path: Path, text: str) -> None:
    (tmp_path / "summary.csv").write_text(text)
    with pytest.raises(ExperimentError, match="not a summary"):
        read_summary(tmp_path / "summary.csv")


def test_bad_line_of_a_summary_is_named(tmp_path: Path) -> None:
    path = tmp_path / "summary.csv"
    write_summary(path, [])
    path.write_text(path.read_text() + "laser,cloud,ros,,rate,Hz,ten,1,1,1\n")
    with pytest.raises(ExperimentError, match=r"summary.csv:2: .*ten"):
        read_summary(path)


@pytest.mark.parametrize("numbers", ["10,,,", "10,nan,1,2", "10,1,inf,2", "10,1,2,1", "10,1,1,", "0,1,1,1"])
def test_numbers_that_no_runs_give_are_refused(tmp_path: Path, numbers: str) -> None:
    path = tmp_path / "summary.csv"
    write_summary(path, [])
    path.write_text(path.read_text() + f"laser,cloud,ros,,rate,Hz,{numbers}\n")
    with pytest.raises(ExperimentError, match=r"summary.csv:2: "):
        read_summary(path)


def test_a_summary_that_was_cut_is_read_up_to_its_last_whole_line(tmp_path: Path) -> None:
    path = tmp_path / "summary.csv"
    write_summary(path, summarize(Measurements.of(rows(SMS, "rate", [7.1, 7.2, 7.34]))))
    path.write_text(path.read_text()[:-2])
    assert read_summary(path) == []
    path.write_bytes(b"\xb5")
    with pytest.raises(ExperimentError, match="not UTF-8"):
        read_summary(path)


def test_medians_of_a_second_run_are_counted() -> None:
    """Of five: one in the interval, one outside by 2 %, one by 100 %, and two with too few runs."""
    first = Measurements.of(
        [
            *rows(SMS, "rate", [7.0, 7.5, 8.0]),
            *rows(SMS, "received", [100.0, 100.0, 100.0]),
            *rows(SMS, "lost", [1.0, 1.0, 1.0]),
            *rows(SMS, "server.network@0.5", [1.0, 1.0, 1.0]),
            *rows(SMS, "delay_p95", [0.1, 0.1, 0.1]),
            *rows(MMS, "rate", [4.0]),
            *rows(MMS, "lost", [0.0]),
        ]
    )
    second = Measurements.of(
        [
            *rows(SMS, "rate", [7.3, 7.4, 7.5]),
            *rows(SMS, "received", [102.0, 102.0, 103.0]),
            *rows(SMS, "lost", [0.0, 2.0, 2.0]),
            *rows(SMS, "server.network@0.5", [9.0, 9.0, 9.0]),
            *rows(SMS, "delay_p95", [0.1, 0.1]),
            *rows(MMS, "rate", [4.0, 4.1, 4.2]),
            *rows(MMS, "delay_p50", [0.1]),
        ]
    )
    found = compare(summarize(first), summarize(second))
    assert found.inside == pytest.approx(1 / 3)
    assert found.inside_or_near == pytest.approx(2 / 3)
    assert found.expected == pytest.approx(1 / 3)
    assert not found.reaches_goal
    assert [(pair.first.metric, pair.change) for pair in found.outside] == [
        ("lost", 1.0),
        ("received", pytest.approx(0.02)),
    ]
    assert found.without_interval == 2
    assert [one.metric for one in found.only_first] == ["lost"]
    assert [one.metric for one in found.only_second] == ["delay_p50"]
    assert [name for name, _ in found.experiments()] == ["laser"]


def test_what_chance_can_do_is_told() -> None:
    """Three runs from 9 to 11, another three: the wider interval ends at 10 + sqrt(2)."""
    first = summarize(Measurements.of(rows(SMS, "rate", [9.0, 10.0, 11.0])))
    for rate, share, told in ((11.4, 1.0, "possible"), (11.5, 0.0, "unlikely")):
        second = summarize(Measurements.of(rows(SMS, "rate", [8.0, rate, 13.0])))
        found = compare(first, second)
        assert (found.inside, found.expected) == (0.0, share)
        assert f" % | {told} |" in comparison_text(found)


def test_the_same_run_twice_reaches_the_goal() -> None:
    found = summarize(Measurements.of(rows(SMS, "rate", [7.1234567, 7.2, 7.3])))
    assert compare(found, found).reaches_goal
    assert not compare([], []).reaches_goal


@pytest.mark.slow
def test_constant_metrics_are_counted_apart() -> None:
    """Losses of 0 lie in an interval from 0 to 0, whatever the machines do."""
    first, second = (
        summarize(
            Measurements.of(
                [
                    *rows(SMS, "rate", rates),
                    *rows(SMS, "lost", [0.0, 0.0, 0.0]),
                    *rows(SMS, "topics", [topics] * 3),
                ]
            )
        )
        for rates, topics in (([7.0, 7.5, 8.0], 5.0), ([8.9, 9.0, 9.1], 7.0))
    )
    found = compare(first, second)
    assert (len(found.pairs), len(found.constant), found.same, found.inside) == (1, 2, 1, 0.0)
    assert [pair.first.metric for pair in found.outside] == ["topics", "rate"]
    assert found.by_chance.estimate == pytest.approx(0.6, abs=0.03)  # 3 of 5 orders of six values
    text = comparison_text(found)
    assert found.inside_of_all == pytest.approx(1 / 3)
    assert "Of all 3 medians of the second run, 33 % lie in the intervals" in text
    assert "2 of them are of metrics that had one value only in each run, such as losses of 0: 1 of" in text
    constant = compare(first[:1], first[:1])
    assert (constant.pairs, constant.same, constant.reaches_goal) == ((), 1, True)
    assert "| laser | 0 | - | - | - | - | - | - | 1 of 1 |" in comparison_text(constant)


@pytest.mark.parametrize(
    ("again", "is_inside"), [(250_449_000.0, True), (250_501_000.0, False), (249_499_000.0, False)]
)
def test_digits_that_the_page_does_not_show_do_not_count(again: float, *, is_inside: bool) -> None:
    """An interval from 250.1 to 250.4 MB is shown as [250, 250]."""
    first, second = (
        summarize(Measurements.of(rows(SMS, "client.memory", values, unit="B")))
        for values in ([250_100_000.0, 250_200_000.0, 250_400_000.0], [1.0, again, 1e9])
    )
    found = compare(first, second)
    assert (found.inside, found.exactly_inside) == (float(is_inside), 0.0)
    assert len(found.outside) == (not is_inside)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1234.5, "1234"), (12.345, "12.3"), (1.0, "1.00"), (0.012345, "0.0123"), (-2.5, "-2.50")],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_units_fit_the_values() -> None:
    assert scale_for("s", [0.002, 0.004, 3.0]) == ("ms", 1e-3)
    assert scale_for("B/s", [2e6]) == ("MB/s", 1e6)
    assert scale_for("share", [0.1]) == ("%", 0.01)
    assert scale_for("s", [0.0]) == ("µs", 1e-6)
    assert scale_for("Hz", [1e9]) == ("Hz", 1.0)


def test_numbers_in_texts_are_sorted_by_value() -> None:
    assert sorted(["1920x1080", "160x120", "640x480"], key=natural) == ["160x120", "640x480", "1920x1080"]
    assert sorted(["full", "10", "9"], key=natural) == ["9", "10", "full"]
    assert sorted(["2", "0.5", "0.25"], key=natural) == ["0.25", "0.5", "2"]
