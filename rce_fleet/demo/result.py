"""The report of a headless run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rce_fleet.demo.config import Mode
from rce_fleet.demo.counters import Counters
from rce_fleet.demo.mission import Mission
from rce_fleet.drivers.report import WorldReport
from rce_fleet.planning.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Result:
    """What a headless run came to.

    Attributes:
        scenario: What was driven.
        seed: What it was drawn from.
        mission: How it went.
        truth: What happened in the world until its end; None if it never said.
        counters: What was carried; None if nobody says.
        problem: Why the run was ended early; empty if it was not.
        mode: What carried the fleet's messages.
    """

    scenario: Scenario
    seed: int
    mission: Mission | None
    truth: WorldReport | None
    counters: Counters | None
    problem: str = ""
    mode: Mode = Mode.CLOUD

    @property
    def ok(self) -> bool:
        """Whether every robot reached its goal and nothing touched anything."""
        return not self.faults

    @property
    def faults(self) -> list[str]:
        """Why not, for people."""
        faults = [self.problem] if self.problem else []
        reached = self.mission.reached if self.mission is not None else set()
        missing = [robot for robot in self.scenario.robots if robot not in reached]
        if missing:
            faults.append(f"not at their goals: {', '.join(missing)}")
        if self.truth is None:
            faults.append("the world did not say what happened")
        elif self.truth.collisions.total:
            faults.append(f"robots touched something {self.truth.collisions.total} times")
        return faults

    def as_json(self) -> dict[str, Any]:
        """The report."""
        truth, mission, counters = self.truth, self.mission, self.counters
        scenario = self.scenario
        blocked = [] if mission is None else mission.block.done
        distances = {} if truth is None else {robot.id: robot.distance_m for robot in truth.robots}
        return {
            "ok": self.ok,
            "mode": self.mode.value,
            "duration_s": 0.0 if mission is None else round(mission.duration, 2),
            "collisions": None if truth is None else truth.collisions.total,
            "min_separation_m": None if truth is None else truth.min_separation_m,
            "robots": [
                {
                    "id": robot,
                    "start_cell": start,
                    "goal_cell": goal,
                    "reached": mission is not None and robot in mission.reached,
                    "replans": 0 if mission is None else mission.replans[robot],
                    "distance_m": distances.get(robot, 0.0),
                }
                for robot, start, goal in zip(scenario.robots, scenario.starts, scenario.goals, strict=True)
            ],
            "engine": {
                "messages": None if counters is None else counters.messages,
                "dropped": None if counters is None else counters.dropped,
            },
            "blocked_cell": blocked[0] if blocked else None,
            "blocked_cells": blocked,
            "seed": self.seed,
            "faults": self.faults,
        }

    def write(self, path: Path) -> None:
        """Write the report."""
        path.write_text(json.dumps(self.as_json(), indent=2) + "\n", encoding="utf-8")
