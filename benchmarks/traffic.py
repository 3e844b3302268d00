"""Measure the planner node's tick: ``python -m benchmarks.traffic [--quick] [--planner NAME]``.

It needs no engine. ``tick``: robots drive on warehouse-10-20-10-2-1, each with a pose and a report in every
tick of 0.1 s. A tick is all of it: serialized poses in, reports in, grants and changes of the state out.
Ticks that take over a part of a plan are ticks too. ``block``: a cell on many robots' paths is blocked; the
time of the planner's work and of the plan until the last of them has its new path, without the wait for the
process that makes plans.
``memory``: what a robot adds to the planner.

Times are those of the processor that the thread used, so that other load does not count. The map is that of
MovingAI's benchmarks, in the folder ``RCE_DATA``. 1000 robots need a compiled planner (``RCE_COMPILED=yes``).
"""

from __future__ import annotations

import argparse
import gc
import tracemalloc
from random import Random
from time import perf_counter, thread_time
from typing import TYPE_CHECKING, Any

from benchmarks.figures import Results, data, percentile, show
from benchmarks.fleet import Fleet
from rce.ros.packages import PackageIndex
from rce.ros.types import Time, TypeRegistry
from rce_fleet.compiled import compile_kernels, is_available
from rce_fleet.coordination.answers import numbered_array
from rce_fleet.coordination.events import CellBlocked, GoalSet, MakePlan, PlanMade, SendCells, Tick
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import compute_plan
from rce_fleet.coordination.settings import COMPILED_EFFORT, FleetSettings
from rce_fleet.nodes.robot_messages import read_pose_seen
from rce_fleet.nodes.state_publisher import changes_fields
from rce_fleet.planning.movingai import read_map
from rce_fleet.planning.planner import DEFAULT_PLANNER, load_planner
from rce_fleet.planning.rerouting import REROUTING_KERNELS

if TYPE_CHECKING:
    from rce_fleet.planning.grid import GridMap

TICK_LIMIT_MS = 100
"""99 of 100 ticks of 1000 robots take at most this."""
BLOCK_LIMIT_MS = 100
"""From a blocked cell to the new path of the last of 1000 robots."""
STARTED = Time(1)
_MAP = "warehouse-10-20-10-2-1.map"
_MESSAGES = TypeRegistry(PackageIndex([]))


def warehouse() -> GridMap:
    """Return the map of the benchmarks."""
    return read_map(data() / "maps" / _MAP)


class Traffic:
    """Robots on the warehouse map, with goals, and what the planner node does with their messages.

    Args:
        count: Number of robots.
        planner: Name of the planner.

    Attributes:
        fleet: Robots and planner.
        made_by: Makes the plans for all robots.
        rng: Draws starts, goals and cells.
    """

    def __init__(self, count: int, planner: str) -> None:
        grid = warehouse()
        self.rng = Random(count)
        effort = COMPILED_EFFORT if is_available() else FleetSettings().effort
        settings = FleetSettings(planner=planner, effort=effort)
        self.fleet = Fleet(FleetPlanner(grid, settings))
        compile_kernels(REROUTING_KERNELS)
        self.made_by = load_planner(settings.planner)
        self._progress = dict.fromkeys((f"Robot{number}" for number in range(count)), 0.0)
        self._lists = _MESSAGES.message("std_msgs/Int32MultiArray")
        self._changes = _MESSAGES.message("fleet/FleetChanges")
        self._poses = _MESSAGES.message("geometry_msgs/PoseWithCovarianceStamped")
        self.sent = 0
        self._made: PlanMade | None = None
        for robot, cell in zip(self._progress, self.rng.sample(grid.free, count), strict=True):
            self.fleet.places[robot] = grid.centre(cell)
            self._progress[robot] = self.rng.random()
        while any(not self.fleet.planner.state.ledger.length(robot) for robot in self._progress):
            self.fleet.now += 0.5
            self.fleet.say_all()
        for robot, goal in zip(self._progress, self.rng.sample(grid.free, count), strict=True):
            self.fleet.tell(GoalSet(robot, goal))
        for _ in range(count):
            self.fleet.tell(Tick())
            self.plan()
        self.fleet.planner.take_changes()

    def plan(self) -> None:
        """Make all requested plans, as the process beside the node does."""
        fleet = self.fleet
        while fleet.requests or fleet.planner.is_taking_over():
            fleet.tell(
                PlanMade(compute_plan(fleet.requests.pop(), self.made_by)) if fleet.requests else Tick()
            )

    def tick(self) -> float:
        """Let a tenth of a second pass; return the seconds of work of the planner node.

        They include what the node does with a plan: it takes over a part with each event.
        """
        fleet = self.fleet
        fleet.now += 0.1
        for robot in self._progress:
            self._move(robot)
        poses = [(robot, self._serialized(robot)) for robot in self._progress]
        reports = [fleet.report(robot) for robot in self._progress]
        made, self._made = self._made, None
        began = thread_time()
        if made is not None:
            self.send(fleet.planner.handle(made, fleet.now))
        for robot, pose in poses:
            event = read_pose_seen(robot, self._poses.deserialize(pose))
            self.send(fleet.planner.handle(event, fleet.now))
        for report in reports:
            self.send(fleet.planner.handle(report, fleet.now))
        self.send(fleet.planner.handle(Tick(), fleet.now))
        changes = fleet.planner.take_changes()
        if changes is not None:
            fields = changes_fields(STARTED, changes, changes.sequence, fleet.now)
            self._changes.serialize(self._changes.new(**fields))
        took = thread_time() - began
        if fleet.requests:  # The process beside the node makes the plan: its answer comes with the next tick.
            self._made = PlanMade(compute_plan(fleet.requests.pop(), self.made_by))
        return took

    def settle(self) -> None:
        """Take over the plan that was made last, and all that follow from it."""
        if self._made is not None:
            self.send(self.fleet.planner.handle(self._made, self.fleet.now))
            self._made = None
        self.plan()

    def _serialized(self, robot: str) -> bytes:
        """Return the robot's pose as it comes over the network."""
        x, y = self.fleet.places[robot]
        pose = {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}
        return bytes(self._poses.serialize(self._poses.new(pose={"pose": pose})))

    def send(self, instructions: list[Any]) -> None:
        """Serialize lists of cells as the planner node does, and note requested plans."""
        for instruction in instructions:
            if isinstance(instruction, SendCells):
                self.fleet.revisions[instruction.robot] = instruction.revision, instruction.cells
                fields = numbered_array(instruction.cells, instruction.revision)
                self.sent += len(self._lists.serialize(self._lists.new(**fields)))
            elif isinstance(instruction, MakePlan):
                self.fleet.requests.append(instruction.request)

    def _move(self, robot: str) -> None:
        """Drive a robot towards its next granted cell: a cell in two seconds."""
        fleet = self.fleet
        granted = fleet.planner.state.ledger.granted(robot)
        if len(granted) < 2:
            self._progress[robot] = 0.0
            return
        self._progress[robot] += 0.05
        grid = fleet.planner.state.grid
        (x, y), (to_x, to_y) = grid.centre(granted[0]), grid.centre(granted[1])
        share = min(self._progress[robot], 1.0)
        fleet.places[robot] = x + share * (to_x - x), y + share * (to_y - y)
        self._progress[robot] %= 1.0


