"""Measure what settings of the planner are worth: ``python -m benchmarks.throughput [--quick] [--robots N]``.

It needs no engine. Light robots, which turn and accelerate, drive on aisles-33-46 from goal to goal. A table
has the goals that they reach with each choice of settings. Plans take no time of the world, and effort ends
the search for better paths, so the same seed gives the same run.

The map is that of the benchmarks, in the folder ``RCE_DATA``.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from math import inf
from typing import Any

from benchmarks.figures import Results, data, show
from benchmarks.light import Fleet
from rce_fleet.compiled import compile_kernels
from rce_fleet.coordination.replanning import PlanRequest
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.demo.config import ROBOT_RADIUS
from rce_fleet.demo.worlds import NamedWorld
from rce_fleet.planning.movingai import read_map

_MAP = "aisles-33-46.map"
_EFFORT = 100_000
"""States of the searches for better paths: what compiled loops need some 15 ms for."""
_PLAIN = FleetSettings(robot_radius=ROBOT_RADIUS)
_TURNING = replace(_PLAIN, improve_seconds=inf, quarter_turn=0.8, stop=0.4)
CHOICES = {
    "paths as planned": _PLAIN,
    "better paths": replace(_PLAIN, improve_seconds=inf),
    "better paths, with turns": _TURNING,
    "the same, learned congestion": replace(_TURNING, learn_congestion=True),
}


class LimitedFleet(Fleet):
    """A fleet in which effort ends the search for better paths, whatever the machine."""

    def limited(self, request: PlanRequest) -> PlanRequest:
        """Return a request whose search for better paths ends by its effort."""
        return replace(request, effort=_EFFORT) if request.improve_seconds else request


def measure(settings: FleetSettings, count: int, seed: int, seconds: float) -> int:
    """Return the goals that a fleet reaches in a time, from the first goals on."""
    grid = read_map(data() / "maps" / _MAP)
    world = NamedWorld(grid, shelves=tuple(sorted(grid.reachable(grid.free[len(grid.free) // 2]))))
    fleet = LimitedFleet.make(count, world, replace(settings, seed=seed), seed)
    while len(fleet.goals) < count and fleet.robots.time < seconds:
        fleet.step()
    until, done = fleet.robots.time + seconds, fleet.done
    while fleet.robots.time < until:
        fleet.step()
    judge = fleet.robots.judge
    assert not judge.with_robots + judge.with_walls, "robots touched"
    return fleet.done - done


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.throughput", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one seed, and a minute of the world")
    parser.add_argument("--robots", type=int, default=100, help="size of the fleet")
    options = parser.parse_args()
    compile_kernels()
    results = Results("throughput", quick=options.quick)
    seconds, seeds = (60.0, (1,)) if options.quick else (300.0, (1, 2, 3))
    rows: list[dict[str, Any]] = []
    for name, settings in CHOICES.items():
        goals = [measure(settings, options.robots, seed, seconds) for seed in seeds]
        per_hour = sum(goals) * 3600 / (seconds * len(seeds))
        rows.append({"settings": name, "robots": options.robots, "goals": goals, "per hour": round(per_hour)})
    show(f"Goals that robots reach in {seconds:.0f} s, by seed", rows)
    results.keep("goals", rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
