"""Streams of tasks: what counts as a standstill, as a lost task and as a fault; who shares a container."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import pytest
from support.fleet_states import truth

from rce.config.client import loads
from rce.config.documents import write_items
from rce_fleet.demo import goal_tasks
from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.goal_tasks import GoalTasks
from rce_fleet.demo.headless import RunReport
from rce_fleet.demo.resources import Ports
from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.demo.standstill import Standstill
from rce_fleet.demo.task_run import TaskRun
from rce_fleet.demo.worlds import find_world
from rce_fleet.drivers.report import RobotTruth
from rce_fleet.drivers.scene import load_scene
from rce_fleet.geometry.poses import Pose
from rce_fleet.station.api import FleetModel, RobotModel
from rce_fleet.wiring import fleet_config, light_config


def at(time_s: float, *places: tuple[float, float]) -> Any:
    """Return a report of the world with robots at these places."""
    robots = [
        RobotTruth(id=f"Robot{number}", cell=0, x=x, y=y, yaw=0.0, distance_m=0.0)
        for number, (x, y) in enumerate(places, start=1)
    ]
    return truth({}, apart=1.0).model_copy(update={"time_s": time_s, "robots": robots})


def test_only_robots_with_tasks_stand_still() -> None:
    still = Standstill()
    still.update(at(0.0, (0, 0), (5, 5)), {"Robot1"})
    still.update(at(40.0, (0.05, 0), (5, 5)), {"Robot1"})
    assert (still.longest, still.robot) == (40.0, "Robot1")
    still.update(at(50.0, (0.5, 0), (5, 5)), {"Robot1", "Robot2"})
    still.update(at(80.0, (0.5, 0), (5, 5)), {"Robot2"})
    still.update(at(95.0, (0.5, 0), (5, 5)), {"Robot1", "Robot2"})
    assert (still.longest, still.robot) == (55.0, "Robot2")


@dataclass
class Station:
    """Takes goals as the station does."""

    goals: dict[str, int] = field(default_factory=dict)

    async def set_goal(self, robot: str, cell: int) -> None:
        self.goals[robot] = cell


def fleet(**robots: tuple[str, int, int | None]) -> FleetModel:
    """Return a fleet: state, cell and goal of each robot."""
    models = [
        RobotModel(
            id=name, state=state, reason="", cell=cell, goal=goal, plan=[], granted=[], replans=0, pose=None
        )
        for name, (state, cell, goal) in robots.items()
    ]
    return FleetModel(map=None, robots=models, blocked=[], pending=[])


async def test_goals_are_tasks_that_are_done_or_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    station: Any = Station()
    tasks = GoalTasks(station, [10, 11], Random(1))
    await tasks.update(fleet(Robot1=("idle", 1, None), Robot2=("idle", 2, None)), more=True)
    assert set(station.goals.values()) == {10, 11}
    assert (tasks.accepted, tasks.open, set(tasks.busy)) == (2, 2, {"Robot1", "Robot2"})
    first, second = station.goals["Robot1"], station.goals["Robot2"]
    await tasks.update(fleet(Robot1=("arrived", first, first), Robot2=("driving", 5, second)), more=False)
    assert (tasks.done, tasks.open, tasks.lost) == (1, 1, [])
    await tasks.update(fleet(Robot2=("idle", 5, None)), more=False)
    assert tasks.open == 1
    monkeypatch.setattr(goal_tasks, "LOST_AFTER", 0.0)
    await tasks.update(fleet(Robot2=("idle", 5, None)), more=False)
    assert (tasks.open, tasks.lost) == (0, [f"Robot2 to cell {second}"])


def test_faults_of_a_stream_are_in_the_report() -> None:
    unused: Any = None
    stream: Any = GoalTasks(unused, [], Random(1))
    run = TaskRun(unused, 2, stream, 10.0, lambda: None, lambda: None, lambda _: None)
    scenario = choose_scenario(2, 0)
    report = RunReport(scenario, 0, None, truth({}, apart=0.5), None, tasks=run)
    assert report.faults == ["no task was done", "the planner's container was killed 0 times, not 2"]
    stream.accepted, stream.done, run.planner_kills = 3, 2, 2
    assert report.ok
    run.standstill.longest, run.standstill.robot = 61.0, "Robot2"
    stream.lost = ["Robot1 to cell 3"]
    stream.failed = ["T7 is failed (no path)"]
    assert report.faults == [
        "1 tasks were lost: Robot1 to cell 3",
        "1 tasks failed: T7 is failed (no path)",
        "Robot2 stood still for 61 s with a task",
    ]
    made = json.loads(json.dumps(report.as_json()))
    assert made["ok"] is False
    assert (made["tasks_done"], made["tasks_lost"], made["planner_kills"]) == (2, 1, 2)
    assert (made["longest_standstill_s"], made["real_time_factor"]) == (61.0, 0.0)
    assert "goal_cell" not in made["robots"][0]


def test_light_robots_share_containers(tmp_path: Path) -> None:
    scenario = choose_scenario(25, 0, grid=find_world("warehouse").grid)
    config = DemoConfig(scenario, 0, Ports(), tmp_path, full_stack=2, robots_per_container=10)
    assert config.full == 2
    assert config.light_groups == [(3, 12), (13, 22), (23, 25)]
    read = loads(write_items(light_config(3, 12)), "robots3-12.config")
    assert [item.tag for item in read.containers] == ["cTag_3_12"]
    assert len(read.robot_interfaces) == 9 * 10
    tags = {interface.tag for interface in read.robot_interfaces}
    assert {"command_Robot3_emergency_stop", "command_Robot12_velocity"} <= tags
    assert len(read.connections) == 10 * 10 + 1


def test_robots_of_a_large_fleet_park_only_when_all_have_joined(tmp_path: Path) -> None:
    world = find_world("warehouse")
    few, many = (
        DemoConfig(choose_scenario(count, 0, grid=world.grid), 0, Ports(), tmp_path, full_stack=0)
        for count in (100, 200)
    )
    assert few.manager_parameters == {}
    assert many.manager_parameters == {"park_after": pytest.approx(80.0)}


def test_the_warehouse_charges_robots(tmp_path: Path) -> None:
    """Cells with chargers are docks of the world, and known to the fleet manager."""
    world = find_world("warehouse")
    scenario = choose_scenario(25, 0, grid=world.grid)
    config = DemoConfig(scenario, 0, Ports(), tmp_path, full_stack=0, world=world)
    config.write_scene()
    scene = load_scene(config.scene)
    assert len(scene.docks) == len(world.chargers) > 0
    made = loads(write_items(fleet_config(None, config.planner_parameters, config.manager_parameters)))
    given = {item.parameter.name: item.parameter.value for item in made.parameters}
    assert given["/fleet_manager/chargers"] == list(world.chargers)
    built = scene.build()
    assert built.light is not None
    x, y = world.grid.centre(world.chargers[0])
    built.light.put(0, Pose(x, y, 0.0))
    built.step(2.0)
    assert built.light.batteries.charging.tolist() == [True] + [False] * 24
