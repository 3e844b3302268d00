"""Measure light robots: ``python -m benchmarks.light [--quick] [--robots N]``. It needs no engine.

``world``: what a simulated second of driving light robots costs, with the judge of their contacts, by the
number of robots. ``fleet``: the same with planner, move clients and new goals in the same process, on the
demo's warehouse: all parts of a fleet except messages. ``plans`` is the time of the joint plans, which a
process of its own makes in a fleet; here the world waits for them.

Times are those of the processor that this thread used, so that other load does not count.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from random import Random
from time import thread_time
from typing import Any, Self, assert_never

import numpy as np

from benchmarks.figures import Results, own_memory, show
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellsIgnored,
    Event,
    GoalSet,
    MakePlan,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.move_client import ClientReport, Instruction, MoveClient, SendGoal, SendStop
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import PlanRequest, compute_plan
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.demo.config import ROBOT_RADIUS
from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.demo.worlds import NamedWorld, warehouse
from rce_fleet.geometry.poses import Pose
from rce_fleet.simulation.light.robots import LightRobots
from rce_fleet.simulation.walls import grid_walls

Rows = list[dict[str, Any]]

SIZES = (10, 100, 1000)
TARGET = 2.24
"""LSMART simulates 1000 differential-drive robots at this real-time factor on 16 cores (lifelong-smart,
Ryzen 9950X, 600 simulated seconds in 268 s, with its planner)."""
STEP = 0.1
"""Seconds between two looks at poses and goals."""


def make_robots(world: NamedWorld, count: int) -> LightRobots:
    """Return light robots at random free cells of a world."""
    scenario = choose_scenario(max(count, 21), 1, grid=world.grid)
    cells = zip(scenario.robots, scenario.starts, scenario.headings, strict=True)
    starts = {name: Pose(*world.grid.centre(cell), yaw) for name, cell, yaw in list(cells)[:count]}
    return LightRobots(starts, grid_walls(world.grid).edges(glass=False), seed=1)


def measure_world(count: int, seconds: float) -> dict[str, Any]:
    """Measure robots that drive to and fro between neighbouring cells."""
    world = warehouse()
    before = own_memory("VmRSS")
    robots = make_robots(world, count)
    offsets = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
    began = thread_time()
    for second in range(round(seconds)):
        for row, (x, y, _) in enumerate(robots.bodies.poses.tolist()):
            dx, dy = offsets[(row + second) % 4]
            robots.accept(row, f"{row}-{second}", float(second + 1), x + dx, y + dy)
        robots.advance(1.0)
        robots.take_ended()
    spent = thread_time() - began
    return {
        "robots": count,
        "ms per simulated s": round(1000 * spent / seconds, 2),
        "us per robot and s": round(1e6 * spent / seconds / count, 1),
        "MB more": round(own_memory("VmRSS") - before, 1),
        "x real time": round(seconds / spent, 1),
        "target": TARGET if count == SIZES[-1] else "",
    }


@dataclass
class Fleet:
    """Planner, move clients and light robots, which hand each other what they have to say.

    Attributes:
        world: The floor.
        robots: The robots.
        planner: The planner.
        plans: Processor time of joint plans, seconds.
        done: Goals that were reached.
    """

    world: NamedWorld
    robots: LightRobots
    planner: FleetPlanner
    rng: Random
    plans: float = 0.0
    done: int = 0
    requests: list[PlanRequest] = field(default_factory=list)
    clients: list[MoveClient] = field(default_factory=list)
    goals: dict[str, int] = field(default_factory=dict)

    @classmethod
    def make(
        cls,
        count: int,
        world: NamedWorld | None = None,
        settings: FleetSettings | None = None,
        seed: int = 1,
    ) -> Self:
        """Return a fleet at rest; by default in the demo's warehouse."""
        world = world or warehouse()
        planner = FleetPlanner(world.grid, settings or FleetSettings(robot_radius=ROBOT_RADIUS))
        fleet = cls(world, make_robots(world, count), planner, Random(seed))
        fleet.clients = [MoveClient(world.grid, name, 0.0, ClientReport(0)) for name in fleet.robots.names]
        return fleet

    def step(self) -> None:
        """Advance all by ``STEP`` seconds."""
        robots = self.robots
        robots.advance(STEP)
        now = robots.time
        for row in robots.take_ended():
            for goal in robots.goal_lists[row].take_ended():
                self._follow(row, self.clients[row].take_result(goal.id, goal.state, now))
        for row, (name, pose) in enumerate(zip(robots.names, robots.bodies.estimates.tolist(), strict=True)):
            # Each robot speaks five times a second in turn.
            if (row + round(now / STEP)) % 2 == 0:
                self.tell(PoseSeen(name, *pose))
                states = {goal.id: goal.state for goal in robots.goal_lists[row].goals}
                client = self.clients[row]
                self._follow(row, client.take_goal_states(states, now))
                self._follow(row, [*client.tick(now), client.report])
        self._give_goals()
        self.tell(Tick())
        if self.requests:
            began = thread_time()
            result = compute_plan(self.limited(self.requests.pop()))
            self.plans += thread_time() - began
            self.requests.clear()
            self.tell(PlanMade(result))

    def limited(self, request: PlanRequest) -> PlanRequest:
        """Return a request as the process that makes plans gets it."""
        return request

    def tell(self, event: Event) -> None:
        """Give an event to the planner."""
        for instruction in self.planner.handle(event, self.robots.time):
            match instruction:
                case MakePlan(request):
                    self.requests.append(request)
                case SendCells(robot, revision, cells):
                    row = self.robots.row(robot)
                    assert row is not None
                    client = self.clients[row]
                    self._follow(row, client.take_cells(revision, list(cells), self.robots.time))
                case SendCancel(robot):
                    row = self.robots.row(robot)
                    assert row is not None
                    self._follow(row, self.clients[row].cancel(self.robots.time))
                case Reply() | BlockedChanged() | CellsIgnored():
                    pass
                case _:
                    assert_never(instruction)

    def _follow(self, row: int, instructions: list[Instruction]) -> None:
        """Carry out what a move client says."""
        for instruction in instructions:
            match instruction:
                case SendGoal():
                    place = self.world.grid.centre(instruction.cell)
                    self.robots.accept(row, instruction.id, instruction.stamp, *place)
                case SendStop(stamp):
                    self.robots.cancel(row, "", stamp)
                case ClientReport():
                    self.tell(ReportSeen(self.robots.names[row], instruction))
                case _:
                    assert_never(instruction)

    def _give_goals(self) -> None:
        """Send robots that stand at their goals on."""
        known = self.planner.state.robots
        taken = set(self.goals.values())
        for name in self.robots.names:
            record = known.get(name)
            claims = self.planner.state.ledger.claims(name) if record is not None else ()
            goal = self.goals.get(name)
            if record is None or not claims or (goal is not None and claims != {goal}):
                continue
            self.done += goal is not None
            cell = self.rng.choice(self.world.shelves)
            if cell not in taken:
                taken.add(cell)
                self.goals[name] = cell
                self.tell(GoalSet(name, cell))


