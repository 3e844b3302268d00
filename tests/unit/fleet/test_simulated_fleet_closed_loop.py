"""Planner, move clients, navigation and the simulated world together, in simulated time and without ROS."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np
import pytest

from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellsIgnored,
    Event,
    GoalSet,
    MakePlan,
    ObstacleSeen,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    SendCancel,
    SendCells,
    Tick,
    ZonesSet,
)
from rce_fleet.coordination.move_client import ClientReport, MoveClient, SendGoal, SendStop
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import compute_plan
from rce_fleet.coordination.snapshot import RobotState
from rce_fleet.coordination.zones import Zone, ZoneKind
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import read_map, read_scenario
from rce_fleet.planning.scenario import Scenario, given_scenario, make_scenario, midway_cell
from rce_fleet.simulation.move_base import SimulatedMoveBase
from rce_fleet.simulation.obstacles import hit_points
from rce_fleet.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


class SimulatedFleet:
    """Robots in a world, steered by a planner; control at 20 Hz, lidar and poses at 10 Hz."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        grid = scenario.grid
        self.world = World(grid, seed=seed)
        self.planner = FleetPlanner(grid)
        self.scenario = scenario
        self.clients = {robot: MoveClient(grid, robot, 1.0) for robot in scenario.robots}
        self.bases = {robot: SimulatedMoveBase(grid, 0.22) for robot in scenario.robots}
        self.points = {robot: np.empty((0, 2)) for robot in scenario.robots}
        for robot, cell, yaw in zip(scenario.robots, scenario.starts, scenario.headings, strict=True):
            self.world.add_robot(robot, cell, yaw)
        for cell in scenario.boxes:
            self.world.add_box(cell)
        for cell in scenario.known_boxes:
            self.plan(CellBlocked(cell))

    def plan(self, event: Event) -> None:
        for instruction in self.planner.handle(event, self.world.time):
            match instruction:
                case SendCells(robot, revision, cells, speed):
                    self.bases[robot].limit_speed(speed)
                    self.tell(robot, self.clients[robot].take_cells(revision, list(cells), self.world.time))
                case SendCancel(robot):
                    self.tell(robot, self.clients[robot].cancel(self.world.time))
                case BlockedChanged(cells):
                    for cell in cells:
                        self.world.add_box(cell)
                case MakePlan(request):
                    self.plan(PlanMade(compute_plan(request)))
                case Reply() | CellsIgnored():
                    pass

    def tell(self, robot: str, instructions: Iterable[SendGoal | SendStop | ClientReport]) -> None:
        for instruction in instructions:
            match instruction:
                case SendGoal(goal_id, stamp, cell):
                    x, y = self.planner.state.grid.centre(cell)
                    self.bases[robot].accept(goal_id, stamp, x, y)
                case SendStop(stamp):
                    self.bases[robot].cancel("", stamp)
                case ClientReport():
                    pass  # it is asked for each time

    def step(self, number: int) -> None:
        """0.05 s of the world."""
        self.world.step(0.05)
        now = self.world.time
        for robot, base in self.bases.items():
            body, client = self.world.robots[robot], self.clients[robot]
            if number % 2 == 0:
                ranges = self.world.scan(robot)
                self.points[robot] = hit_points(body.model.lidar, ranges, body.estimate)
                pose = body.estimate
                self.plan(PoseSeen(robot, pose.x, pose.y, pose.yaw))
                self.tell(robot, client.tick(now))
                self.tell(robot, client.take_goal_states({goal.id: goal.state for goal in base.goals}, now))
                self.plan(ReportSeen(robot, client.report))
            body.drive(base.update(now, body.estimate, self.points[robot]))
            if base.blocked:
                self.plan(ObstacleSeen(robot, base.blocked))
            for goal in base.take_ended():
                self.tell(robot, client.take_result(goal.id, goal.state, now))
        if number % 4 == 0:
            self.plan(Tick())
        self.planner.validate()

    def run(self, limit: float = 120.0) -> float:
        """Send everybody to the goal and block a cell mid-way; returns the time it took, seconds."""
        number, sent_at, blocked = 0, inf, False
        robots = self.scenario.robots
        while self.world.time < limit:
            number += 1
            self.step(number)
            states = [robot.state for robot in self.planner.snapshot().robots]
            if sent_at == inf and states.count(RobotState.IDLE) == len(robots):
                sent_at = self.world.time
                for robot, goal in zip(robots, self.scenario.goals, strict=True):
                    self.plan(GoalSet(robot, goal))
            if self.world.time - sent_at > 3 and not blocked:
                blocked = True
                self.block_midway()
            if blocked and states.count(RobotState.ARRIVED) == len(robots):
                return self.world.time - sent_at
        raise AssertionError(f"not there after {limit} s: {self.planner.snapshot()}")

    def block_midway(self) -> None:
        snapshot = self.planner.snapshot()
        grid = self.scenario.grid.with_blocked({*self.scenario.grid.blocked, *self.world.boxes})
        cell = midway_cell(
            grid,
            {robot.id: robot.plan for robot in snapshot.robots},
            {robot.id: robot.goal for robot in snapshot.robots if robot.goal is not None},
        )
        if cell is not None:
            self.plan(CellBlocked(cell))


@pytest.mark.slow
@pytest.mark.parametrize(("robots", "seed"), [(1, 0), (3, 1), (8, 2)])
def test_robots_reach_goals_without_collisions(robots: int, seed: int) -> None:
    check_run(SimulatedFleet(make_scenario(GridMap(), robots, seed=seed), seed))


def test_robots_drive_slowly_in_a_slow_zone() -> None:
    """A list of cells carries the zone's speed, and the robot keeps to it until the zone is removed."""
    fleet = SimulatedFleet(given_scenario(GridMap(1, 6), [(0, 5)]), seed=4)
    zone = Zone("dock", ZoneKind.SLOW, tuple(range(6)), speed=0.2)
    fleet.plan(ZonesSet((zone,)))
    body = fleet.world.robots["Robot1"]
    top = {True: 0.0, False: 0.0}
    is_slow = True
    for number in range(1, 600):
        fleet.step(number)
        top[is_slow] = max(top[is_slow], abs(body.twist.speed))
        if number == 60:
            fleet.plan(GoalSet("Robot1", 5))
        if number == 300:
            is_slow = False
            fleet.plan(ZonesSet((), remove=("dock",)))
    assert 0.15 < top[True] <= 0.21
    assert top[False] > 0.4


@pytest.mark.slow
@pytest.mark.needs("data")
def test_four_robots_drive_on_a_benchmark_map(rce_data: Path) -> None:
    grid = read_map(rce_data / "maps" / "random-32-32-20.map")
    rows = read_scenario(rce_data / "maps" / "random-32-32-20-random-1.scen", grid, limit=4)
    check_run(SimulatedFleet(given_scenario(grid, [(row.start, row.goal) for row in rows]), seed=0))


def check_run(fleet: SimulatedFleet) -> None:
    fleet.run()
    assert fleet.world.collisions.total == 0
    assert fleet.world.min_separation > 0.1
    for robot, goal in zip(fleet.scenario.robots, fleet.scenario.goals, strict=True):
        pose = fleet.world.robots[robot].pose
        assert fleet.scenario.grid.cell_at(pose.x, pose.y) == goal
