"""Measure the localization: ``python -m benchmarks.localization [--quick] [--runs N] [--only NAME ...]``.

``update``: CPU time of an update (500 particles, 60 beams), numpy and compiled. ``lidar`` and ``camera``:
accuracy from a first pose on. ``global``: from anywhere on the map. ``kidnapped``: after the robot was put
somewhere else. Robot and world are the simulation's, the floor is the demo's; one box in ten is on no map.
Results are saved after every ten runs, so that a measurement that is stopped keeps them; the performance
page takes those of all runs only.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from statistics import mean, median
from time import process_time
from typing import Any

import numpy as np

from benchmarks.figures import Results, show
from benchmarks.floor import Floor
from benchmarks.localization.runs import (
    KIDNAPPED_AT,
    KIDNAPPED_FOR,
    Run,
    globally,
    kidnapped,
    track,
)
from rce_fleet.compiled import compile_kernels
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.amcl import Amcl
from rce_fleet.localization.parameters import AmclParameters, LaserModel

Rows = list[dict[str, Any]]

FIRST_SEED = 1000
RUNS, QUICK_RUNS = 100, 10
SAVE_EVERY = 10
UPDATES = 400


def update_times() -> Iterator[Rows]:
    """Measure updates in numpy, then compiled."""
    rows: Rows = []
    for form, limit in (("numpy", 0.8), ("compiled", 0.25)):
        if form == "compiled" and not compile_kernels():
            print("numba is not installed: only numpy is measured")
            break
        row: dict[str, Any] = {"form": form}
        for model in (LaserModel.LIKELIHOOD_FIELD, LaserModel.LIKELIHOOD_FIELD_PROB):
            times = _times(model)
            row[f"{model} ms"] = min(times)
            row[f"{model} p50 ms"] = median(times)
        rows.append(row | {"target ms": limit})
        yield rows


def _times(model: LaserModel) -> list[float]:
    parameters = AmclParameters(
        min_particles=500,
        max_particles=500,
        laser_max_beams=60,
        laser_model_type=model,
        resample_interval=1,
    )
    floor = Floor(FIRST_SEED)
    amcl = Amcl(floor.map, parameters, np.random.default_rng(FIRST_SEED))
    amcl.set_pose(floor.robot.pose, np.diag((0.01, 0.01, 0.002)))
    scan = floor.scan()
    times = []
    for number in range(UPDATES):
        amcl.request_update()
        begin = process_time()
        amcl.update(Pose(0.01 * (number % 2), 0.0, 0.0), scan)
        times.append(1e3 * (process_time() - begin))
    return times[10:]


def made(name: str, one: Callable[[int], Run], runs: int) -> Iterator[list[Run]]:
    """Make runs of the seeds 1000, 1001, ...; yield all so far after every ten and at the end."""
    results: list[Run] = []
    for number in range(runs):
        results.append(one(FIRST_SEED + number))
        if results[-1].contacts:
            print(f"{name}: seed {FIRST_SEED + number}: {results[-1].contacts} contacts")
        if len(results) % SAVE_EVERY == 0 or len(results) == runs:
            yield results


def accuracy(name: str, one: Callable[[int], Run], runs: int, limit_m: float) -> Iterator[Rows]:
    """Give errors over seeded runs from a first pose on, with a row of the targets."""
    for results in made(name, one, runs):
        positions = [result.rmse_m for result in results]
        worst = positions.index(max(positions))
        measured = {
            "sensor": name,
            "runs": len(results),
            "position RMSE m": median(positions),
            "worst run m": max(positions),
            "worst seed": FIRST_SEED + worst,
            "heading RMSE deg": median(result.rmse_deg for result in results),
            "NEES": mean(mean(result.nees) for result in results),
            "particles": mean(mean(result.particles) for result in results),
        }
        target = {
            "sensor": "target",
            "runs": RUNS,
            "position RMSE m": limit_m,
            "worst run m": 0.25,
            "worst seed": "",
            "heading RMSE deg": 1.5,
            "NEES": "1 .. 6",
            "particles": "",
        }
        yield [measured, target]


def shares(
    name: str, one: Callable[[int], Run], runs: int, limits: tuple[float, float, float]
) -> Iterator[Rows]:
    """Give the share of runs whose pose is right in time, with a row of the targets.

    Args:
        name: How the runs begin.
        one: Makes a run.
        runs: How many.
        limits: When the time begins and how long it is, seconds; share that the target asks for, percent.
    """
    begin, seconds, share = limits
    for results in made(name, one, runs):
        times = [result.right_after - begin for result in results]
        late = [FIRST_SEED + number for number, time in enumerate(times) if time >= seconds]
        measured = {
            "robot": name,
            "runs": len(results),
            "right in time %": 100 * (1 - len(late) / len(results)),
            "within s": seconds,
            "p50 s": median(times),
            "p95 s": float(np.quantile(times, 0.95)),
            "late seeds": " ".join(map(str, late)),
        }
        target = {"robot": "target", "runs": RUNS, "right in time %": share, "within s": seconds}
        yield [measured, target | {"p50 s": "", "p95 s": "", "late seeds": ""}]


def suites(runs: int) -> dict[str, tuple[str, Callable[[], Iterator[Rows]]]]:
    """What can be measured, by name."""
    return {
        "update": ("CPU time of an update", update_times),
        "lidar": ("Accuracy with a lidar", lambda: accuracy("lidar", track("lidar"), runs, 0.05)),
        "camera": (
            "Accuracy with a depth camera",
            lambda: accuracy("depth camera", track("camera"), runs, 0.10),
        ),
        "global": (
            "Global localization",
            lambda: shares("anywhere", globally, runs, (0.0, 30.0, 95.0)),
        ),
        "kidnapped": (
            "Kidnapped robots",
            lambda: shares("kidnapped", kidnapped, runs, (KIDNAPPED_AT, KIDNAPPED_FOR, 90.0)),
        ),
    }


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.localization", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RUNS} runs instead of {RUNS}")
    parser.add_argument("--runs", type=int, help="number of seeded runs")
    parser.add_argument("--only", nargs="+", choices=suites(1), default=[], metavar="NAME")
    options = parser.parse_args()
    runs = options.runs or (QUICK_RUNS if options.quick else RUNS)
    results = Results("localization", quick=runs < RUNS)
    for name, (title, suite) in suites(runs).items():
        if not options.only or name in options.only:
            results.begin(name)
            rows: Rows = []
            for rows in suite():
                results.keep(name, rows, unfinished=True)
                results.save()
            results.keep(name, rows)
            show(title, rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
