"""Robots with Kinect-like scans: ``robots --control FILE NUMBER...`` publishes ``/RobotN/scan`` of each."""

from __future__ import annotations

import argparse
import math
import random
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .graph import open_graph
from .source import Source, Stream

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

SCAN = "sensor_msgs/LaserScan"
RAYS = 640
FIELD_OF_VIEW = math.radians(57.0)
RANGE = (0.45, 10.0)
SCENES = 16
"""Different scans of a robot, which come again and again."""


def scans(robot: int) -> Iterator[Mapping[str, Any]]:
    """Yield a robot's scans without end: a wall with a bump, and noise."""
    noise = random.Random(robot)  # noqa: S311 - not for secrets
    angles = [FIELD_OF_VIEW * (ray / (RAYS - 1) - 0.5) for ray in range(RAYS)]
    found = []
    for scene in range(SCENES):
        bump = FIELD_OF_VIEW * (scene / SCENES - 0.5)
        ranges = [
            (2.5 if abs(angle - bump) < 0.1 else 4.0) / math.cos(angle) + noise.gauss(0.0, 0.01)  # noqa: PLR2004
            for angle in angles
        ]
        found.append(
            {
                "angle_min": angles[0],
                "angle_max": angles[-1],
                "angle_increment": FIELD_OF_VIEW / (RAYS - 1),
                "scan_time": 1.0 / 30.0,
                "range_min": RANGE[0],
                "range_max": RANGE[1],
                "ranges": ranges,
            }
        )
    return cycle(found)


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="robots", description=__doc__)
    parser.add_argument("--control", type=Path, required=True)
    parser.add_argument("numbers", type=int, nargs="+")
    options = parser.parse_args()
    graph = open_graph("robots")
    streams = [Stream(f"{n}", f"/Robot{n}/scan", SCAN, scans(n), last={}) for n in options.numbers]
    graph.run(Source(graph, streams, options.control).step)


if __name__ == "__main__":
    main()
