"""Measure how tasks are given to robots: ``python -m benchmarks.assignment [--quick]``. It needs no engine.

``choose``: as many idle robots and waiting deliveries on warehouse-10-20-10-2-1; the time of all costs and of
the assignment with the smallest sum, the least of some. ``new grid``: the distances to all stops are measured
first, in slices between which the manager answers; the longest slice and all of them.

Times are those of the processor that the thread used, so that other load does not count. The map is that of
MovingAI's benchmarks, in the folder ``RCE_DATA``.
"""

from __future__ import annotations

import argparse
from random import Random
from time import thread_time
from typing import Any

import numpy as np

from benchmarks.figures import Results, show
from benchmarks.traffic import warehouse
from rce_fleet.compiled import compile_kernels
from rce_fleet.tasks.assignment import Assigner, AssignmentRules, FreeRobot
from rce_fleet.tasks.energy import BatteryLevels
from rce_fleet.tasks.matching import MATCHING_KERNELS, cheapest_pairs
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import RobotProfile
from rce_fleet.tasks.task import Task
from rce_fleet.tasks.travel import TravelCosts
from rce_fleet.tasks.travel_loops import measure_ways

LIMITS_MS = {100: 5.0, 1000: 60.0}
SLICE_LIMIT_MS = 50.0
"""The manager answers after this time at the latest."""
REPEATS = 7


def measure(count: int) -> dict[str, Any]:
    """Give as many deliveries as there are robots to all of them."""
    grid, random = warehouse(), Random(count)
    free = [cell for cell in range(len(grid)) if cell not in grid.blocked]
    travel = TravelCosts()
    travel.set_map(grid, grid.blocked, {}, 1)
    assigner = Assigner(travel, AssignmentRules(), BatteryLevels())
    profile = RobotProfile()
    robots = [
        FreeRobot(f"Robot{number}", cell, profile, 0.9)
        for number, cell in enumerate(random.sample(free, count), 1)
    ]
    tasks = [
        Task(number, Order((Stop(Action.PICK, (pick,)), Stop(Action.DELIVER, (drop,)))), "", "", 0.0, 0.0)
        for number, (pick, drop) in enumerate(
            zip(random.sample(free, count), random.sample(free, count), strict=True), 1
        )
    ]
    times, slices = [], []
    cells = sorted({cell for task in tasks for cell in task.order.cells()})
    for first in range(0, len(cells), travel.at_once):
        began = thread_time()
        travel.measure(cells[first : first + travel.at_once])
        slices.append(1e3 * (thread_time() - began))
    for _ in range(REPEATS):
        began = thread_time()
        chosen = assigner.choose(tasks, robots, 60.0, (free[0],))
        times.append(1e3 * (thread_time() - began))
    costs = np.random.default_rng(count).uniform(0.0, 300.0, (count, count))
    began = thread_time()
    cheapest_pairs(costs)
    return {
        "robots": count,
        "tasks": count,
        "chosen": len(chosen),
        "ms": round(min(times), 2),
        "solver alone, ms": round(1e3 * (thread_time() - began), 2),
        "limit, ms": LIMITS_MS[count],
        "new grid, longest slice ms": round(max(slices), 1),
        "limit, slice ms": SLICE_LIMIT_MS,
        "new grid, ms": round(sum(slices)),
    }


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.assignment", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="100 robots only")
    options = parser.parse_args()
    compile_kernels([*MATCHING_KERNELS, measure_ways])
    results = Results("assignment", quick=options.quick)
    rows = [measure(count) for count in ((100,) if options.quick else (100, 1000))]
    show("Tasks for idle robots", rows)
    results.keep("choose", rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
