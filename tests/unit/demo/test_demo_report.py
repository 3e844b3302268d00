"""The report of a headless run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support.fleet_states import truth

from rce_fleet.demo.headless import RunReport
from rce_fleet.demo.judge import RobotScore
from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.demo.scenario_run import ScenarioRun
from rce_fleet.demo.traffic import MessageTotals

SCENARIO = choose_scenario(2, 0)
ROBOTS = dict(zip(SCENARIO.robots, SCENARIO.goals, strict=True))


def make_report(reached: set[str], problem: str = "", collisions: int = 0) -> RunReport:
    unused: Any = None
    run = ScenarioRun(unused, SCENARIO, lambda: None, lambda _: None)
    run.reached = reached
    for second in (1.0, 3.0):
        run.speed.look(truth({}).model_copy(update={"time_s": 0.75 * second}), second)
    score = RobotScore()
    for error in (0.01, 0.07):
        score.compare(error)
    for reported in (1, 1, 2):
        score.count_recoveries(reported)
    seen = truth(ROBOTS, apart=0.5, collisions=collisions)
    totals = MessageTotals(10, 1)
    return RunReport(SCENARIO, 0, run, seen, totals, problem, scores={"Robot1": score})


def test_recoveries_count_on_after_a_restart_of_move_base() -> None:
    score = RobotScore()
    for reported in (0, 2, 2, 1, 1, 3):
        score.count_recoveries(reported)
    assert score.recoveries == 5


def test_report_of_a_good_run() -> None:
    report = make_report(set(ROBOTS)).as_json()
    assert report["ok"] is True
    assert report["collisions"] == 0
    assert report["min_separation_m"] == 0.5
    assert report["real_time_factor"] == 0.75
    assert report["engine"] == {"messages": 10, "dropped": 1}
    assert report["robots"] == [
        {
            "id": robot,
            "start_cell": start,
            "goal_cell": goal,
            "reached": True,
            "replans": 0,
            "distance_m": 1.0,
            "localization_rmse_m": 0.05 if robot == "Robot1" else None,
            "localization_max_m": 0.07 if robot == "Robot1" else None,
            "recoveries": 2 if robot == "Robot1" else 0,
        }
        for robot, start, goal in zip(SCENARIO.robots, SCENARIO.starts, SCENARIO.goals, strict=True)
    ]


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (make_report({"Robot1"}), "not at their goals: Robot2 (the planner does not know it)"),
        (make_report(set(ROBOTS), collisions=2), "robots collided 2 times"),
        (make_report(set(ROBOTS), problem="the time is over"), "the time is over"),
        (RunReport(SCENARIO, 0, None, None, None, "no engine"), "no engine"),
    ],
)
def test_report_of_a_bad_run_names_the_faults(bad: RunReport, words: str, tmp_path: Path) -> None:
    assert not bad.ok
    bad.write(tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["ok"] is False
    assert any(words in fault for fault in report["faults"])
    assert report.keys() >= {"duration_s", "collisions", "min_separation_m", "robots", "engine"}
