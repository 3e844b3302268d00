"""Measure mapping on recorded logs: ``python -m benchmarks.mapping [--only LOG ...] [--scans N]``.

Needs the folder of public logs (``RCE_DATA``). Scores are those of the data's ``score_trajectory.py``,
against published reference poses, with dead reckoning beside them. ``walls x`` is the number of occupied
cells of 5 cm over that of the map drawn with the reference's poses. ``scans/s`` is by processor time, reading
included. ``amcl`` follows the robot on the map that ``gmapping`` made of the same log. ``--figures DIR``
draws the maps beside each other. ``--split N`` only maps each log as if N robots had driven its parts at
the same time: ``slam_graph`` has to find where they meet, and their trajectories are scored as one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.figures import Results, show
from rce_fleet.compiled import compile_kernels
from rce_fleet.geometry.poses import Pose, relative
from rce_fleet.localization.replay import replay
from rce_fleet.mapping.gmapping.mapper import ParticleMapper
from rce_fleet.mapping.graph.mapper import GraphMapper
from rce_fleet.mapping.occupancy_mapping import draw_map
from rce_fleet.mapping.trajectory import odometry_of, read_trajectory, write_trajectory
from rce_fleet.offline.commands import CORRECTED, corrected
from rce_fleet.offline.inputs import read_log

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rce_fleet.mapping.mapper import Mapper
    from rce_fleet.mapping.records import LaserRecord
    from rce_fleet.maps.occupancy_map import OccupancyMap

    Poses = NDArray[np.float64]

Row = dict[str, Any]

LOGS = ("intel", "freiburg-079")
MAPPERS: dict[str, Callable[[], Mapper]] = {"gmapping": ParticleMapper, "graph": GraphMapper}
TARGETS: list[Row] = [
    {"with": "gmapping", "steps m": 0.07, "deg": 1.5, "revisits m": 0.20, "rev. deg": 2.0},
    {"with": "graph", "steps m": 0.05, "deg": 1.0, "revisits m": 0.10, "rev. deg": 1.0},
]
WALLS_TARGET, RATE_TARGET = 1.05, 50
AMCL_TARGET = {"aligned m": 0.10, "deg": 1.5}


def data() -> Path:
    """Return the folder of public data."""
    return Path(os.environ.get("RCE_DATA", Path(__file__).parents[2] / "shared" / "data"))


def score(name: str, times: list[float], poses: Poses, number: int) -> Row:
    """Return the figures of a trajectory, by the data's own program."""
    with tempfile.TemporaryDirectory() as folder:
        made, cut = Path(folder) / "made.csv", Path(folder) / "reference.csv"
        write_trajectory(made, times, poses)
        lines = (data() / "lidar" / f"{name}.ref.csv").read_text().splitlines(keepends=True)
        cut.write_text("".join(lines[: number + 1]))
        argv = [sys.executable, str(data() / "score_trajectory.py"), str(cut), str(made)]
        found = json.loads(subprocess.run(argv, check=True, capture_output=True, text=True).stdout)
    none = (float("nan"), 0.0)
    steps, revisits = found["steps"], found["revisits"]
    return {
        "steps m": steps.get("m", none)[0],
        "deg": steps.get("deg", none)[0],
        "revisits m": revisits.get("m", none)[0],
        "rev. deg": revisits.get("deg", none)[0],
        "aligned m": found["aligned_rmse_m"],
    }


def measure(name: str, number: int | None) -> tuple[list[Row], dict[str, OccupancyMap]]:
    """Map one log with everything; return a row for each, and the maps."""
    path = data() / "lidar" / f"{name}.raw.log.gz"
    begin = process_time()
    log = read_log(path)
    reading = process_time() - begin
    records = log.records[:number]
    times = [record.time for record in records]
    _, reference = read_trajectory(data() / "lidar" / f"{name}.ref.csv")
    sharp = int(draw_map(records, reference[: len(records)]).occupied.sum())
    odometry = odometry_of(records)
    found = {"dead reckoning": relative(odometry[0], odometry)}
    seconds = {"dead reckoning": 0.0}
    for each, make in MAPPERS.items():
        found[each], seconds[each] = run(make(), records)
    maps = {each: draw_map(records, poses) for each, poses in found.items()}
    rows = []
    for each, poses in found.items():
        rate = len(records) / (seconds[each] + reading) if seconds[each] else 0.0
        walls = int(maps[each].occupied.sum()) / sharp
        rows.append(
            {"log": name, "with": each, **score(name, times, poses, len(records))}
            | {"walls x": walls, "scans/s": rate}
        )
    begin = process_time()
    followed = np.array(
        [
            each.pose.as_array()
            for each in replay(corrected(records), maps["gmapping"], CORRECTED, start=Pose(0, 0, 0))
        ]
    )
    rate = len(records) / (process_time() - begin)
    rows.append(
        {"log": name, "with": "amcl", **score(name, times, followed, len(records))}
        | {"walls x": "", "scans/s": rate}
    )
    return rows, maps


