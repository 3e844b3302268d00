"""The page of the experiments: each of its numbers is computed again from the rows."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pytest
from support.experiment_page import (
    CELL,
    UNITS,
    case_of_figures,
    cells_of_cases,
    cells_of_experiments,
    cells_of_verdicts,
    condition_of_case,
    experiments_of_claims,
    tables_of,
)
from support.experiment_rows import CRS, SMS, example_rows, in_three_systems, rows_of

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.report import drawing, make_report
from rce_fleet.experiments.report.measurements import Measurements
from rce_fleet.experiments.report.page import OtherRun, page_text
from rce_fleet.experiments.report.schematics import schematics
from rce_fleet.experiments.report.sections import SECTIONS
from rce_fleet.experiments.report.summary import summarize
from rce_fleet.experiments.results import Condition, Row, write_rows
from rce_fleet.experiments.statistics import effect_size, estimate

pytestmark = pytest.mark.slow
"""They need what draws, which takes long to load."""

_NAMES = re.compile(r"`[^`]*`|\w+=[\w.]+|[Mm]achine \d|within 25 %|by more than 5 %|of [\d.]+ Hz|for 1 s at")
"""Numbers of a reason that are not measured: in names and in what a claim says."""
WIDE = (0.9, 0.95, 1.0, 1.02, 1.1)


def values_of(rows: Sequence[Row], condition: Condition, formula: str) -> list[float]:
    """Compute a column of the page from the rows, run by run."""
    runs: dict[int, dict[str, float]] = defaultdict(dict)
    for row in rows:
        if row.condition == condition:
            runs[row.run][row.metric] = row.value
    first, operator, second = [*formula.split(), "", ""][:3]
    if not operator:
        return [metrics[first] for metrics in runs.values() if first in metrics]
    both = [(one[first], one[second]) for one in runs.values() if {first, second} <= one.keys()]
    return [a + b if operator == "+" else a / b for a, b in both]


def check_cell(text: str, values: Sequence[float], unit: str) -> None:
    """Compare a median and its interval, both with three digits, with the values."""
    if text == "-":
        assert not values
        return
    found = CELL.fullmatch(text)
    assert found, text
    again, factor = estimate(values), UNITS.get(unit, 1.0)
    numbers = (again.median, again.low, again.high)
    shown = [float(number) for number in found.groups()[:3] if number]
    assert shown == [pytest.approx(number / factor, rel=0.006) for number in numbers[: len(shown)]]
    assert found[4] is None or int(found[4]) == again.runs


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    extra = Condition.of("weather", CRS, "rce", sky="blue")
    found = example_rows(spread=WIDE) + rows_of(extra, {"rain": (3.0, "mm")}, WIDE)
    return found + rows_of(Condition.of("laser", SMS, "ros", printed="no"), {"surprise": (1.0, "Hz")}, WIDE)


@pytest.fixture(scope="module")
def page(rows: list[Row]) -> str:
    return page_text(Measurements.of(rows), {"value": {"cores": 2}}, {}, "images")


def test_each_number_of_the_experiments_is_that_of_its_rows(page: str, rows: list[Row]) -> None:
    cells = 0
    for cell in cells_of_experiments(page):
        values = values_of(rows, cell.condition, cell.quantity)
        check_cell(cell.text, values, cell.unit)
        assert not values or len(values) == int(cell.runs)
        cells += 1
    assert cells > 500


def check_effects(text: str, experiment: str, line: dict[str, str], case: str, rows: list[Row]) -> int:
    """Compare each Cliff's delta with that of the rows, and return their number."""
    found = re.findall(r"(?:`([^`]+)`: )?(\w+):(\w+) ([-+]\d\.\d\d)", text)
    formula = line.get("quantity", "").strip("`") or re.findall(r"`([^`]+)`", line.get("figures", ""))[0]
    for named, one, other, shown in found:
        formula = named or formula
        one_values, other_values = (
            values_of(rows, condition_of_case(experiment, line["software"], case, system), formula)
            for system in (one, other)
        )
        assert float(shown) == pytest.approx(effect_size(one_values, other_values), abs=0.006)
    return len(found)


