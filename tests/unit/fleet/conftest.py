"""A fleet without clocks or sockets: planner, move clients and make-believe robots, with bad luck."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from itertools import combinations
from math import hypot
from random import Random
from typing import TYPE_CHECKING, Any

import pytest

from rce_fleet.coordination.events import (
    BlockedChanged,
    Event,
    GoalSet,
    ObstacleSeen,
    PoseSeen,
    Reply,
    ReportSeen,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.move_client import ClientReport, GoalState, MoveClient, SendGoal, SendStop
from rce_fleet.coordination.snapshot import RobotState

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.coordination.planner import FleetPlanner
    from rce_fleet.planning.grid import GridMap

RADIUS = 0.22
STEP = 0.1


@dataclass
class MakeBelieveRobot:
    """Drives in straight lines, at whatever speed it likes, and stops at boxes."""

    id: str
    grid: GridMap
    x: float
    y: float
    speed: float = 0.8
    goals: dict[str, GoalState] = field(default_factory=dict)
    current: SendGoal | None = None
    stopped_until: float = float("-inf")
    stopping: GoalState | None = None
    found: set[int] = field(default_factory=set)

    def take_goal(self, goal: SendGoal) -> None:
        if goal.id in self.goals:
            return
        if goal.stamp <= self.stopped_until:
            self.goals[goal.id] = GoalState.RECALLED
            return
        if self.current is not None:
            self.goals[self.current.id] = GoalState.PREEMPTED
        self.goals[goal.id] = GoalState.ACTIVE
        self.current, self.stopping = goal, None
        self.found.clear()

    def take_stop(self, stop: SendStop) -> None:
        self.stopped_until = max(self.stopped_until, stop.stamp)
        if self.current is not None and self.current.stamp <= self.stopped_until:
            self.stopping = GoalState.PREEMPTED

    def drive(self, pace: float, boxes: set[int]) -> list[tuple[str, GoalState]]:
        """Go on for a step; returns ended goals."""
        if self.current is None:
            return []
        if self.stopping is not None:
            return self._end(self.stopping)
        goal_x, goal_y = self.grid.centre(self.current.cell)
        away = hypot(goal_x - self.x, goal_y - self.y)
        reach = min(self.speed * pace * STEP, away)
        if away > 0:
            x, y = self.x + (goal_x - self.x) / away * reach, self.y + (goal_y - self.y) / away * reach
            hit = self.grid.cells_touched(x, y, RADIUS) & boxes
            if hit:
                self.found |= hit
                return self._end(GoalState.ABORTED)
            self.x, self.y = x, y
        return self._end(GoalState.SUCCEEDED) if reach == away else []

    def _end(self, state: GoalState) -> list[tuple[str, GoalState]]:
        assert self.current is not None
        ended = [(self.current.id, state)]
        self.goals[self.current.id] = state
        self.current = self.stopping = None
        return ended


class MakeBelieveFleet:
    """Runs planner, clients and robots in steps of 0.1 s. Messages are late, out of order and get lost.

    After every step it checks that each robot is within its claims, that no two touch, and that none
    touches a box.
    """

    def __init__(self, planner: FleetPlanner, starts: list[int], seed: int, *, loss: float = 0.1) -> None:
        self.rng = Random(seed)
        self.loss = loss
        self.now = 1000.0
        self.planner = planner
        self.grid = planner.books.grid
        self.hidden: set[int] = set()
        self.blocked: set[int] = set()
        self.silent: set[str] = set()
        self.robots: dict[str, MakeBelieveRobot] = {}
        self.clients: dict[str, MoveClient] = {}
        self.replies: list[Reply] = []
        self._mail: dict[Any, list[tuple[float, Callable[[], None]]]] = defaultdict(list)
        for number, cell in enumerate(starts, start=1):
            self.add_robot(f"Robot{number}", cell)

    def add_robot(self, robot: str, cell: int) -> None:
        x, y = self.grid.centre(cell)
        self.robots[robot] = MakeBelieveRobot(robot, self.grid, x, y, self.rng.uniform(0.3, 0.9))
        self.clients[robot] = MoveClient(self.grid, robot, self.now)

    def restart_client(self, robot: str) -> None:
        self.clients[robot] = MoveClient(self.grid, robot, self.now)

    def ask(self, event: Event) -> Reply:
        self._plan(event)
        return self.replies[-1]

    def send(self, goals: list[int]) -> None:
        """Wait for all robots to have joined, and send robot N to ``goals[N - 1]``."""
        self.run(lambda: self.states().count(RobotState.IDLE) == len(self.robots))
        for number, goal in enumerate(goals, start=1):
            reply = self.ask(GoalSet(f"Robot{number}", goal))
            assert reply.ok, reply.message

    def states(self) -> list[RobotState]:
        return [robot.state for robot in self.planner.snapshot().robots]

    def all_arrived(self) -> bool:
        return set(self.states()) == {RobotState.ARRIVED}

    def run(self, done: Callable[[], bool], limit: float = 600.0) -> None:
        end = self.now + limit
        while not done():
            assert self.now < end, f"not done in {limit} s: {self.planner.snapshot()}"
            self.step()

    def step(self) -> None:
        self.now += STEP
        self._deliver()
        for robot in self.robots.values():
            pace = self.rng.choice((0.0, 0.5, 1.0, 1.0))
            for goal_id, state in robot.drive(pace, self.hidden | self.blocked):
                self._post("result", robot.id, self._result, robot.id, goal_id, state)
            if robot.id in self.silent:
                continue
            self._post("pose", robot.id, self._plan, PoseSeen(robot.id, robot.x, robot.y, 0.0))
            self._post("states", robot.id, self._goal_states, robot.id, dict(robot.goals))
            if robot.found:
                self._post("obstacle", robot.id, self._plan, ObstacleSeen(robot.id, tuple(robot.found)))
            client = self.clients[robot.id]
            self._instruct(robot.id, [*client.tick(self.now), client.report])
        self._plan(Tick())
        self.check()

    def check(self) -> None:
        self.planner.validate()
        ledger = self.planner.books.ledger
        for robot in self.robots.values():
            touched = self.grid.cells_touched(robot.x, robot.y, RADIUS)
            if ledger.route(robot.id):
                assert touched <= ledger.claims(robot.id), f"{robot.id} is outside of its cells"
            assert not touched & (self.hidden | self.blocked | self.grid.blocked)
        for a, b in combinations(self.robots.values(), 2):
            assert hypot(a.x - b.x, a.y - b.y) > 2 * RADIUS, f"{a.id} touches {b.id}"

    # -- mail -----------------------------------------------------------------------------------

    def _post(self, topic: str, robot: str, action: Callable[..., None], *values: Any) -> None:
        """Topics are in order each, as over TCP, but not with one another."""
        if self.rng.random() < self.loss:
            return
        queue = self._mail[topic, robot]
        due = self.now + self.rng.choice((0.0, 0.0, 0.1, 0.4))
        queue.append((max(due, queue[-1][0] if queue else 0.0), lambda: action(*values)))

    def _deliver(self) -> None:
        ready = [(queue, key) for key, queue in self._mail.items() if queue]
        self.rng.shuffle(ready)
        for queue, _ in ready:
            while queue and queue[0][0] <= self.now:
                queue.pop(0)[1]()

    def _plan(self, event: Event) -> None:
        for instruction in self.planner.handle(event, self.now):
            match instruction:
                case SendCells(robot, revision, cells):
                    self._post("cells", robot, self._cells, robot, revision, list(cells))
                case SendCancel(robot):
                    self._post("cancel", robot, self._cancel, robot)
                case Reply():
                    self.replies.append(instruction)
                case BlockedChanged(cells):
                    self.blocked = set(cells)

    def _cells(self, robot: str, revision: int, cells: list[int]) -> None:
        self._instruct(robot, self.clients[robot].take_cells(revision, cells, self.now))

    def _cancel(self, robot: str) -> None:
        self._instruct(robot, self.clients[robot].cancel(self.now))

    def _result(self, robot: str, goal_id: str, state: GoalState) -> None:
        self._instruct(robot, self.clients[robot].take_result(goal_id, state, self.now))

    def _goal_states(self, robot: str, states: dict[str, GoalState]) -> None:
        self._instruct(robot, self.clients[robot].take_goal_states(states, self.now))

    def _instruct(self, robot: str, instructions: list[Any]) -> None:
        for instruction in instructions:
            match instruction:
                case SendGoal():
                    self._post("goal", robot, self.robots[robot].take_goal, instruction)
                case SendStop():
                    self._post("stop", robot, self.robots[robot].take_stop, instruction)
                case ClientReport():
                    self._post("report", robot, self._plan, ReportSeen(robot, instruction))


@pytest.fixture
def make_fleet() -> type[MakeBelieveFleet]:
    """Makes fleets of make-believe robots."""
    return MakeBelieveFleet
