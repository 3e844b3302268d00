"""What a program of one robot sees of another robot and can do to it; what one more robot needs.

Each robot has a machine of its own. The program that reaches for the other robot runs on robot 1's machine,
or in its container, where there is one. In MMS each machine of a robot shares the robot's scans, as in the
paper: services are not mentioned, and so all are shared, as by fkie's ``master_sync``.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from rce_fleet.experiments.bench import SERVER, Bench
from rce_fleet.experiments.experiment import Experiment, Measured, Options, Trial
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.streaming import told
from rce_fleet.experiments.systems.base import Flow, Layout, Workload, core_uri
from rce_fleet.experiments.workloads.reach import TOLD_TO_END
from rce_fleet.experiments.workloads.robot_base import CALLED, ENDED, MOVED, SCAN
from rce_fleet.experiments.workloads.telling import reports

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.experiments.results import Condition
    from rce_fleet.experiments.systems.base import RunningWorkload, System

AT_ONCE = 4
"""Runs wait for programs to start, and only count."""
SECONDS = 8.0
PATIENCE_S = 30.0
POLL_S = 0.2
COUNT = "count"
DEEDS = {"can_publish": MOVED, "can_call": CALLED, "can_end_nodes": ENDED}
"""What robot 1's program can do, by what robot 2's tells then."""
ROBOTS = (1, 2)


class Isolation(Experiment):
    """Two robots in the three systems."""

    name = "isolation"
    title = "what a robot's program sees of another robot and can do to it; files and lines to add a robot"
    programs = ("listener", "reach", "robot_base")
    at_once = AT_ONCE

    def setups(self, options: Options) -> list[Condition]:
        """Return a set-up for each system and software; quickly, with the first software only."""
        return self.each(options, software=options.software[:1] if options.quick else None)

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        del setup, options
        return SECONDS

    def warm_up_seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long the run takes that does not count: there is none."""
        del setup, options
        return 0.0

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once."""
        if trial.is_warm_up:
            return []
        async with Bench(clients=len(ROBOTS), seed=trial.seed) as bench:
            layout = Layout(robots=len(ROBOTS), containers="each", own_machines=True)
            system = trial.system(bench, layout)
            base = await start(system)
            place = SERVER if system.has_containers else layout.machine_of(1)
            core = core_uri(bench.address(SERVER if system.has_one_core else layout.machine_of(2)))
            reach = await system.run(Workload("reach", "reach", ("2", core), place))
            seen = await told(reach, PATIENCE_S)
            suffered = await deeds(base, PATIENCE_S if is_ended(seen) else 0.0)
        return trial.measured([*reached(seen, suffered), *to_add(system.wiring(2))])


async def start(system: System) -> RunningWorkload:
    """Start two robots, whose scans are heard on the server; return the second one's program."""
    flows = [Flow(f"/Robot{robot}/scan", SCAN, robot=robot) for robot in ROBOTS]
    listeners = [
        Workload(f"listener{flow.robot}", "listener", (f"{flow.topic}={flow.kind}",), SERVER, flow.robot)
        for flow in flows
    ]
    bases = [
        Workload(f"base{robot}", "robot_base", (str(robot),), system.layout.machine_of(robot), robot)
        for robot in ROBOTS
    ]
    running = await system.start(flows, [*listeners, *bases])
    for listener in running[: len(listeners)]:
        await listener.wait_ready()
    return running[-1]


def is_ended(seen: list[dict[str, object]]) -> bool:
    """Return whether robot 1's program told nodes of robot 2 to end."""
    return any(report.get(TOLD_TO_END) for report in seen)


async def deeds(base: RunningWorkload, patience: float) -> list[dict[str, object]]:
    """Return what robot 2's program told, once it has told its end or after some seconds.

    Who tells a node to end is answered before it ends.
    """
    deadline = time.monotonic() + patience
    while True:
        told_so_far = list(reports(await base.lines()))
        if any(ENDED in report for report in told_so_far) or time.monotonic() >= deadline:
            return told_so_far
        await asyncio.sleep(POLL_S)


def reached(seen: list[dict[str, object]], suffered: list[dict[str, object]]) -> list[Value]:
    """Return what robot 1's program saw and did, from what it and robot 2's told."""
    counts = {
        name: value
        for report in seen
        for name, value in report.items()
        if isinstance(value, int) and name != TOLD_TO_END
    }
    found = [Value(name, float(value), COUNT) for name, value in counts.items()]
    happened = {name for report in suffered for name in report}
    return [*found, *(Value(name, float(deed in happened), COUNT) for name, deed in DEEDS.items())]


def to_add(files: Mapping[str, str] | None) -> list[Value]:
    """Return how much has to be written for one more robot; nothing if that is not known (None)."""
    if files is None:
        return []
    lines = sum(len(text.splitlines()) for text in files.values())
    return [Value("files_to_add", float(len(files)), COUNT), Value("lines_to_add", float(lines), COUNT)]
