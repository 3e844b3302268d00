"""Measure planners on MovingAI maps: ``python -m benchmarks.planning [--quick] [--only NAME ...]``.

The maps are in the folder ``maps`` of ``$RCE_DATA``, or of ``shared/data`` beside the checkout. Every plan is
checked by the independent checker. Times of first plans are the least of nine seeds; figures with more
time take ten seconds each. ``large`` tiles the warehouse, and ``baseline`` is the planner ``dijkstra``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.figures import Results, data, own_memory, show
from rce_fleet.compiled import compile_kernels
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.fields import distance_fields
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.lifelong import LIFELONG_KERNELS, LifelongPlanner
from rce_fleet.planning.movingai import read_map, read_scenario
from rce_fleet.planning.planner import PlanningProblem, load_planner

WAREHOUSE, RANDOM, AISLES = "warehouse-10-20-10-2-1", "random-32-32-20", "aisles-33-46"
FIRST = ((WAREHOUSE, 1000, 150, 3.3), (WAREHOUSE, 400, 50, None), (RANDOM, 400, 25, None))
"""Map, robots, milliseconds and cost over lower bound at most."""
ANYTIME = ((WAREHOUSE, 400, 1.08), (WAREHOUSE, 1000, 1.9), (RANDOM, 400, 2.26))
LIFELONG = ((100, 0.88), (140, 0.80))
LARGE_S, LARGE_GB = 15.0, 4.0
"""Of the first plan for 10 000 robots."""
SUITES = ("first", "baseline", "anytime", "lifelong", "large")


def maps() -> Path:
    """Return the folder of the maps."""
    return data() / "maps"


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


def baseline(name: str = WAREHOUSE, robots: int = 1000) -> dict[str, Any]:
    """Plan with ``dijkstra``: each robot's shortest path, and the conflicts of these paths."""
    grid = read_map(maps() / f"{name}.map")
    rows = read_scenario(maps() / f"{name}-random-1.scen", grid, limit=robots)
    starts, goals = [row.start for row in rows], [row.goal for row in rows]
    planner = load_planner("dijkstra")
    began = perf_counter()
    joint = planner.plan(PlanningProblem.of(PlanningGraph.from_grid(grid), starts, goals))
    took = perf_counter() - began
    paths = [joint.path(robot) for robot in range(robots)]
    return {
        "map": name,
        "robots": robots,
        "ms": round(1e3 * took, 1),
        "conflicts": len(check_plan(grid, paths, starts=starts, goals=goals)),
    }


def tiled(name: str, times: int) -> GridMap:
    """Return a map without its outer wall beside and above itself, so many times each."""
    grid = read_map(maps() / f"{name}.map")
    free = np.zeros((grid.rows, grid.columns), bool)
    free.flat[grid.free] = True
    rows, columns = np.flatnonzero(free.any(axis=1)), np.flatnonzero(free.any(axis=0))
    whole = np.tile(free[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], (times, times))
    return GridMap(len(whole), len(whole[0]), blocked=frozenset(np.flatnonzero(~whole).tolist()))


def large(robots: int, times: int) -> dict[str, Any]:
    """Time and memory of the first plan for very many robots; run it in a process of its own."""
    grid = tiled(WAREHOUSE, times)
    rng = np.random.default_rng(robots)
    free = np.array(sorted(grid.reachable(grid.free[0])), np.int32)
    starts = rng.choice(free, robots, replace=False).tolist()
    goals = rng.choice(free, robots, replace=False).tolist()
    planner = LacamPlanner()
    began = perf_counter()
    graph = PlanningGraph.from_grid(grid)
    problem = PlanningProblem.of(graph, starts, goals, effort=4000 * robots, rotations=True)
    joint = planner.plan(problem)
    took = perf_counter() - began
    peak = own_memory("VmHWM") / 1e3
    if not joint.complete:
        raise RuntimeError(f"{robots} robots: no plan was found in {took:.1f} s")
    if faults := check_plan(grid, [joint.path(robot) for robot in range(robots)], starts=starts, goals=goals):
        raise RuntimeError(f"{robots} robots: {faults[0]}")
    return {
        "robots": robots,
        "cells": len(grid),
        "s": round(took, 1),
        "s, at most": LARGE_S,
        "peak GB": round(peak, 2),
        "GB, at most": LARGE_GB,
    }


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


def lifelong_runs(*, steps: int, seeds: int) -> list[dict[str, Any]]:
    """Lifelong runs of all sizes and seeds."""
    compile_kernels(LIFELONG_KERNELS)
    return [
        lifelong(robots, limit, steps=steps, seed=seed) for robots, limit in LIFELONG for seed in range(seeds)
    ]


def in_own_process(robots: int, times: int) -> list[dict[str, Any]]:
    """Measure :func:`large`."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return [pool.submit(large, robots, times).result()]


def measure(names: list[str], *, quick: bool) -> None:
    """Run the chosen suites."""
    suites: dict[str, tuple[str, Callable[[], list[dict[str, Any]]]]] = {
        "first": ("First plans", lambda: first_plans(runs=3 if quick else 9)),
        "baseline": ("Shortest paths, planner dijkstra", lambda: [baseline()]),
        "anytime": ("Plans with more time", lambda: anytime(seconds=2.0 if quick else 10.0)),
        "lifelong": (
            "Lifelong",
            lambda: lifelong_runs(steps=100 if quick else 500, seeds=1 if quick else 3),
        ),
        "large": ("Very many robots", lambda: in_own_process(*((2000, 2) if quick else (10_000, 3)))),
    }
    results = Results("planning", quick=quick)
    for name in names or SUITES:
        title, run = suites[name]
        results.begin(name)
        rows = run()
        show(title, rows)
        results.keep(name, rows)
    print("results:", results.save())


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planning", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer runs, less time")
    parser.add_argument(
        "--only", nargs="+", choices=SUITES, default=[], metavar="NAME", help=", ".join(SUITES)
    )
    options = parser.parse_args()
    measure(options.only, quick=options.quick)


if __name__ == "__main__":
    main()
