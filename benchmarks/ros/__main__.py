"""Measure the ROS graph: ``python -m benchmarks.ros [--quick] [--only NAME ...]``."""

from __future__ import annotations

import argparse
import contextlib
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import uvloop

from benchmarks.figures import RESULTS, Results, plot_round_trips, show
from benchmarks.ros import suites
from benchmarks.ros.sides import sides
from benchmarks.ros.tools import tools

PORT = 21311


@contextlib.contextmanager
def our_master(port: int) -> Iterator[str]:
    """Our core as the program that users run."""
    argv = [str(Path(sys.executable).parent / "rce"), "core", "--port", str(port), "--no-log"]
    process = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    try:
        assert "ready" in process.stdout.readline()
        yield f"http://127.0.0.1:{port}/"
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(10)
        process.stdout.close()


def measure(names: list[str], *, quick: bool, scratch: Path) -> None:
    """Run the chosen suites."""
    found = sides(scratch)
    print("measured:", ", ".join(side.name for side in found))
    seconds = 2.0 if quick else 5.0
    results = Results("ros", quick=quick)
    with our_master(PORT) as uri, suites.real_master(PORT + 1) as other:
        masters = {"ours": uri} | ({"rosmaster": other} if other else {})
        chosen: dict[str, tuple[str, Callable[[], suites.Rows]]] = {
            "echo": (
                "Topic echo, std_msgs/String",
                lambda: suites.echo(uri, found, passes=1 if quick else 3, quick=quick),
            ),
            "rate": ("Message rate", lambda: suites.rate(uri, found, seconds=seconds)),
            "fanout": (
                "One publisher, many subscribers",
                lambda: uvloop.run(suites.fanout(uri, found, subscribers=50, seconds=seconds)),
            ),
            "services": ("Service calls", lambda: suites.services(uri, found, seconds=seconds)),
            "registration": (
                "Registration",
                lambda: uvloop.run(suites.registration(masters, nodes=50 if quick else 500)),
            ),
            "joining": (
                "Nodes in one process",
                lambda: uvloop.run(suites.joining(uri, nodes=50 if quick else 500)),
            ),
            "tools": (
                "Command line tools at either master",
                lambda: tools(masters, passes=2 if quick else 7),
            ),
            "memory": ("An idle node's process", lambda: suites.memory(uri, found)),
            "packages": (
                "Search of a package path",
                lambda: suites.packages(scratch / "workspace", folders=1000 if quick else 10_000),
            ),
        }
        for name in names or chosen:
            title, suite = chosen[name]
            results.begin(name)
            rows = suite()
            show(title, rows)
            results.keep(name, rows)
            if name == "echo":
                print("plot:", shutil.move(plot_round_trips(rows), RESULTS / "ros.svg"))
    print("results:", results.save())


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ros", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer sizes, nodes and seconds")
    words = ("echo", "rate", "fanout", "services", "registration", "joining", "tools", "memory", "packages")
    parser.add_argument("--only", nargs="+", choices=words, default=[], metavar="NAME")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        measure(arguments.only, quick=arguments.quick, scratch=Path(scratch))


if __name__ == "__main__":
    main()