def run(mapper: Mapper, records: list[LaserRecord]) -> tuple[Poses, float]:
    """Return the trajectory and the processor time."""
    begin = process_time()
    for record in records:
        mapper.add(record)
    mapper.finish()
    return mapper.trajectory(), process_time() - begin


def measure_split(name: str, count: int, number: int | None) -> Row:
    """Map one log with several robots, each of which drives a part of it; return the row."""
    records = read_log(data() / "lidar" / f"{name}.raw.log.gz").records[:number]
    parts = [part.tolist() for part in np.array_split(np.arange(len(records)), count)]
    robots = [f"robot {index}" for index in range(count)]
    mapper = GraphMapper()
    begin = process_time()
    joined_after = 0
    for step in range(max(map(len, parts))):
        for robot, part in zip(robots, parts, strict=True):
            if step < len(part):
                mapper.add(records[part[step]], robot)
        if not all(map(mapper.is_joined, robots)):
            joined_after = step + 1
    mapper.finish()
    seconds = process_time() - begin
    poses = np.concatenate([mapper.trajectory(robot) for robot in robots])
    return {
        "log": name,
        "robots": count,
        "joined": sum(map(mapper.is_joined, robots)),
        "joined after scans": joined_after,
        **score(name, [record.time for record in records], poses, len(records)),
        "scans/s": len(records) / seconds,
    }


def with_targets(rows: list[Row]) -> list[Row]:
    """Return the rows, and those of the targets below."""
    empty = dict.fromkeys(rows[0], "")
    targets = [*TARGETS, {"with": "amcl", **AMCL_TARGET}]
    return [
        *rows,
        *(
            empty | {"log": "target"} | target | {"walls x": WALLS_TARGET, "scans/s": RATE_TARGET}
            for target in targets
        ),
    ]


def plot(name: str, maps: dict[str, OccupancyMap], folder: Path) -> Path:
    """Draw the maps beside each other."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(maps), figsize=(3.2 * len(maps), 3.4))
    for axis, (title, drawn) in zip(axes, maps.items(), strict=True):
        shades = np.full(drawn.data.shape, 205, np.uint8)
        shades[drawn.free] = 254
        shades[drawn.occupied] = 0
        axis.imshow(shades, cmap="gray", vmin=0, vmax=255, origin="lower", interpolation="antialiased")
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    figure.tight_layout()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"map-{name}.png"
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})
    return path


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mapping", description=__doc__)
    parser.add_argument(
        "--only", nargs="+", choices=LOGS, default=LOGS, metavar="LOG", help="saves nothing unless it is all"
    )
    parser.add_argument("--scans", type=int, help="only the first scans of each log; saves nothing")
    parser.add_argument("--figures", type=Path, help="folder for pictures of the maps")
    parser.add_argument(
        "--split", type=int, metavar="N", help="map with N robots that drive parts of the log"
    )
    options = parser.parse_args()
    if not data().is_dir():
        parser.exit(1, f"the folder of public logs is absent: {data()}; set RCE_DATA\n")
    compile_kernels()
    if options.split:
        split = [measure_split(name, options.split, options.scans) for name in options.only]
        show(f"Mapping with {options.split} robots", split)
        return
    results = Results("mapping")
    rows: list[Row] = []
    for name in options.only:
        found, maps = measure(name, options.scans)
        rows += found
        show(f"Mapping of {name}", with_targets(found))
        if options.figures:
            print("picture:", plot(name, maps, options.figures))
    # Scores of a part say nothing about a log, and rows of one log would replace those of all.
    if options.scans is None and set(options.only) == set(LOGS):
        results.keep("mapping", rows)
        print("results:", results.save())


if __name__ == "__main__":
    main()
