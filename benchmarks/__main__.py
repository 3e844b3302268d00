"""Measure the engine: ``python -m benchmarks [--quick] [--only NAME ...]``."""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import uvloop

from benchmarks import (
    abuse,
    bridge,
    containers,
    failover,
    fanout,
    joining,
    latched,
    node_states,
    offload,
    rate,
    roundtrip,
    sandboxes,
    stalled,
    tls,
)
from benchmarks.engine import RunningEngine, engine
from benchmarks.figures import Results, plot_round_trips, show
from benchmarks.targets import RATIOS

Rows = list[dict[str, Any]]

ROOT = Path(__file__).resolve().parent.parent

OTHERS = {
    "robots": (
        ("localization", "--only", "update"),
        ("navigation", "--only", "plan"),
        ("simulation",),
        ("mapping", "--only", "intel", "--scans", "400"),
    ),
    "fleet": (
        ("light",),
        ("fleet",),
        ("traffic",),
        ("throughput",),
        ("assignment",),
        ("batches",),
        ("planning",),
        ("station",),
    ),
    "day": (("day",),),
    "scale": (("scale",), ("store",)),
}
"""Other programs by part; each prints and saves its own figures. Those of :data:`WITHOUT_ENGINE` need no
engine, or start their own."""
WITHOUT_ENGINE = ("fleet", "day", "scale")
ALWAYS_SHORT = ("mapping",)
"""Programs without an option ``--quick``."""


def suites(*, quick: bool) -> dict[str, tuple[str, Callable[[RunningEngine], Awaitable[Rows]]]]:
    """What can be measured, by name."""
    sizes = tuple(RATIOS["converter"]) if quick else roundtrip.SIZES
    passes, seconds = (1, 3.0) if quick else (3, 10.0)
    return {
        "memory": (
            "Memory with one robot and one container with an echo node",
            lambda e: containers.memory(e, after=15.0 if quick else 60.0),
        ),
        "start": ("Container start", lambda e: containers.start_times(e, count=5 if quick else 20)),
        "sandboxes": (
            "Other ways into namespaces",
            lambda _: sandboxes.start_times(count=5 if quick else 20),
        ),
        "many": ("Many containers", lambda e: containers.many(e, count=10 if quick else 100)),
        "roundtrip": ("Round trip", lambda e: roundtrip.run(e, passes=passes, sizes=sizes)),
        "rate": ("Message rate", lambda e: rate.run(e, seconds=seconds)),
        "fanout": (
            "Fan-out",
            lambda e: fanout.run(e, clients=20 if quick else 200, rate=20.0, seconds=seconds),
        ),
        "joining": (
            "Robots join one container",
            lambda e: joining.run(e, robots=200 if quick else 1000),
        ),
        "failover": (
            "A robot task set ends, hangs or is drained, and its robots are at another one",
            lambda _: failover.run(robots=200, passes=1 if quick else 3),
        ),
        "states": (
            "Snapshots of a node's state, at a master with SQLite",
            lambda _: node_states.run(count=5 if quick else 30),
        ),
        "abuse": (
            "Beside another user's abuse",
            lambda e: abuse.run(e, seconds=5.0 if quick else 20.0),
        ),
        "bridge": ("rce-ros on a robot", lambda e: bridge.run(e, seconds=seconds)),
        "tls": ("TLS on the robot's connection", lambda e: tls.run(e, passes=passes)),
        "latched": (
            "A robot comes late to latched maps",
            lambda e: latched.run(e, passes=1 if quick else 5),
        ),
        "stalled": ("One client stops reading", lambda e: stalled.run(e, seconds=seconds)),
        "robots": (
            "A robot's nodes on the robot, and in its container",
            lambda e: offload.run(e, seconds=15.0 if quick else 60.0),
        ),
    }


async def measure_engine(
    chosen: dict[str, tuple[str, Callable[[RunningEngine], Awaitable[Rows]]]], runtime: str, *, quick: bool
) -> None:
    """Run suites on one engine."""
    results = Results("engine", quick=quick or runtime == "process")
    async with engine(runtime) as running:
        for name, (title, suite) in chosen.items():
            results.begin(name)
            rows = await suite(running)
            show(title, rows)
            results.keep(name, rows)
            path = results.save()  # what was measured stays if a later suite fails
            if name == "roundtrip":
                print("plot:", plot_round_trips(rows))
    print("results:", path)


async def measure(names: list[str], *, quick: bool, runtime: str) -> int:
    """Run the chosen suites, and the programs that belong to them; return how many programs failed."""
    failed = 0
    chosen = suites(quick=quick)
    parts = names or [*chosen, *WITHOUT_ENGINE]
    of_engine = [name for name in parts if name in chosen]
    if of_engine:
        await measure_engine({name: chosen[name] for name in of_engine}, runtime, quick=quick)
    for part in parts:
        for program, *options in OTHERS.get(part, ()):
            short = ["--quick"] if quick and program not in ALWAYS_SHORT else []
            argv = [sys.executable, "-m", f"benchmarks.{program}", *options, *short]
            other = await asyncio.create_subprocess_exec(*argv, cwd=ROOT)
            if await other.wait():
                failed += 1
                print(f"benchmarks.{program} {' '.join(options)} failed", file=sys.stderr)
    return failed


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer sizes, clients and seconds")
    parser.add_argument(
        "--only", nargs="+", choices=[*suites(quick=True), *WITHOUT_ENGINE], default=[], metavar="NAME"
    )
    parser.add_argument("--runtime", default="auto", choices=("auto", "namespace", "process"))
    options = parser.parse_args()
    sys.exit(1 if uvloop.run(measure(options.only, quick=options.quick, runtime=options.runtime)) else 0)


if __name__ == "__main__":
    main()