def tick_times(traffic: Traffic, count: int, ticks: int) -> dict[str, Any]:
    """Measure ticks."""
    gc.collect()
    gc.freeze()
    took = [traffic.tick() for _ in range(ticks)]
    gc.unfreeze()
    return {
        "robots": count,
        "p50 ms": round(1e3 * percentile(took, 0.5), 1),
        "p99 ms": round(1e3 * percentile(took, 0.99), 1),
        "limit, p99 ms": TICK_LIMIT_MS,
    }


def block_times(traffic: Traffic, count: int, times: int) -> list[dict[str, Any]]:
    """Block cells that lie beyond many robots' granted cells, one after another."""
    fleet, rows = traffic.fleet, []
    ledger = fleet.planner.state.ledger
    gc.collect()
    gc.freeze()  # as the node and its process for plans do
    for _ in range(times):
        traffic.settle()
        users: dict[int, set[str]] = {}
        claimed: set[int] = set()
        goals = {record.goal for record in fleet.planner.state.robots.values()}
        for robot in fleet.places:
            claimed |= ledger.claims(robot)
            for cell in ledger.route(robot):
                users.setdefault(cell, set()).add(robot)
        choices = [cell for cell in users if cell not in claimed and cell not in goals]
        if not choices:
            break
        cell = traffic.rng.choice(
            sorted(choices, key=lambda choice: -len(users[choice]))[: len(choices) // 2 + 1]
        )
        concerned = users[cell]
        began, began_wall, plans = thread_time(), perf_counter(), 0
        traffic.send(fleet.planner.handle(CellBlocked(cell), fleet.now))
        traffic.send(fleet.planner.handle(Tick(), fleet.now))
        while fleet.requests or fleet.planner.is_taking_over():
            if fleet.requests:
                plans += 1
                fleet.tell(PlanMade(compute_plan(fleet.requests.pop(), traffic.made_by)))
            else:
                fleet.tell(Tick())
        rows.append(
            {
                "robots": count,
                "concerned": len(concerned),
                "without a path": sum(
                    1 for robot in concerned if ledger.length(robot) == len(ledger.granted(robot))
                ),
                "plans for all": plans,
                "ms": round(1e3 * (thread_time() - began), 1),
                "wall ms": round(1e3 * (perf_counter() - began_wall), 1),
                "limit, ms": BLOCK_LIMIT_MS,
            }
        )
        for _ in range(5):
            traffic.tick()
    gc.unfreeze()
    return rows


def memory(count: int, planner: str) -> dict[str, Any]:
    """Measure what a fleet takes in the planner, without messages."""
    gc.collect()
    tracemalloc.start()
    traffic = Traffic(count, planner)
    gc.collect()
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    route = sum(traffic.fleet.planner.state.ledger.length(robot) for robot in traffic.fleet.places) / count
    return {"robots": count, "kB per robot": round(size / count / 1e3, 1), "cells per path": round(route)}


def measure(*, quick: bool, planner: str) -> None:
    """Run all suites."""
    results = Results("traffic", quick=quick)
    sizes = (10, 50) if quick else (10, 100, 1000)
    ticks, blocks = [], []
    for count in sizes:
        traffic = Traffic(count, planner)
        ticks.append(tick_times(traffic, count, 100 if quick else 300))
        blocks += block_times(traffic, count, 5 if quick else 20)
    show(f"Tick of the planner node, planner {planner}", ticks)
    show("From a blocked cell to the last new path, without the wait for the process", blocks)
    results.begin("memory")
    sizes_of = [memory(count, planner) for count in sizes[:2]]
    show("Memory of the planner", sizes_of)
    if planner == DEFAULT_PLANNER:
        for name, rows in (("tick", ticks), ("block", blocks), ("memory", sizes_of)):
            results.keep(name, rows)
        print("results:", results.save())


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.traffic", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small fleets only")
    parser.add_argument(
        "--planner", default=DEFAULT_PLANNER, help="planner to measure with; results of others are not saved"
    )
    options = parser.parse_args()
    measure(quick=options.quick, planner=options.planner)


if __name__ == "__main__":
    main()
