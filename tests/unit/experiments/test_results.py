"""The table of raw data, and the order of runs."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.results import Condition, Row, by_condition, read_rows, write_rows
from rce_fleet.experiments.schedule import WARM_UP, Run, remaining, schedule

SMS = Condition.of("laser", "SMS", "ros", robots=5, printed="yes")
CRS = Condition.of("laser", "CRS", "rce", printed="yes", robots=5)


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    rows = [Row(SMS, 1, "network", 1.5e6, "B/s"), Row(CRS, 1, "network", 0.1 + 0.2, "B/s")]
    write_rows(tmp_path / "raw.csv", rows[:1])
    write_rows(tmp_path / "raw.csv", rows[1:])
    assert read_rows(tmp_path / "raw.csv") == rows
    assert (tmp_path / "raw.csv").read_text().splitlines()[:2] == [
        "experiment,system,software,factors,run,metric,value,unit",
        "laser,SMS,ros,printed=yes;robots=5,1,network,1500000.0,B/s",
    ]


def test_rows_outlive_a_loss_of_power(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A resumed run replaces the table by a new file, which some file systems would leave empty."""
    path, kept = tmp_path / "raw.csv", list[tuple[int, int]]()
    really = os.fsync

    def fsync(descriptor: int) -> None:
        really(descriptor)
        found = os.fstat(descriptor)
        kept.append((found.st_ino, found.st_size))

    monkeypatch.setattr(os, "fsync", fsync)
    write_rows(path, [Row(SMS, 1, "network", 1.0, "B/s")])
    found = path.stat()
    assert kept == [(found.st_ino, found.st_size)]


def test_an_interrupted_line_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "raw.csv"
    write_rows(path, [Row(SMS, 1, "network", 1.0, "B/s")])
    with path.open("a") as file:
        file.write("laser,SMS,ros,,2,netw")
    assert len(read_rows(path)) == 1


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "has no columns experiment"),
        ("a,b\n", "has no columns experiment"),
        ("experiment,system,software,factors,run,metric,value,unit\nlaser,SMS\n", ":2: not enough values"),
        ("experiment,system,software,factors,run,metric,value,unit\na,b,c,,x,m,1,s\n", ":2: invalid literal"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / "raw.csv"
    path.write_text(text)
    with pytest.raises(ExperimentError, match=error):
        read_rows(path)


HEAD = b"experiment,system,software,factors,run,metric,value,unit\n"
ROW = b"laser,SMS,ros,,1,rate,7.5,Hz\n"


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (HEAD + ROW + ROW.replace(b"Hz", b"\xb5s"), "is not UTF-8"),
        (HEAD + b'"' + ROW * 10_000, "field larger than field limit"),
    ],
    ids=["saved-in-latin-1", "quotation-mark"],
)
def test_a_table_that_was_edited_is_named(tmp_path: Path, data: bytes, error: str) -> None:
    path = tmp_path / "raw.csv"
    path.write_bytes(data)
    with pytest.raises(ExperimentError, match=f"raw.csv.*{error}"):
        read_rows(path)


def test_the_mark_and_the_ends_of_lines_of_spreadsheets_are_read(tmp_path: Path) -> None:
    path = tmp_path / "raw.csv"
    path.write_bytes(b"\xef\xbb\xbf" + (HEAD + ROW).replace(b"\n", b"\r\n"))
    assert [row.value for row in read_rows(path)] == [7.5]


def test_factors_must_not_contain_separators(tmp_path: Path) -> None:
    row = Row(Condition.of("laser", "SMS", "ros", path="a;b"), 1, "network", 1.0, "B/s")
    with pytest.raises(ExperimentError, match="'path' = 'a;b'"):
        write_rows(tmp_path / "raw.csv", [row])


def test_values_are_grouped_in_the_order_of_runs() -> None:
    rows = [Row(SMS, 2, "cpu", 0.2, ""), Row(SMS, 1, "cpu", 0.1, ""), Row(CRS, 1, "network", 3.0, "B/s")]
    assert by_condition(rows, "cpu") == {SMS: [0.1, 0.2]}


def test_each_round_has_each_setting_once_in_random_order() -> None:
    conditions = [Condition.of("laser", name, "ros") for name in "abcdef"]
    runs = schedule(conditions, 10, seed=1)
    assert Counter(runs) == Counter(
        Run(condition, number) for condition in conditions for number in range(11)
    )
    rounds = [[run.condition for run in runs[6 * number : 6 * number + 6]] for number in range(11)]
    assert all(sorted(each) == conditions for each in rounds)
    assert len({tuple(each) for each in rounds}) > 5
    assert runs == schedule(conditions, 10, seed=1) != schedule(conditions, 10, seed=2)


def test_a_resumed_experiment_warms_up_only_what_is_open() -> None:
    planned = schedule([SMS, CRS], 2, seed=1)
    done = [Run(SMS, 1), Run(SMS, 2), Run(CRS, 2)]
    assert sorted(remaining(planned, done)) == sorted([Run(CRS, WARM_UP), Run(CRS, 1)])
    assert remaining(planned, planned) == []
