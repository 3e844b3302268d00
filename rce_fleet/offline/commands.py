"""``rce map LOG`` and ``rce localize LOG``."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from enum import StrEnum
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, assert_never

import numpy as np
import typer

from rce_fleet.exceptions import FleetError
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.parameters import AmclParameters
from rce_fleet.localization.replay import Recorded, replay
from rce_fleet.localization.scan import LaserScan
from rce_fleet.mapping.gmapping.filter import GridFilter
from rce_fleet.mapping.gmapping.parameters import FilterParameters
from rce_fleet.mapping.occupancy_mapping import draw_map
from rce_fleet.mapping.trajectory import write_trajectory
from rce_fleet.maps.ros_map import load_map, save_map
from rce_fleet.offline.inputs import read_log
from rce_fleet.offline.outputs import (
    compile_with_notice,
    output_folder,
    print_faults,
    with_progress,
    write_report,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rce_fleet.mapping.mapper import Mapper
    from rce_fleet.mapping.records import LaserRecord

INTERRUPTED = 130
"""Exit code after Ctrl-C, as of shells."""

CORRECTED = AmclParameters(
    odom_alpha1=0.05, odom_alpha2=0.05, odom_alpha3=0.05, odom_alpha4=0.05, laser_max_beams=60
)
"""AMCL's parameters for odometry corrected by matching scans: it errs less than ROS's defaults say."""

Log = Annotated[
    Path, typer.Argument(help="CARMEN log (also compressed with gzip) or ROS 1 bag.", show_default=False)
]
Output = Annotated[
    Path, typer.Option(help="Folder for the results; made if it does not exist.", show_default=False)
]
ScanTopic = Annotated[str, typer.Option("--scan", help="In a bag: topic of the scans.")]
OdometryTopic = Annotated[str, typer.Option("--odom", help="In a bag: topic of the odometry.")]
Seed = Annotated[int, typer.Option(min=0, help="The same seed gives the same result.")]


class Algorithm(StrEnum):
    """How the map is made."""

    GMAPPING = "gmapping"
    GRAPH = "graph"


def map_log(
    log: Log,
    output: Output,
    with_: Annotated[Algorithm, typer.Option("--with", help="How the map is made.")] = Algorithm.GRAPH,
    scan: ScanTopic = "/scan",
    odom: OdometryTopic = "/odom",
    seed: Seed = 0,
) -> None:
    """Make a map from a recorded log.

    Writes map.pgm, map.yaml, trajectory.csv (a row for each scan) and report.json to the output folder.
    """
    with _errors(), output_folder(output) as folder:
        mapper = _mapper(with_, seed)
        compile_with_notice(sys.stderr)
        begin = time.perf_counter()
        found = read_log(log, scan=scan, odometry=odom)
        print_faults(found.faults, sys.stderr)
        for record in with_progress(found.records, sys.stderr):
            mapper.add(record)
        mapper.finish()
        poses = mapper.trajectory()
        write_trajectory(folder / "trajectory.csv", [each.time for each in found.records], poses)
        save_map(draw_map(found.records, poses), folder / "map.yaml")
        write_report(
            folder / "report.json",
            seconds=time.perf_counter() - begin,
            log_seconds=found.seconds,
            scans=len(found.records),
            loop_closures=mapper.loop_closures,
        )
    typer.echo(f"{output}: map.pgm, map.yaml, trajectory.csv, report.json")


def localize(
    log: Log,
    map_: Annotated[Path, typer.Option("--map", help="map.yaml of the map.", show_default=False)],
    output: Output,
    initial_pose: Annotated[
        str, typer.Option(metavar="X,Y,THETA", help="Pose at the first scan: metres, radians.")
    ] = "0,0,0",
    global_: Annotated[
        bool, typer.Option("--global", help="The pose at the first scan is unknown: search the whole map.")
    ] = False,
    scan: ScanTopic = "/scan",
    odom: OdometryTopic = "/odom",
    seed: Seed = 0,
) -> None:
    """Localize a robot in a recorded log with AMCL.

    Writes trajectory.csv (a row for each scan) and report.json to the output folder.
    """
    start = None if global_ else _pose(initial_pose)
    with _errors(), output_folder(output) as folder:
        grid = load_map(map_)
        compile_with_notice(sys.stderr)
        begin = time.perf_counter()
        found = read_log(log, scan=scan, odometry=odom)
        print_faults(found.faults, sys.stderr)
        scans = corrected(with_progress(found.records, sys.stderr))
        followed = replay(scans, grid, CORRECTED, seed=seed, start=start)
        poses = [each.pose.as_array() for each in followed]
        write_trajectory(folder / "trajectory.csv", [each.time for each in found.records], np.array(poses))
        write_report(
            folder / "report.json",
            seconds=time.perf_counter() - begin,
            log_seconds=found.seconds,
            scans=len(found.records),
        )
    typer.echo(f"{output}: trajectory.csv, report.json")


def _pose(text: str) -> Pose:
    try:
        x, y, yaw = (float(each) for each in text.split(","))
    except ValueError:
        x = y = yaw = nan
    if not all(map(isfinite, (x, y, yaw))):
        raise typer.BadParameter(f"expected X,Y,THETA as three numbers, found {text!r}")
    return Pose(x, y, yaw)


def corrected(records: Iterable[LaserRecord]) -> Iterator[Recorded]:
    """Yield scans for AMCL, with odometry that was corrected by matching each scan with those before.

    Wheels slip, and some robots record backward motion as forward; AMCL's model of odometry has neither.
    """
    tracker = GridFilter(FilterParameters(particles=1), np.random.default_rng(0), keeps_way=False)
    for record in records:
        tracker.add(record)
        scan = LaserScan(
            record.ranges,
            record.angle_min,
            record.angle_increment,
            0.0,
            record.range_max,
            Pose(*record.laser),
        )
        yield Recorded(Pose.from_array(tracker.tracked), scan)


def _mapper(algorithm: Algorithm, seed: int) -> Mapper:
    match algorithm:
        case Algorithm.GMAPPING:
            from rce_fleet.mapping.gmapping.mapper import ParticleMapper

            return ParticleMapper(seed=seed)
        case Algorithm.GRAPH:
            from rce_fleet.mapping.graph.mapper import GraphMapper

            return GraphMapper()
        case _:
            assert_never(algorithm)


@contextmanager
def _errors() -> Iterator[None]:
    """End the program with a message instead of a traceback."""
    try:
        yield
    except FleetError as error:
        typer.echo(f"rce: {error}", err=True)
        raise typer.Exit(1) from error
    except KeyboardInterrupt:
        typer.echo("rce: interrupted; nothing was written", err=True)
        raise typer.Exit(INTERRUPTED) from None