def test_each_number_of_the_cases_is_that_of_its_rows(page: str, rows: list[Row]) -> None:
    cells = effects = 0
    for cell in cells_of_cases(page):
        check_cell(cell.text, values_of(rows, cell.condition, cell.quantity), cell.unit)
        cells += 1
    for table in tables_of(page):
        if "case" in table.head:
            (experiment,) = re.findall(r"experiment `([^`]+)`", table.about)
            effects += sum(
                check_effects(line["Cliff's delta"], experiment, line, line["case"], rows)
                for line in table.rows
            )
    assert cells > 300
    assert effects > 100


def test_each_number_of_the_verdicts_is_that_of_its_rows(page: str, rows: list[Row]) -> None:
    checked = 0
    for cell in cells_of_verdicts(page):
        check_cell(cell.text, values_of(rows, cell.condition, cell.quantity), cell.unit)
        checked += 1
    (table,) = (table for table in tables_of(page) if "verdict" in table.head)
    experiments = experiments_of_claims(page)
    for line in table.rows:
        _, case = case_of_figures(line["figures"])
        check_effects(line["Cliff's delta"], experiments[line["claim"][1]], line, case, rows)
    assert checked > 50


def test_each_number_of_the_reasons_is_in_the_cases(page: str) -> None:
    """Medians, how many times one is the other, and how many cases there are; nothing else."""
    medians: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    cases: dict[tuple[str, str], set[str]] = defaultdict(set)
    for table in tables_of(page):
        if "case" in table.head:
            letter = re.findall(r"\((\w)\)", table.about)[0]
            for line in table.rows:
                key = (letter, line["software"])
                cases[key].add(line["case"])
                texts = (line[system] for system in ("SMS", "MMS", "CRS") if line[system] != "-")
                factor = UNITS.get(line["unit"], 1.0)
                medians[key][line["quantity"]] += [float(text.split()[0]) * factor for text in texts]
    (verdicts,) = (table for table in tables_of(page) if "verdict" in table.head)
    for line in verdicts.rows:
        key = (line["claim"][1], line["software"])
        known = [one for found in medians[key].values() for one in found]
        ratios = [a / b for found in medians[key].values() for a in found for b in found if b]
        text = _NAMES.sub("", line["reason"])
        for shown in map(float, re.findall(r"(?<![\w.])\d+(?:\.\d+)?", text)):
            scaled = [one / factor for one in known for factor in (1.0, *UNITS.values())]
            near = any(shown == pytest.approx(one, rel=0.012) for one in [*scaled, *ratios])
            assert near or (shown.is_integer() and shown <= len(cases[key])), (shown, line["reason"])


def test_unknown_experiments_and_metrics_are_listed(page: str) -> None:
    assert "| weather | CRS | RCE | sky=blue | `rain` | 3.00 [2.70, 3.30] | mm | 5 |" in page
    assert "| laser | SMS | ROS | printed=no | `surprise` | 1.00 [0.900, 1.10] | Hz | 5 |" in page


def test_page_without_rows_says_so() -> None:
    text = page_text(Measurements.of([]), {}, {}, "images")
    for section in SECTIONS:
        assert (
            f"## {section.title}\n\nExperiment `{section.experiment}`. {section.text}\n\nNot measured.\n"
            in text
        )
    assert text.count("| **not measured** |") == 18
    assert "There is no `environment.json` beside the raw data." in text
    assert "## Other data\n\nNone.\n\n## Another full run\n\nNot measured." in text


def test_values_that_are_not_finite_are_told() -> None:
    bad = in_three_systems("laser", "rate", "Hz", (float("inf"), 1.0, 1.0))
    again = [Row(bad[0].condition, 1, "tries", 2.0, ""), Row(bad[0].condition, 1, "done", 60.0, "s")]
    text = page_text(Measurements.of([*bad, *again]), {}, {}, "images")
    assert "3 values are not finite and were left out: `rate` of `laser`." in text
    assert "Runs that were tried more than once (`tries`): 1." in text
    assert "`done`" not in text


