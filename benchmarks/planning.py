"""Measure planners on MovingAI maps: ``python -m benchmarks.planning [--quick]``.

The maps are in the folder ``maps`` of ``$RCE_DATA``. Every plan is checked by the independent checker. Times
of first plans are the minimum of several runs; figures with more time take ten seconds each.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.figures import save, show
from rce_fleet.compiled import compile_kernels
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.fields import distance_fields
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.lifelong import LIFELONG_KERNELS, LifelongPlanner
from rce_fleet.planning.movingai import read_map, read_scenario
from rce_fleet.planning.planner import PlanningProblem

WAREHOUSE, RANDOM, AISLES = "warehouse-10-20-10-2-1", "random-32-32-20", "aisles-33-46"
FIRST = ((WAREHOUSE, 1000, 150, 3.3), (WAREHOUSE, 400, 50, None), (RANDOM, 400, 25, None))
"""Map, robots, milliseconds and cost over lower bound at most."""
ANYTIME = ((WAREHOUSE, 400, 1.08), (WAREHOUSE, 1000, 1.9), (RANDOM, 400, 2.26))
LIFELONG = ((100, 0.88), (140, 0.80))


def maps() -> Path:
    """The folder of the maps."""
    return Path(os.environ["RCE_DATA"]) / "maps"


def one_shot(name: str, robots: int, *, seconds: float, seed: int = 0) -> tuple[float, float]:
    """Plan; return the time of the plan, seconds, and its cost over the lower bound."""
    grid = read_map(maps() / f"{name}.map")
    rows = read_scenario(maps() / f"{name}-random-1.scen", grid, limit=robots)
    starts, goals = [row.start for row in rows], [row.goal for row in rows]
    planner = LacamPlanner()
    began = perf_counter()
    graph = PlanningGraph.from_grid(grid)
    joint = planner.plan(PlanningProblem.of(graph, starts, goals, seed=seed, seconds=seconds, rotations=True))
    took = perf_counter() - began
    faults = check_plan(grid, [joint.path(robot) for robot in range(robots)], starts=starts, goals=goals)
    if faults:
        raise RuntimeError(f"{name}, {robots} robots: {faults[0]}")
    bound = distance_fields(graph, goals)[np.arange(robots), starts].sum()
    return took, joint.cost / float(bound)


def first_plans(*, runs: int) -> list[dict[str, Any]]:
    """Time and quality of first plans."""
    rows = []
    for name, robots, limit, ratio in FIRST:
        found = [one_shot(name, robots, seconds=0.0, seed=seed) for seed in range(runs)]
        rows.append(
            {
                "map": name,
                "robots": robots,
                "ms": round(1e3 * min(took for took, _ in found), 1),
                "ms, at most": limit,
                "cost / bound, worst": max(quality for _, quality in found),
                "at most": ratio or "-",
            }
        )
    return rows


def anytime(*, seconds: float) -> list[dict[str, Any]]:
    """Quality after some time."""
    return [
        {
            "map": name,
            "robots": robots,
            "seconds": seconds,
            "cost / bound": one_shot(name, robots, seconds=seconds)[1],
            "at most": limit,
        }
        for name, robots, limit in ANYTIME
    ]


def lifelong(robots: int, limit: float, *, steps: int, seed: int) -> dict[str, Any]:
    """Tasks a step, over robots by mean distance between goals."""
    grid = read_map(maps() / f"{AISLES}.map")
    graph = PlanningGraph.from_grid(grid)
    rng = np.random.default_rng(seed)
    cells = np.array(grid.free, np.int32)
    planner = LifelongPlanner(
        graph,
        rng.choice(cells, robots, replace=False),
        lambda _, before: int(rng.choice(cells[cells != before])),
        seed=seed,
    )
    rows, longest = [planner.cells], 0.0
    for _ in range(steps):
        began = perf_counter()
        planner.step()
        longest = max(longest, perf_counter() - began)
        rows.append(planner.cells)
    if faults := check_plan(grid, np.stack(rows, axis=1).tolist()):
        raise RuntimeError(f"lifelong, {robots} robots: {faults[0]}")
    fields = distance_fields(graph, np.arange(len(graph), dtype=np.int32))
    legs = [
        fields[goal, before]
        for start, goals in zip(rows[0].tolist(), planner.goals, strict=True)
        for before, goal in zip([start, *goals], goals, strict=False)
    ]
    return {
        "robots": robots,
        "seed": seed,
        "tasks a step": len(legs) / steps,
        "share of robots / distance": float(np.mean(legs)) * len(legs) / steps / robots,
        "at least": limit,
        "longest step ms": round(1e3 * longest, 1),
    }


def measure(*, quick: bool) -> None:
    """Run all suites."""
    compile_kernels(LIFELONG_KERNELS)
    firsts = first_plans(runs=3 if quick else 9)
    show("First plans", firsts)
    better = anytime(seconds=2.0 if quick else 10.0)
    show("Plans with more time", better)
    runs = [
        lifelong(robots, limit, steps=100 if quick else 500, seed=seed)
        for robots, limit in LIFELONG
        for seed in range(1 if quick else 3)
    ]
    show("Lifelong", runs)
    print("results:", save("planning", {"first": firsts, "anytime": better, "lifelong": runs}))


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planning", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer runs, less time")
    options = parser.parse_args()
    if "RCE_DATA" in os.environ:
        measure(quick=options.quick)
    else:
        print("planners are measured on the maps of $RCE_DATA, which is not set")


if __name__ == "__main__":
    main()
