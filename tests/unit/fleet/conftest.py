"""A fleet without clocks or sockets: planner, move clients and make-believe robots, with bad luck."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from itertools import combinations
from math import hypot
from random import Random
from typing import TYPE_CHECKING, Any

import pytest

from rce_fleet.coordination.cell_blocks import CellBlock
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellsIgnored,
    Event,
    GoalSet,
    Instruction,
    MakePlan,
    ObstacleSeen,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    RobotHeard,
    RobotRemoved,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.move_client import (
    ClientReport,
    ClientState,
    GoalState,
    MoveClient,
    SendGoal,
    SendStop,
)
from rce_fleet.coordination.replanning import compute_plan
from rce_fleet.coordination.robot import Phase
from rce_fleet.coordination.robot_signs import RobotSign, RobotSigns
from rce_fleet.coordination.snapshot import FleetSnapshot, RobotSnapshot, RobotState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

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
    newest_stamp: float = float("-inf")
    stopping: GoalState | None = None
    found: set[int] = field(default_factory=set)

    def take_goal(self, goal: SendGoal) -> None:
        if goal.id in self.goals:
            return
        self.newest_stamp = max(self.newest_stamp, goal.stamp)
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
            touched = self.grid.cells_touched(x, y, RADIUS)
            self.found |= touched & boxes
            if touched & (boxes | self.grid.blocked):
                return self._end(GoalState.ABORTED)
            self.x, self.y = x, y
        return self._end(GoalState.SUCCEEDED) if reach == away else []

    def carry(self, x: float, y: float) -> None:
        """Put it elsewhere; its navigation gives up, because its emergency stop is pressed meanwhile."""
        self.x, self.y = x, y
        if self.current is not None:
            self.stopping = GoalState.ABORTED

    def _end(self, state: GoalState) -> list[tuple[str, GoalState]]:
        assert self.current is not None
        ended = [(self.current.id, state)]
        self.goals[self.current.id] = state
        self.current = self.stopping = None
        return ended


class SimulatedClients:
    """Runs planner, clients and robots in steps of 0.1 s. Messages are late, out of order and get lost.

    After every step it checks that each robot is within its claims, that no two touch, that none touches a
    box, and that the changes which the planner told of add up to its state. A robot that was carried is
    outside of its claims until it takes part in plans again.

    Args:
        planner: What is tested.
        starts: A robot stands in each of these cells.
        seed: Draws what goes wrong.
        loss: Share of messages that get lost.
        plan_delays: How long plans take, in seconds of the fleet's time; one of them is drawn for each plan.
        pose_step: Robots send a pose after each so many metres, as ROS's localization does, and none at rest;
            0: always. Their navigation sends feedback then.
    """

    def __init__(
        self,
        planner: FleetPlanner,
        starts: list[int],
        seed: int,
        *,
        loss: float = 0.1,
        plan_delays: tuple[float, ...] = (0.0,),
        pose_step: float = 0.0,
    ) -> None:
        self.pose_step = pose_step
        self.posed: dict[str, tuple[float, float]] = {}
        self.signs: dict[str, RobotSigns] = defaultdict(RobotSigns)
        self.rng = Random(seed)
        self.loss = loss
        self.plan_delays = plan_delays
        self.told: dict[str, RobotSnapshot] = {}
        self.told_cells: dict[int, str] = {}
        self.told_blocks: dict[int, CellBlock] = {}
        self.sequence = 0
        self.now = 1000.0
        self.set_forward = 1e9
        """Seconds by which the clock of move clients, which people can set, is ahead of the planner's."""
        self.planner = planner
        self.grid = planner.state.grid
        self.hidden: set[int] = set()
        self.blocked: set[int] = set()
        self.silent: set[str] = set()
        self.mute: set[str] = set()
        """Robots whose move clients answer nothing."""
        self.unposed: set[str] = set()
        """Robots whose poses get lost."""
        self.deaf: set[str] = set()
        """Robots whose move clients hear nothing."""
        self.carried: set[str] = set()
        self.lies: dict[str, tuple[float, float]] = {}
        """Where robots say that they are, of those that do not say where they are."""
        self.robots: dict[str, MakeBelieveRobot] = {}
        self.clients: dict[str, MoveClient] = {}
        self.replies: list[Reply] = []
        self._plans: list[tuple[float, PlanMade]] = []
        self._mail: dict[Any, list[tuple[float, Callable[[], object]]]] = defaultdict(list)
        for number, cell in enumerate(starts, start=1):
            self.add_robot(f"Robot{number}", cell)

    @property
    def wall(self) -> float:
        """The time of the move clients."""
        return self.now + self.set_forward

    def add_robot(self, robot: str, cell: int) -> None:
        x, y = self.grid.centre(cell)
        self.robots[robot] = MakeBelieveRobot(robot, self.grid, x, y, self.rng.uniform(0.3, 0.9))
        self.clients[robot] = MoveClient(self.grid, robot, self.wall)

    def add_robot_at(self, robot: str, x: float, y: float) -> None:
        """Add a robot between the centres of cells."""
        self.add_robot(robot, 0)
        self.robots[robot].x, self.robots[robot].y = x, y

    def restart_client(self, robot: str) -> None:
        self.clients[robot] = MoveClient(self.grid, robot, self.wall)

    def carry(self, robot: str, x: float, y: float) -> None:
        """Let a person put a robot elsewhere. There must be room, and others must be able to stop."""
        self.carried.add(robot)
        self.robots[robot].carry(x, y)

    def restart_planner(self, planner: FleetPlanner) -> None:
        """Let another planner take over; it knows nothing."""
        self.planner = planner
        self.sequence = 0
        self._plans.clear()
        self.told.clear()
        self.told_cells.clear()
        self.told_blocks.clear()

    def remove(self, robot: str) -> None:
        """Take a robot off the floor."""
        del self.robots[robot], self.clients[robot]
        self.carried.discard(robot)
        for key, queue in self._mail.items():
            if key[1] == robot:
                queue.clear()
        assert self.ask(RobotRemoved(robot)).ok

    def ask(self, event: Event) -> Reply:
        self.tell(event)
        return self.replies[-1]

    def tell(self, event: Event) -> list[Instruction]:
        """Give an event to the planner and carry out what it says; returns that."""
        instructions = self.planner.handle(event, self.now)
        for instruction in instructions:
            self._carry_out(instruction)
        while self._plans and self._plans[0][0] <= self.now:
            instructions += self.tell(self._plans.pop(0)[1])
        return instructions

    def send(self, goals: list[int]) -> None:
        """Wait for all robots to have joined, and send robot N to ``goals[N - 1]``."""
        self.run(lambda: self.states().count(RobotState.IDLE) == len(self.robots))
        for number, goal in enumerate(goals, start=1):
            reply = self.ask(GoalSet(f"Robot{number}", goal))
            assert reply.ok, reply.message
        self.tell(Tick())  # Paths are found at the next tick.

    def newcomers_cells(self) -> set[int]:
        """The cells of robots whose place the planner may not know yet; boxes must not be put there."""
        return {
            cell
            for robot in self.robots.values()
            if not self.planner.state.ledger.length(robot.id) or robot.id in self.carried
            for cell in self.grid.cells_touched(robot.x, robot.y, RADIUS)
        }

    def settled(self) -> bool:
        """Tell whether all robots are there and take part in plans."""
        away = (RobotState.JOINING, RobotState.STOPPING, RobotState.SILENT)
        states = self.states()
        return len(states) == len(self.robots) and not any(state in away for state in states)

    def send_all(self, goals: list[int]) -> bool:
        """Send the robots that are there somewhere else; tell whether the planner takes it."""
        cleared = [self.ask(GoalSet(robot, None)).ok for robot in sorted(self.robots)]
        taken = [
            self.ask(GoalSet(robot, goal)).ok for robot, goal in zip(sorted(self.robots), goals, strict=True)
        ]
        return all(cleared + taken)

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
            self._sense(robot)
            self._post("states", robot.id, self._goal_states, robot.id, dict(robot.goals), robot.newest_stamp)
            if robot.found:
                self._post("obstacle", robot.id, self.tell, ObstacleSeen(robot.id, tuple(robot.found)))
            client = self.clients[robot.id]
            self._instruct(robot.id, [*client.tick(self.wall), client.report])
        self.tell(Tick())
        self.check()

    def _sense(self, robot: MakeBelieveRobot) -> None:
        """Send what localization and navigation publish."""
        posed_x, posed_y = self.posed.get(robot.id, (float("inf"), 0.0))
        x, y = self.lies.get(robot.id, (robot.x, robot.y))
        if hypot(x - posed_x, y - posed_y) >= self.pose_step:
            self.posed[robot.id] = x, y
            if robot.id in self.unposed:
                return
            self._post("pose", robot.id, self.tell, PoseSeen(robot.id, x, y, 0.0))
        if self.pose_step and self.clients[robot.id].report.target is not None:
            self._post("feedback", robot.id, self.signs[robot.id].take_pose, x, y, 0.0, self.now)

    def check(self) -> None:
        self.planner.validate()
        self._check_changes()
        ledger = self.planner.state.ledger
        for robot in self.robots.values():
            touched = self.grid.cells_touched(robot.x, robot.y, RADIUS)
            if touched <= ledger.claims(robot.id) and self._takes_part(robot):
                self.carried.discard(robot.id)
            if ledger.route(robot.id) and robot.id not in self.carried:
                assert touched <= ledger.claims(robot.id), f"{robot.id} is outside of its cells"
            assert not touched & (self.hidden | self.blocked | self.grid.blocked)
        for a, b in combinations(self.robots.values(), 2):
            assert hypot(a.x - b.x, a.y - b.y) > 2 * RADIUS, f"{a.id} touches {b.id}"

    def _takes_part(self, robot: MakeBelieveRobot) -> bool:
        """Return whether a robot drives on cells that it was granted where it is."""
        record = self.planner.state.robots.get(robot.id)
        if record is None or record.phase is not Phase.ACTIVE:
            return False
        has_list = self.clients[robot.id].report.revision == record.revision
        claims = self.planner.state.ledger.claims(robot.id)
        if not has_list or robot.current is None:
            return has_list
        # Pushed past the cell that it drives to, it is stopped first.
        granted, here = self.planner.state.ledger.granted(robot.id), self.grid.cell_at(robot.x, robot.y)
        ahead = granted[granted.index(robot.current.cell) + 1 :] if robot.current.cell in granted else []
        return robot.current.cell in claims and here not in ahead

    def _check_changes(self) -> None:
        """Add up what the planner says has changed, and compare."""
        changes = self.planner.take_changes()
        if changes is not None:
            self.sequence += 1
            assert changes.sequence == self.sequence == self.planner.sequence
            for robot in changes.robots:
                assert self.told.get(robot.id) != robot
                self.told[robot.id] = robot
            for name in changes.removed:
                del self.told[name]
            for state in ("blocked", "pending", "freed"):
                self.told_cells.update(dict.fromkeys(getattr(changes, state), state))
            self.told_blocks.update(changes.blocks)
            for cell in changes.removed_blocks:
                del self.told_blocks[cell]
        now = self.planner.snapshot()
        told = FleetSnapshot(
            robots=tuple(self.told[robot] for robot in sorted(self.told)),
            blocked=tuple(sorted(cell for cell, state in self.told_cells.items() if state == "blocked")),
            pending=tuple(sorted(cell for cell, state in self.told_cells.items() if state == "pending")),
            blocks=tuple(sorted(self.told_blocks.items())),
        )
        assert without_poses(told) == without_poses(now)

    # Mail

    def _post(self, topic: str, robot: str, action: Callable[..., object], *values: object) -> None:
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

    def _carry_out(self, instruction: Instruction) -> None:
        match instruction:
            case SendCells(robot) | SendCancel(robot) if robot in self.deaf:
                pass
            case SendCells(robot, revision, cells):
                self._post("cells", robot, self._cells, robot, revision, list(cells))
            case SendCancel(robot):
                self._post("cancel", robot, self._cancel, robot)
            case Reply():
                self.replies.append(instruction)
            case BlockedChanged(cells):
                self.blocked = set(cells)
            case MakePlan(request):
                due = self.now + self.rng.choice(self.plan_delays)
                self._plans.append((due, PlanMade(compute_plan(request))))
            case CellsIgnored():
                pass  # a pose was lost: the robot reports them again

    def _cells(self, robot: str, revision: int, cells: list[int]) -> None:
        self._instruct(robot, self.clients[robot].take_cells(revision, cells, self.wall))

    def _cancel(self, robot: str) -> None:
        self._instruct(robot, self.clients[robot].cancel(self.wall))

    def _result(self, robot: str, goal_id: str, state: GoalState) -> None:
        self._instruct(robot, self.clients[robot].take_result(goal_id, state, self.wall))

    def _goal_states(self, robot: str, states: dict[str, GoalState], newest: float) -> None:
        self.signs[robot].hear(self.now)
        self._instruct(robot, self.clients[robot].take_goal_states(states, self.wall, newest))

    def _instruct(self, robot: str, instructions: Iterable[SendGoal | SendStop | ClientReport]) -> None:
        for instruction in instructions:
            match instruction:
                case SendGoal():
                    self._post("goal", robot, self.robots[robot].take_goal, instruction)
                case SendStop():
                    self._post("stop", robot, self.robots[robot].take_stop, instruction)
                case ClientReport() if robot in self.mute:
                    pass
                case ClientReport():
                    is_driving = instruction.state is ClientState.DRIVING
                    sign = self.signs[robot].sign(self.now, is_driving=is_driving)
                    self._post("report", robot, self._report, robot, instruction, sign)

    def _report(self, robot: str, report: ClientReport, sign: RobotSign) -> None:
        if sign.pose is not None:
            self.tell(PoseSeen(robot, *sign.pose))
        if sign.age is not None:
            self.tell(RobotHeard(robot, sign.age))
        self.tell(ReportSeen(robot, report))


def without_poses(snapshot: FleetSnapshot) -> FleetSnapshot:
    robots = tuple(replace(robot, x=0.0, y=0.0, yaw=0.0) for robot in snapshot.robots)
    return replace(snapshot, robots=robots)


@pytest.fixture
def make_fleet() -> type[SimulatedClients]:
    """Makes fleets of make-believe robots."""
    return SimulatedClients