def test_break_even_is_the_lowest_rate_at_which_the_cloud_is_faster() -> None:
    found = [
        row
        for place, times in (("robot", (4.0, 4.0, 4.0)), ("cloud", (9.0, 3.0, 1.0)))
        for rate, seconds in zip((1, 2, 10), times, strict=True)
        for row in rows_of(
            Condition.of("offload", CRS, "rce", place=place, task="amcl", rate=rate, delay=5),
            {"task_time": (seconds, "s")},
        )
    ]
    assert "| CRS | RCE | amcl | 5 | 2 |" in page_text(Measurements.of(found), {}, {}, "images")
    slow = [row for row in found if dict(row.condition.factors)["rate"] == "1"]
    assert "| amcl | 5 | at none that was measured |" in page_text(Measurements.of(slow), {}, {}, "images")
    few = [row for row in found if row.run < 3]
    assert "| amcl | 5 | not judged: fewer than 3 runs |" in page_text(Measurements.of(few), {}, {}, "images")
    half = [row for row in found if row.run < 3 or dict(row.condition.factors)["rate"] == "10"]
    assert "| amcl | 5 | 10 |" in page_text(Measurements.of(half), {}, {}, "images")


@pytest.mark.parametrize(
    ("metrics", "expected"),
    [
        ({}, "| - | nothing up to 20 |"),
        ({"rate": 20.0, "received": 20.0}, "| 20 | robots publish less (`rate`) |"),
        (
            {"received": 20.0},
            "| 20 | messages arrive more slowly than they are published (`received`, `rate`) |",
        ),
        (
            {"lost": 0.02, "delay_p95": 0.2},
            "| 20 | messages are lost (`lost`); messages come late (`delay_p95`) |",
        ),
        ({"delay_p95": 0.05}, "| - | nothing up to 20 |"),
    ],
)
def test_what_breaks_first_is_told(metrics: dict[str, float], expected: str) -> None:
    works = {"rate": 30.0, "received": 30.0, "lost": 0.0, "delay_p95": 0.01}
    units = {"rate": "Hz", "received": "Hz", "lost": "", "delay_p95": "s"}
    found = [
        row
        for robots, values in ((1, works), (3, works), (20, {**works, **metrics}))
        for row in rows_of(
            Condition.of("scaling", CRS, "ros", robots=robots, containers="one"),
            {metric: (value, units[metric]) for metric, value in values.items()},
        )
    ]
    text = page_text(Measurements.of(found), {}, {}, "images")
    assert f"| CRS | ROS | containers=one {expected}" in text


def test_second_run_is_compared(rows: list[Row]) -> None:
    changed = [
        Row(one.condition, one.run, one.metric, one.value * 2, one.unit)
        for one in rows
        if one.metric == "rain"
    ]
    same = [row for row in rows if row.metric != "rain"]
    again = summarize(Measurements.of([*same, *changed]))
    text = page_text(Measurements.of(rows), {}, {}, "images", OtherRun(again, {}))
    assert "| weather | 1 | 0 % | 0 % | 83 % | 0 % |" in text
    both = "3.00 [2.70, 3.30] | 6.00 [5.40, 6.60]"
    assert f"| weather | CRS | RCE | sky=blue | `rain` | {both} | mm | +100.0 % | unlikely |" in text
    assert "the goal of 90 % is reached" in text


def test_speed_of_the_computer_is_told_and_not_counted(rows: list[Row]) -> None:
    """It explains why processor times differ; as a median that differs it would count twice."""
    slower = [replace(one, value=1.2 * one.value) if one.metric == "work" else one for one in rows]
    again = OtherRun(summarize(Measurements.of(slower)), {})
    text = page_text(Measurements.of(rows), {}, {}, "images", again)
    assert "the same work in 50.0 ms of processor time in the first run and in 60.0 ms in the second" in text
    assert "(+20.0 %; medians of the rounds)" in text
    assert "100 % lie in the intervals of the first one" in text
    former = OtherRun([one for one in again.summary if one.metric != "work"], {})
    assert "same work" not in page_text(Measurements.of(rows), {}, {}, "images", former)


