"""Measure exploration: ``python -m benchmarks.exploration [--quick] [--runs N] [--with gmapping graph]``.

A TurtleBot with a lidar explores the demo's floor from the starts of seeds 1, 2, ...: frontiers, the parts of
``move_base`` and of the safety stage, and a mapper, in simulated time and with the parameters of
``configs/turtlebot``. The map is compared with the true walls. Results with one mapper only, or with another
sensor, are not saved.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from math import pi
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, Protocol

import numpy as np
import yaml

from benchmarks.figures import Results, show
from rce_fleet.compiled import compile_kernels
from rce_fleet.drivers.scene import load_scene
from rce_fleet.drivers.scene_items import RobotStart
from rce_fleet.geometry.poses import Pose
from rce_fleet.mapping.gmapping.filter import GridFilter
from rce_fleet.mapping.gmapping.parameters import FilterParameters
from rce_fleet.mapping.graph.mapper import GraphMapper
from rce_fleet.mapping.occupancy_mapping import map_of
from rce_fleet.mapping.records import LaserRecord
from rce_fleet.maps.agreement import MapAgreement, compare_maps
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.observation import observe_scan
from rce_fleet.navigation.exploration.explorer import Action, Explorer, ExplorerParameters
from rce_fleet.navigation.exploration.frontiers import find_frontiers
from rce_fleet.navigation.move_base.core import Ending
from rce_fleet.navigation.move_base.situation import Situation
from rce_fleet.navigation.move_base.stack import NavigationStack
from rce_fleet.navigation.safety.limiter import VelocityLimiter
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.navigation.safety.seen import Scan
from rce_fleet.nodes.move_base_parameters import read_settings
from rce_fleet.nodes.parameter_values import read_values

Rows = list[dict[str, Any]]

FOLDER = Path(__file__).parent.parent / "configs"
RUNS, QUICK_RUNS = 10, 2
ALGORITHMS = ("gmapping", "graph")
TICK = 0.02
SAFETY_EVERY, CONTROL_EVERY, GLOBAL_EVERY = 2, 5, 25
"""In ticks: 25 Hz safety, 10 Hz control and scans, 2 Hz global costmap and frontiers."""
GIVE_UP = 300.0
ROBOT = "Robot1"
TARGETS = {"explored %": 99.0, "right %": 99.0, "walls mm": 25.0, "contacts": 0}


class Mapper(Protocol):
    """Makes a map while a robot drives."""

    def add(self, record: LaserRecord) -> None:
        """Use a scan."""

    def pose(self) -> Pose:
        """Return where the robot is on the map."""

    def draw(self) -> OccupancyMap:
        """Return the map."""


class Gmapping:
    """``slam_gmapping``."""

    def __init__(self, values: dict[str, Any], seed: int) -> None:
        parameters, _ = read_values(FilterParameters, values, unused=("map_update_interval",))
        self._filter = GridFilter(parameters, np.random.default_rng(seed))

    def add(self, record: LaserRecord) -> None:
        """Use a scan."""
        self._filter.add(record)

    def pose(self) -> Pose:
        """Return where the robot is on the map."""
        return Pose.from_array(self._filter.estimate)

    def draw(self) -> OccupancyMap:
        """Return the map."""
        return map_of(self._filter.store, self._filter.best)


class Graph:
    """``slam_graph``."""

    def __init__(self) -> None:
        self._mapper = GraphMapper()

    def add(self, record: LaserRecord) -> None:
        """Use a scan."""
        self._mapper.add(record)

    def pose(self) -> Pose:
        """Return where the robot is on the map."""
        return Pose.from_array(self._mapper.pose())

    def draw(self) -> OccupancyMap:
        """Return the map."""
        return self._mapper.occupancy_map()


@dataclass
class RunResult:
    """What came of a run.

    Attributes:
        seconds: Simulated time from the start to the end of the exploration.
        done: Whether the exploration ended by itself.
        goals: How many goals were chosen.
        failed: Goals that ``move_base`` gave up, or without progress.
        driven: Length of the robot's way, metres.
        contacts: Contacts by its own motion.
        agreement: The map beside the true walls.
        mapping: CPU time of the mapper for each scan, seconds.
        drawing: CPU time of each map, seconds.
        searching: CPU time of each search for frontiers, seconds.
    """

    seconds: float = 0.0
    done: bool = False
    goals: int = 0
    failed: int = 0
    driven: float = 0.0
    contacts: int = 0
    agreement: MapAgreement = field(default_factory=lambda: MapAgreement(0.0, 0.0, 0.0, 0.0))
    mapping: list[float] = field(default_factory=list)
    drawing: list[float] = field(default_factory=list)
    searching: list[float] = field(default_factory=list)


class Exploration:
    """One robot on the demo's floor that explores."""

    def __init__(self, seed: int, mapper: Mapper, sensor: str = "lidar") -> None:
        scene = load_scene(FOLDER / "scene.yaml")
        rng = np.random.default_rng(seed)
        cell = int(rng.choice(scene.grid.free))
        start = RobotStart(id=ROBOT, cell=cell, yaw=float(rng.uniform(-pi, pi)), sensor=sensor)
        scene = scene.model_copy(update={"robots": (start,), "seed": seed})
        self.true = scene.draw()
        self.world = scene.build()
        self.robot = self.world.robots[ROBOT]
        self.start = self.robot.pose
        self.mapper = mapper
        values = yaml.safe_load((FOLDER / "turtlebot" / "move_base.yaml").read_text())
        settings, problems = read_settings(values)
        assert not problems, problems
        self.stack = NavigationStack(settings)
        explore = yaml.safe_load((FOLDER / "turtlebot" / "explore.yaml").read_text())
        self.parameters, _ = read_values(ExplorerParameters, explore)
        self.explorer = Explorer(self.parameters)
        self.limiter = VelocityLimiter(SafetyParameters(), Footprint(self.robot.radius))
        self.known: OccupancyMap | None = None
        self.drawn_at = 0.0
        self.odom_at_scan = self.robot.odometry
        self.result = RunResult()

    def run(self, give_up: float = GIVE_UP) -> RunResult:
        """Explore until it is done."""
        world, result, tick = self.world, self.result, 0
        while world.time < give_up:
            if tick % CONTROL_EVERY == 0:
                self._sense(tick)
                if tick % GLOBAL_EVERY == 0 and self._explore():
                    result.done = True
                    break
                self._control()
            if tick % SAFETY_EVERY == 0:
                self.limiter.take_pose(self.robot.odometry, world.time)
                self.robot.drive(self.limiter.limit(world.time).twist)
            world.step(TICK)
            tick += 1
        result.seconds, result.driven = world.time, self.robot.distance
        result.contacts = world.collisions.own_motion
        result.goals = self.explorer.goals
        result.failed = sum(reason != "was visited" for _, reason in self.explorer.over)
        made = self.mapper.draw()
        made = replace(made, origin=self.start.compose(made.origin))
        result.agreement = compare_maps(made, self.true)
        return result

    def map_from_odom(self) -> Pose:
        """Return the odometry's frame on the map."""
        return self.mapper.pose().compose(self.odom_at_scan.inverse())

    def _sense(self, tick: int) -> None:
        now, lidar, odometry = self.world.time, self.robot.model.lidar, self.robot.odometry
        ranges = np.nan_to_num(self.world.scan(ROBOT), nan=0.0, posinf=np.inf)
        mount = Pose(lidar.x, lidar.y, lidar.yaw)
        record = LaserRecord(
            tick,
            now,
            np.where(ranges > 0, ranges, np.nan),
            lidar.angle_min,
            lidar.increment,
            lidar.max_range,
            (odometry.x, odometry.y, odometry.yaw),
            (mount.x, mount.y, mount.yaw),
        )
        began = process_time()
        self.mapper.add(record)
        self.result.mapping.append(process_time() - began)
        self.odom_at_scan = odometry
        limits = (lidar.min_range, lidar.max_range)
        moved = self.map_from_odom()
        for costmap, frame in (
            (self.stack.local_costmap, Pose(0.0, 0.0, 0.0)),
            (self.stack.global_costmap, moved),
        ):
            assert costmap.obstacles is not None
            source = costmap.parameters.sources["scan"]
            sensor = frame.compose(odometry).compose(mount)
            seen = observe_scan(ranges, lidar.angle_min, lidar.increment, limits, sensor, source, now)
            costmap.obstacles.take("scan", seen)
        self.limiter.take_scan(
            Scan(now, odometry.compose(mount), ranges, lidar.angle_min, lidar.increment, lidar.min_range)
        )

    def _explore(self) -> bool:
        """Draw the map, and decide; return whether the exploration is over."""
        now, at = self.world.time, self.mapper.pose()
        if self.known is None or now - self.drawn_at >= 1.0:
            began = process_time()
            self.known, self.drawn_at = self.mapper.draw(), now
            self.result.drawing.append(process_time() - began)
            self.stack.global_costmap.set_map(self.known)
        self.stack.update_global(at, now)
        began = process_time()
        search = find_frontiers(self.known, at, self.parameters)
        self.result.searching.append(process_time() - began)
        action = self.explorer.update(search, self.drawn_at, now)
        if action is Action.DRIVE:
            self.stack.core.start(now)
        return action is Action.DONE

    def _control(self) -> None:
        now, moved = self.world.time, self.map_from_odom()
        situation = Situation(
            now=now,
            dt=CONTROL_EVERY * TICK,
            pose=self.robot.odometry,
            measured=self.robot.wheels.wheels,
            local_from_global=moved.inverse(),
        )
        decision = self.stack.control(situation)
        self.limiter.take_command(decision.twist, now)
        target = self.explorer.target
        if decision.wants_plan and target is not None:
            plan = self.stack.plan(self.stack.snapshot(), moved.compose(self.robot.odometry), target.goal)
            self.stack.core.take_plan(plan, now)
        if decision.ending is Ending.SUCCEEDED:
            self.explorer.reached(now)
        elif decision.ending is not None:
            self.explorer.failed(decision.text, now)


