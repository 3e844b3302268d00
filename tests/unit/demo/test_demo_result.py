"""The report of a headless run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support.fleet_states import truth

from rce_fleet.demo.counters import Counters
from rce_fleet.demo.floor import draw
from rce_fleet.demo.mission import Mission
from rce_fleet.demo.result import Result

SCENARIO = draw(2, 0)
ROBOTS = dict(zip(SCENARIO.robots, SCENARIO.goals, strict=True))


def result(reached: set[str], problem: str = "", **world: Any) -> Result:
    unused: Any = None
    mission = Mission(unused, SCENARIO, lambda: None, lambda _: None)
    mission.reached = reached
    return Result(SCENARIO, 0, mission, truth(apart=0.5, **ROBOTS, **world), Counters(10, 1), problem)


def test_a_good_run() -> None:
    report = result(set(ROBOTS)).as_json()
    assert report["ok"] is True
    assert report["collisions"] == 0
    assert report["min_separation_m"] == 0.5
    assert report["engine"] == {"messages": 10, "dropped": 1}
    assert report["robots"] == [
        {
            "id": robot,
            "start_cell": start,
            "goal_cell": goal,
            "reached": True,
            "replans": 0,
            "distance_m": 1.0,
        }
        for robot, start, goal in zip(SCENARIO.robots, SCENARIO.starts, SCENARIO.goals, strict=True)
    ]


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (result({"Robot1"}), "not at their goals: Robot2"),
        (result(set(ROBOTS), collisions=2), "touched something 2 times"),
        (result(set(ROBOTS), problem="the time is over"), "the time is over"),
        (Result(SCENARIO, 0, None, None, None, "no engine"), "no engine"),
    ],
)
def test_a_bad_run_says_why(bad: Result, words: str, tmp_path: Path) -> None:
    assert not bad.ok
    bad.write(tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["ok"] is False
    assert any(words in fault for fault in report["faults"])
    assert report.keys() >= {"duration_s", "collisions", "min_separation_m", "robots", "engine"}
