"""Measure navigation: ``python -m benchmarks.navigation [--quick] [--runs N] [--only NAME ...]``.

``drive``: seeded runs on the demo's floor in the simulation, with localization, ``move_base`` and safety
stage, among walkers and boxes of which some are on no map, against the targets; saved after every ten runs,
of which the performance page takes none before all are made.
``sampling``: the same runs with the two ways to choose trajectories, by time and smoothness. ``plan``: a plan
on a costmap of 400 x 400 cells, compiled and in numpy.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from statistics import median
from time import process_time
from typing import Any

import numpy as np

from benchmarks.figures import Results, percentile, show
from benchmarks.navigation.drive import RunResult, run
from rce_fleet.compiled import compile_kernels
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.layered import LayeredCostmap
from rce_fleet.navigation.costmap.parameters import (
    CostmapParameters,
    InflationParameters,
    StaticLayerParameters,
)
from rce_fleet.navigation.planners.cost_to_go import spread
from rce_fleet.navigation.planners.global_planner import make_plan

Rows = list[dict[str, Any]]

FIRST_SEED = 1000
RUNS, QUICK_RUNS = 200, 10
SAVE_EVERY = 10
TARGETS = {"contacts": 0, "reached %": 99.0, "path / shortest": 1.15, "step p99 ms": 10.0}
SIDE = 400


def drive(runs: int, sampling: str = "pursuit") -> Iterator[Rows]:
    """Drive robots on floors of seeds 1000, 1001, ...; give the figures so far after every ten runs."""
    results: list[RunResult] = []
    seed = FIRST_SEED
    while len(results) < runs:
        result = run(seed, sampling=sampling)
        if result.shortest:  # there is a way for the robot's footprint
            results.append(result)
            if not result.reached or result.contacts:
                print(f"seed {seed}: {result.text}; {result.contacts} contacts", flush=True)
            if len(results) % SAVE_EVERY == 0 or len(results) == runs:
                yield [figures(results, sampling)]
        seed += 1


def figures(results: list[RunResult], sampling: str) -> dict[str, Any]:
    """Return the row of some runs."""
    steps = [step for result in results for step in result.steps]
    reached = [result for result in results if result.reached] or results
    return {
        "sampling": sampling,
        "runs": len(results),
        "contacts": sum(result.contacts for result in results),
        "walked into": sum(result.pushed for result in results),
        "reached %": 100 * sum(result.reached for result in results) / len(results),
        "path / shortest": median(result.driven / result.shortest for result in reached),
        "step p50 ms": 1e3 * percentile(steps, 0.5),
        "step p99 ms": 1e3 * percentile(steps, 0.99),
        "s / m": median(result.seconds / result.shortest for result in reached),
        "turning rad/s/m": median(result.turning for result in reached),
        "jerk m/s3": median(result.jerk for result in reached),
        "localization RMSE m": median(result.error for result in results),
        "recoveries": sum(result.recoveries for result in results),
    }


def with_targets(rows: Rows) -> Rows:
    """Return rows with a row of the targets below."""
    return [*rows, {name: TARGETS.get(name, "") for name in rows[0]} | {"sampling": "target"}]


def compare(runs: int) -> Iterator[Rows]:
    """Drive the same runs with both ways to choose trajectories."""
    first: Rows = []
    for first in drive(runs, "pursuit"):
        yield first
    for second in drive(runs, "window"):
        yield [*first, *second]


def plan(repeats: int) -> Iterator[Rows]:
    """Measure a plan across a costmap with boxes, compiled and in numpy."""
    rng = np.random.default_rng(1)
    picture = np.zeros((SIDE, SIDE), np.int8)
    for row, column in rng.integers(20, SIDE - 30, (40, 2)):
        picture[row : row + 12, column : column + 12] = 100
    parameters = CostmapParameters(
        static_layer=StaticLayerParameters(), inflation_layer=InflationParameters()
    )
    costmap = LayeredCostmap(parameters, Footprint(0.187))
    costmap.set_map(OccupancyMap(picture, 0.05))
    costmap.update(Pose(0.0, 0.0, 0.0), 0.0)
    rows: Rows = []
    for form, use in (("numpy", spread.use_numpy), ("compiled", spread.use_compiled)):
        use()
        times = []
        for _ in range(repeats):
            began = process_time()
            made = make_plan(costmap.grid, Pose(1.0, 1.0, 0.0), Pose(18.5, 18.7, 0.0))
            times.append(process_time() - began)
        length = float(np.hypot(*np.diff(made.path[:, :2], axis=0).T).sum())
        rows.append({"form": form, "cells": SIDE * SIDE, "best ms": 1e3 * min(times), "path m": length})
    yield rows


def suites(*, quick: bool, runs: int) -> dict[str, tuple[str, Callable[[], Iterator[Rows]]]]:
    """What can be measured, by name."""
    return {
        "plan": ("A plan on 400 x 400 cells", lambda: plan(5 if quick else 20)),
        "drive": ("Seeded runs among boxes and walkers", lambda: drive(runs)),
        "sampling": ("Pure pursuit and dynamic window", lambda: compare(max(runs // 4, 3))),
    }


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.navigation", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RUNS} runs")
    parser.add_argument("--runs", type=int, default=RUNS, help="how many worlds with a way to the goal")
    parser.add_argument("--only", nargs="+", choices=suites(quick=True, runs=1), default=[], metavar="NAME")
    options = parser.parse_args()
    compile_kernels()
    chosen = suites(quick=options.quick, runs=QUICK_RUNS if options.quick else options.runs)
    results = Results("navigation", quick=options.quick or options.runs < RUNS)
    for name in options.only or chosen:
        title, suite = chosen[name]
        results.begin(name)
        shown: Rows = []
        for rows in suite():
            shown = rows if name == "plan" else with_targets(rows)
            results.keep(name, shown, unfinished=True)
            results.save()
        results.keep(name, shown)
        show(title, shown)
    print("results:", results.save())


if __name__ == "__main__":
    main()