def run(seed: int, algorithm: str, sensor: str = "lidar") -> RunResult:
    """Explore the demo's floor from the start of a seed."""
    values = yaml.safe_load((FOLDER / "turtlebot" / "gmapping.yaml").read_text())
    mapper: Mapper = Graph() if algorithm == "graph" else Gmapping(values, seed)
    return Exploration(seed, mapper, sensor).run()


def measure(runs: int, algorithm: str, sensor: str) -> Rows:
    """Explore from the starts of seeds 1, 2, ...."""
    results = []
    for seed in range(1, runs + 1):
        one = run(seed, algorithm, sensor)
        results.append(one)
        print(
            f"seed {seed}: {one.seconds:.0f} s, {one.goals} goals, {one.failed} failed, {one.driven:.1f} m,"
            f" {one.agreement.as_json()}{'' if one.done else ', not done'}"
        )
    agreements = [one.agreement for one in results]
    return [
        {
            "with": algorithm,
            "sensor": sensor,
            "runs": runs,
            "done": sum(one.done for one in results),
            "s, median": median(one.seconds for one in results),
            "s, worst": max(one.seconds for one in results),
            "driven m": median(one.driven for one in results),
            "goals": median(one.goals for one in results),
            "failed": sum(one.failed for one in results),
            "contacts": sum(one.contacts for one in results),
            "explored %": 100 * min(one.explored for one in agreements),
            "right %": 100 * min(one.right for one in agreements),
            "walls mm": 1e3 * max(one.wall_error_m for one in agreements),
            "walls p95 mm": 1e3 * max(one.wall_error_p95_m for one in agreements),
            "map ms / scan": 1e3
            * sum(sum(one.mapping) for one in results)
            / sum(len(one.mapping) for one in results),
            "map ms": 1e3 * max(max(one.drawing) for one in results),
            "frontiers ms": 1e3 * max(median(one.searching) for one in results),
        }
    ]


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.exploration", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RUNS} runs")
    parser.add_argument("--runs", type=int, default=RUNS, help="how many starts")
    parser.add_argument("--with", dest="algorithms", nargs="+", choices=ALGORITHMS, default=ALGORITHMS)
    parser.add_argument("--sensor", default="lidar", choices=("lidar", "depth_camera"))
    options = parser.parse_args()
    compile_kernels()
    runs = QUICK_RUNS if options.quick else options.runs
    results = Results("exploration", quick=runs < RUNS)
    rows = [row for name in options.algorithms for row in measure(runs, name, options.sensor)]
    show(
        "Exploration of the demo's floor",
        [*rows, {key: TARGETS.get(key, "") for key in rows[0]} | {"with": "target"}],
    )
    if options.sensor == "lidar" and set(options.algorithms) == set(ALGORITHMS):
        results.keep("exploration", rows)
        print("results:", results.save())


if __name__ == "__main__":
    main()
