"""A fleet without clocks or sockets, whose robots move one cell a second; a client of a fleet manager."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import pytest
from support.fleet_manager import ManagerClient

from rce_fleet.planning.dijkstra import shortest_path
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.dispatch import Dispatcher, TaskRules
from rce_fleet.tasks.facts import FleetFacts, RobotFacts
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import FleetEvent, RobotEntry
from rce_fleet.tasks.task import Task


@dataclass
class Floor:
    """Robots on a floor, and the dispatcher that sends them."""

    grid: GridMap = field(default_factory=GridMap)
    rules: TaskRules = field(default_factory=TaskRules)
    now: float = 1000.0
    drain: float = 0.0
    """Share of a battery that a cell of driving takes."""
    events: list[FleetEvent] = field(default_factory=list)
    stuck: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.book = TaskBook()
        self.book.grid = self.grid
        self.facts = FleetFacts(grid=self.grid, shut=self.grid.blocked, is_live=True)
        self.dispatcher = Dispatcher(self.book, self.rules)

    def add(self, name: str, cell: int, **facts: Any) -> RobotFacts:
        self.facts.robots[name] = RobotFacts(name, "idle", cell=cell, moved_at=self.now, **facts)
        return self.facts.robots[name]

    def let_die(self, robot: RobotFacts) -> None:
        """Let a person say that a robot lies dead on the floor, which does not move it then."""
        robot.state, robot.mode, robot.away_since = "dead", "dead", self.now
        self.book.emit(RobotEntry(robot.id, mode="dead"), "dead", self.now)

    def go(self, *cells: int, **order: Any) -> Task:
        return self.book.create(Order(tuple(Stop(Action.GO, (cell,)) for cell in cells), **order), self.now)

    def deliver(self, source: int, target: int, seconds: float = 2.0, **order: Any) -> Task:
        stops = (Stop(Action.PICK, (source,), seconds), Stop(Action.DELIVER, (target,), seconds))
        return self.book.create(Order(stops, **order), self.now)

    def task(self, task: Task) -> Task:
        return self.book.tasks[task.number]

    def restart(self) -> None:
        """Make book and dispatcher again from the events, as after ``kill -9``."""
        self.events += self.book.take_events()
        self.book = TaskBook()
        for event in self.events:
            self.book.put(event)
        self.book.grid = self.grid
        self.dispatcher = Dispatcher(self.book, self.rules)

    def run(self, seconds: float) -> None:
        for _ in range(int(seconds)):
            self.now += 1.0
            self.dispatcher.update(self.now, self.facts)
            self._move(self.dispatcher.goals())
            self.events += self.book.take_events()

    def run_until_ended(self, *tasks: Task, most: float = 600.0) -> None:
        end = self.now + most
        while any(not self.task(task).has_ended for task in tasks):
            assert self.now < end, [self.task(task) for task in tasks]
            self.run(1)

    def _move(self, goals: dict[str, int | None]) -> None:
        shut = self.grid.with_blocked(self.facts.shut)
        for robot in self.facts.robots.values():
            if robot.cell is None or robot.away_since < inf:
                continue
            goal = goals.get(robot.id)
            if goal != robot.goal:
                robot.goal, robot.moved_at = goal, self.now
            if goal is None or goal == robot.cell:
                robot.state = "idle" if goal is None else "arrived"
                continue
            path = None if goal in self.facts.shut else shortest_path(shut, robot.cell, goal)
            robot.state = "unreachable" if path is None else "driving"
            if path is not None and robot.id not in self.stuck:
                robot.cell, robot.moved_at = path[1], self.now
                robot.state = "arrived" if path[1] == goal else "driving"
                if robot.battery is not None:
                    robot.battery = max(0.0, robot.battery - self.drain)


@pytest.fixture
def floor() -> Floor:
    return Floor()


@pytest.fixture
async def client(tmp_path: Path) -> AsyncIterator[ManagerClient]:
    made = ManagerClient(tmp_path / "j.sqlite")
    yield made
    await made.manager.close()
