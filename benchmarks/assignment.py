"""Measure how tasks are given to robots: ``python -m benchmarks.assignment [--quick]``. It needs no engine.

``choose``: so many idle robots and waiting deliveries on warehouse-10-20-10-2-1; the time of all costs and of
the assignment with the smallest sum. ``first`` computes the distances to all stops too, as after a change of
the map; ``ms`` is a step after that, the least of some.

Times are those of the processor that the thread used, so that other load does not count. The map is that of
MovingAI's benchmarks, in the folder ``RCE_DATA``; without it, shelves of the same shape are drawn.
"""

from __future__ import annotations

import argparse
from random import Random
from time import thread_time
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.figures import save, show
from benchmarks.traffic import warehouse
from rce_fleet.tasks.assignment import Assigner, AssignmentRules, FreeRobot
from rce_fleet.tasks.energy import BatteryLevels
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.records import RobotProfile
from rce_fleet.tasks.task import Task
from rce_fleet.tasks.travel import TravelCosts

LIMITS_MS = {100: 5.0, 1000: 60.0}
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
    times = []
    for _ in range(REPEATS + 1):
        began = thread_time()
        chosen = assigner.choose(tasks, robots, 60.0, (free[0],))
        times.append(1e3 * (thread_time() - began))
    costs = np.random.default_rng(count).uniform(0.0, 300.0, (count, count))
    began = thread_time()
    linear_sum_assignment(costs)
    return {
        "robots": count,
        "tasks": count,
        "chosen": len(chosen),
        "first, ms": round(times[0], 1),
        "ms": round(min(times[1:]), 2),
        "solver alone, ms": round(1e3 * (thread_time() - began), 2),
        "limit, ms": LIMITS_MS[count],
    }


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.assignment", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="100 robots only")
    options = parser.parse_args()
    rows = [measure(count) for count in ((100,) if options.quick else (100, 1000))]
    show("Tasks for idle robots", rows)
    print("results:", save("assignment", {"choose": rows}))


if __name__ == "__main__":
    main()
