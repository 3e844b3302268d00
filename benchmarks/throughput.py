"""Measure what settings of the planner are worth: ``python -m benchmarks.throughput [--quick] [--robots N]``.

It needs no engine. Light robots, which turn and accelerate, drive on aisles-33-46 from goal to goal. A table
has the goals that they reach with each choice of settings, and with the planner ``dijkstra`` as the baseline.
Plans take no time of the world, and effort ends all searches, so the same seed gives the same run.

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
from rce_fleet.planning.planner import INDEPENDENT

_MAP = "aisles-33-46.map"
_ROBOTS = 100
"""Robots of the figures on the performance page."""
_EFFORT = 100_000
"""States of the searches for better paths: what compiled loops need some 15 ms for."""
_PLAIN = FleetSettings(robot_radius=ROBOT_RADIUS)
_TURNING = replace(_PLAIN, improve_seconds=inf, quarter_turn=0.8, stop=0.4)
CHOICES = {
    "paths as planned": _PLAIN,
    "better paths": replace(_PLAIN, improve_seconds=inf),
    "better paths, with turns": _TURNING,
    "the same, learned congestion": replace(_TURNING, learn_congestion=True),
    "shortest paths": replace(_PLAIN, planner=INDEPENDENT),
    "shortest paths, deadlocks resolved": replace(_PLAIN, planner=INDEPENDENT, resolve_deadlocks=True),
}
"""Settings by name; those with the planner ``dijkstra`` are the baseline."""


class LimitedFleet(Fleet):
    """A fleet in which effort ends all searches, whatever the machine."""

    def limited(self, request: PlanRequest) -> PlanRequest:
        """Return a request whose searches end by its effort."""
        effort = _EFFORT if request.improve_seconds else request.effort
        return replace(request, effort=effort, search_seconds=0.0)


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
    parser.add_argument("--robots", type=int, default=_ROBOTS, help="size of the fleet")
    options = parser.parse_args()
    compile_kernels()
    results = Results("throughput", quick=options.quick)
    seconds, seeds = (60.0, (1,)) if options.quick else (300.0, (1, 2, 3))
    rows: list[dict[str, Any]] = []
    for name, settings in CHOICES.items():
        goals = [measure(settings, options.robots, seed, seconds) for seed in seeds]
        per_hour = sum(goals) * 3600 / (seconds * len(seeds))
        rows.append(
            {
                "planner": settings.planner,
                "settings": name,
                "robots": options.robots,
                "goals": goals,
                "per hour": round(per_hour),
            }
        )
    show(f"Goals that robots reach in {seconds:.0f} s, by seed", rows)
    results.keep("goals", rows, unfinished=options.robots != _ROBOTS)
    print("results:", results.save())


if __name__ == "__main__":
    main()