def measure_fleet(count: int, seconds: float) -> dict[str, Any]:
    """Measure a fleet with new goals all the time."""
    fleet = Fleet.make(count)
    while len(fleet.goals) < count and fleet.robots.time < seconds:
        fleet.step()
    at, done, plans, began = fleet.robots.time, fleet.done, fleet.plans, thread_time()
    while fleet.robots.time < at + seconds:
        fleet.step()
    spent, planned = thread_time() - began, fleet.plans - plans
    driven = fleet.robots.bodies.distances.sum()
    judge = fleet.robots.judge
    return {
        "robots": count,
        "goals reached": fleet.done - done,
        "m driven": round(float(driven)),
        "contacts": judge.with_robots + judge.with_walls + judge.with_boxes,
        "plans ms per simulated s": round(1000 * planned / seconds, 1),
        "rest ms per simulated s": round(1000 * (spent - planned) / seconds, 1),
        "x real time": round(seconds / spent, 2),
        "target": TARGET if count == SIZES[-1] else "",
    }


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.light", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a world of fewer seconds, fleets of 100 robots")
    parser.add_argument(
        "--robots", type=int, nargs="+", default=[], help="sizes of the fleets with a planner"
    )
    options = parser.parse_args()
    seconds = 10.0 if options.quick else 60.0
    sizes = options.robots or ((10, 100) if options.quick else SIZES)
    results = Results("light", quick=options.quick or bool(options.robots))
    measure_world(SIZES[0], 1.0)  # loads modules, whose time and memory are not the robots'
    world = [measure_world(count, seconds) for count in SIZES]
    results.keep("world", world)
    show("Light robots", world)
    results.begin("fleet")
    fleet = [measure_fleet(count, seconds) for count in sizes]
    results.keep("fleet", fleet)
    show("Light robots with planner and move clients", fleet)
    print("results:", results.save())


if __name__ == "__main__":
    main()
