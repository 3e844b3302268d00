"""Measure what better queues are worth: ``python -m benchmarks.batches [--quick]``. It needs no engine.

Deliveries on aisles-33-46 are all created at once. Robots drive the shortest ways, a cell of one metre a
second, through each other: what is measured are the choices of tasks, not traffic. With batches, queues are
improved every five seconds; the world waits for the search. Without them nothing depends on the machine's
speed; with them a little does, as the search ends by its processor time.

The map is that of the benchmarks, in the folder ``RCE_DATA``.
"""

from __future__ import annotations

import argparse
from random import Random
from time import process_time
from typing import Any

import numpy as np

from benchmarks.figures import Results, data, show
from rce_fleet.compiled import compile_kernels
from rce_fleet.nodes.batch_worker import SEARCH_S
from rce_fleet.planning.movingai import read_map
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.dispatch import Dispatcher, TaskRules
from rce_fleet.tasks.facts import FleetFacts, RobotFacts
from rce_fleet.tasks.matching import MATCHING_KERNELS
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import RobotProfile
from rce_fleet.tasks.routing import improve
from rce_fleet.tasks.travel import TravelCosts
from rce_fleet.tasks.travel_loops import measure_ways

_MAP = "aisles-33-46.map"
EVERY_S = 5
FLEETS = ((8, 40), (20, 100), (50, 250))
"""Robots and deliveries."""
SEEDS = (1, 2, 3)


class Run:
    """A fleet and its deliveries.

    Args:
        robots: How many.
        deliveries: How many.
        seed: Seed of places.
        batches: Whether queues are improved.

    Attributes:
        moved: Tasks that got other robots.
        searched: Processor time of the search, seconds.
        longest: Longest time that making a batch took, seconds.
    """

    def __init__(self, robots: int, deliveries: int, seed: int, *, batches: bool) -> None:
        grid = read_map(data() / "maps" / _MAP)
        random, free = Random(seed), sorted(grid.reachable(grid.free[len(grid.free) // 2]))
        self._batches = batches
        self._book = TaskBook()
        self._book.grid = grid
        self._facts = FleetFacts(grid=grid, shut=grid.blocked, is_live=True)
        self._dispatcher = Dispatcher(self._book, TaskRules(profile=RobotProfile(speed=1.0)))
        self._ways = TravelCosts()
        self._ways.set_map(grid, grid.blocked, {}, 1)
        for number, cell in enumerate(random.sample(free, robots), 1):
            name = f"Robot{number}"
            self._facts.robots[name] = RobotFacts(name, "idle", cell=cell, moved_at=0.0)
        for _ in range(deliveries):
            pick, deliver = random.sample(free, 2)
            stops = Stop(Action.PICK, (pick,), 2.0), Stop(Action.DELIVER, (deliver,), 2.0)
            self._book.create(Order(stops), 0.0)
        self.moved, self.searched, self.longest = 0, 0.0, 0.0

    def row(self) -> dict[str, Any]:
        """Do all deliveries; return when they were done."""
        now = 0
        while self._book.open_count:
            now += 1
            self._dispatcher.update(now, self._facts)
            self._drive(float(now))
            self._book.take_events()
            if self._batches and now % EVERY_S == 0:
                self._improve(float(now))
        ended = [task.changed_at for task in self._book.tasks.values()]
        return {"all done, s": now, "mean, s": round(float(np.mean(ended)), 1)}

    def _improve(self, now: float) -> None:
        began = process_time()
        batch = self._dispatcher.batch(now, self._facts)
        self.longest = max(self.longest, process_time() - began)
        if batch is None:
            return
        began = process_time()
        routes = improve(batch.problem, SEARCH_S * len(batch.problem.weights))
        self.searched += process_time() - began
        if routes is not None:
            self.moved += len(batch.moves(routes))
            self._dispatcher.adopt(batch, routes)

    def _drive(self, now: float) -> None:
        grid, goals = self._facts.grid, self._dispatcher.goals()
        assert grid is not None
        for robot in self._facts.robots.values():
            goal = goals.get(robot.id)
            if goal != robot.goal:
                robot.goal, robot.moved_at = goal, now
            if goal is not None and robot.cell is not None and goal != robot.cell:
                left = self._ways.field(goal)
                robot.cell = min(grid.neighbours[robot.cell], key=left.__getitem__)
                robot.moved_at = now
            robot.state = "idle" if goal is None else "arrived" if robot.cell == goal else "driving"


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.batches", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small fleet")
    options = parser.parse_args()
    compile_kernels([*MATCHING_KERNELS, measure_ways])
    results = Results("batches", quick=options.quick)
    rows = []
    for robots, deliveries in FLEETS[:1] if options.quick else FLEETS:
        for batches in (False, True):
            runs = [Run(robots, deliveries, seed, batches=batches) for seed in SEEDS]
            found = [run.row() for run in runs]
            means = {key: round(float(np.mean([row[key] for row in found])), 1) for key in found[0]}
            row = {"robots": robots, "deliveries": deliveries, "batches": "yes" if batches else "no", **means}
            row["moved"] = sum(run.moved for run in runs) / len(runs)
            seconds = sum(row["all done, s"] for row in found)
            row["search, % of a core"] = round(100 * sum(run.searched for run in runs) / seconds, 1)
            row["making one, most ms"] = round(1e3 * max(run.longest for run in runs), 1)
            rows.append(row)
    show(f"Deliveries done with and without better queues, means of {len(SEEDS)} seeds", rows)
    results.keep("queues", rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