@pytest.mark.parametrize(("name", "tells"), [("python", True), ("versions", True), ("started", False)])
def test_runs_with_other_software_are_not_the_same_set_up(rows: list[Row], name: str, *, tells: bool) -> None:
    again = OtherRun(summarize(Measurements.of(rows)), {"value": {name: "3.11.2"}})
    text = page_text(Measurements.of(rows), {"value": {name: "3.11.7"}}, {}, "images", again)
    assert f"| {name} | 3.11.7 | 3.11.2 |" in text
    assert (f"The two runs were not made with the same `{name}`: " in text) is tells


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "raw"
    folder.mkdir()
    few = [
        row for row in example_rows(["ros"]) if row.condition.experiment in {"robustness", "link", "machine"}
    ]
    write_rows(folder / "results.csv", few)
    about = {
        "cores": 2,
        "memory_bytes": 4_000_000_000,
        "versions": {"rce": "0.1.0"},
        "options": {"quick": False},
    }
    (folder / "environment.json").write_text(json.dumps(about))
    return folder


@pytest.fixture(scope="module")
def fonts(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Matplotlib keeps the files of its fonts open: after this, a test opens none."""
    pytest.importorskip("matplotlib", reason="figures need rce[figures]")
    drawing.save(schematics()[0], tmp_path_factory.mktemp("fonts"))


@pytest.mark.usefixtures("fonts")
def test_report_is_page_figures_and_summary(folder: Path, tmp_path: Path) -> None:
    page, figures = tmp_path / "docs" / "page.md", tmp_path / "docs" / "images" / "experiments"
    make_report([folder], page=page, figures=figures, second=[folder])
    text = page.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert "images/experiments/robustness-ros.png" in links
    assert len(links) == 2 + 2 * 4, "two summaries, three set-ups and a figure, each as PNG and SVG"
    assert all((page.parent / link).stat().st_size for link in links)
    assert "| memory_bytes | 4.00 GB |" in text
    assert "| options | quick no |" in text
    make_report([folder], page=page, figures=figures, second=[figures / "summary.csv"])
    assert page.read_text(encoding="utf-8") == text, "the summary is enough to compare with a run"
    kept = figures / "second"
    assert (kept / "summary.csv").read_bytes() == (figures / "summary.csv").read_bytes()
    make_report([folder], page=page, figures=figures, second=[kept / "summary.csv"])
    assert page.read_text(encoding="utf-8") == text, "and it is kept"
    assert "what differs" not in page.read_text()
    (figures / "environments.json").write_text('{"value": {"cores": 4}}')
    make_report([folder], page=page, figures=figures, second=[figures / "summary.csv"])
    assert "| what differs | first run | second run |\n| --- | --- | --- |\n| cores | " in page.read_text()
    (figures / "environments.json").write_text('{"value": 4}')
    with pytest.raises(ExperimentError, match=r"environments\.json is not what a page kept"):
        make_report([folder], page=page, figures=figures, second=[figures / "summary.csv"])


def test_page_without_matplotlib_says_what_to_install(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "can_draw", lambda: False)
    make_report([folder], page=tmp_path / "page.md", figures=tmp_path / "figures")
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "Figures are missing: matplotlib is not installed: pip install 'rce[figures]'." in text
    assert "| SMS | ROS | core_killed | 100 [99.0, 101] |" in text
    assert [path.name for path in (tmp_path / "figures").iterdir() if path.suffix != ".json"] == [
        "summary.csv"
    ]


def test_a_second_run_in_parts_is_not_described_by_its_last_part(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "can_draw", lambda: False)
    kept = []
    for cores in (2, 64):
        figures = tmp_path / f"{cores}"
        make_report([folder], page=tmp_path / "part.md", figures=figures)
        (figures / "environments.json").write_text(json.dumps({"value": {"cores": cores}}))
        kept.append(figures / "summary.csv")
    page = tmp_path / "page.md"
    make_report([folder], page=page, figures=tmp_path / "figures", second=kept)
    assert "| cores | 2 | 2; 64 |" in page.read_text(encoding="utf-8")
    make_report([folder], page=page, figures=tmp_path / "figures", second=kept[1:])
    assert "| cores | 2 | 64 |" in page.read_text(encoding="utf-8")


def test_links_of_a_page_with_spaces_lead_to_its_figures(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "can_draw", lambda: False)
    page = tmp_path / "run 2 (at home).md"
    make_report([folder], page=page, figures=page.with_suffix(""))
    (link,) = re.findall(r"\[summary\.csv\]\(([^\s()]+)\)", page.read_text(encoding="utf-8"))
    assert (tmp_path / unquote(link)).is_file()


@pytest.mark.parametrize("text", ["{", "[]"])
def test_broken_environment_is_named(folder: Path, tmp_path: Path, text: str) -> None:
    (folder / "environment.json").write_text(text)
    with pytest.raises(ExperimentError, match=r"environment\.json"):
        make_report([folder], page=tmp_path / "page.md", figures=tmp_path / "figures")


def test_page_of_several_folders_has_each_experiment_with_its_circumstances(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "can_draw", lambda: False)
    other = tmp_path / "other"
    other.mkdir()
    kept = {"laser", "images", "link", "machine"}
    write_rows(
        other / "results.csv", [one for one in example_rows(["ros"]) if one.condition.experiment in kept]
    )
    (other / "environment.json").write_text(json.dumps({"cores": 8, "commit": "abc"}))
    page = tmp_path / "page.md"
    make_report([folder, other], page=page, figures=tmp_path / "page", second=[other])
    text = page.read_text(encoding="utf-8")
    tables = list(tables_of(text))
    (about,) = (one for one in tables if "what" in one.head)
    assert about.head == ["what", "robustness", "laser, images"]
    assert {"what": "cores", "robustness": "2", "laser, images": "8"} in about.rows
    assert {"what": "commit", "robustness": "-", "laser, images": "abc"} in about.rows
    for section in SECTIONS:
        measured = section.experiment in {"robustness", "laser", "images"}
        assert (f"{section.text}\n\nNot measured." in text) is not measured
    for what in ("link", "machine"):
        (table,) = (one for one in tables if f"(experiment `{what}`)" in one.about)
        assert table.rows[0]["runs"] == "6", "three of each folder"


def test_page_has_the_software_of_each_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "can_draw", lambda: False)
    folders = [tmp_path / "first", tmp_path / "further"]
    for folder, software in zip(folders, (["ros", "rce"], ["roscpp"]), strict=True):
        folder.mkdir()
        kept = [one for one in example_rows(software) if one.condition.experiment in {"laser", "link"}]
        write_rows(folder / "results.csv", kept)
        (folder / "environment.json").write_text(json.dumps({"commit": software[0]}))
    page = tmp_path / "page.md"
    make_report(folders, page=page, figures=tmp_path / "page")
    tables = list(tables_of(page.read_text(encoding="utf-8")))
    (about,) = (one for one in tables if "what" in one.head)
    assert about.head == ["what", "laser (ros, rce)", "laser (roscpp)"]
    assert about.rows == [{"what": "commit", "laser (ros, rce)": "ros", "laser (roscpp)": "roscpp"}]
    found = {row["software"] for one in tables if "software" in one.head for row in one.rows}
    assert {"ROS", "ROS C++", "RCE"} <= found


def test_folders_with_the_same_experiment_are_refused(folder: Path, tmp_path: Path) -> None:
    same = r"the experiment robustness with the software \w+ is in .*raw and in .*raw; "
    with pytest.raises(ExperimentError, match=same):
        make_report([folder, folder], page=tmp_path / "page.md", figures=tmp_path / "figures")
    assert not (tmp_path / "page.md").exists()
