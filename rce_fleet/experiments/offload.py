"""A robot's tasks with its nodes on the robot, or in the cloud over links of several rates and delays.

* ``navigation``: drive to a goal 1 m ahead on a known map, with ``amcl`` and ``move_base``. Both make up
  one control loop, so they move together. The task is done when the robot stands at the goal.
* ``planning``: ask ``move_base`` for a plan across the floor; the time is that of one plan.
* ``mapping``: drive an arc of 2 s while ``slam_gmapping`` makes a map. The task is done when the mapper has
  used the scan that was taken at the end.

On the robot nothing crosses the link, so that it is measured with one link only. Links come in random order,
and each task begins at the same place with each of them, in both places: else a stretch of the floor would
count as a link's effect.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.drivers.robot_models import load_model
from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, SERVER, Bench, Reading
from rce_fleet.experiments.experiment import NETBOOK_CORES, Experiment, Link, Measured, Options, Trial
from rce_fleet.experiments.measures import Value, used
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.robot_energy import Effort, energy_of
from rce_fleet.experiments.robot_places import (
    CLOUD,
    MAPPING,
    NAVIGATION,
    RETURN,
    ROBOT,
    TaskRobot,
    write_packages,
)
from rce_fleet.experiments.systems.base import Layout, together
from rce_fleet.experiments.systems.cloud import Cloud
from rce_fleet.experiments.systems.software import software_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

PLANNING = "planning"
LINKS = (Link(50, 5), Link(50, 100), Link(0.5, 5), Link(0.3, 5))
"""The first one is the wireless LAN's; one has more delay, and two are as slow as what the robot sends."""
START = (2.5, 0.5)
"""Where each drive begins, looking along x: in the floor's lower corridor, away from its corners; metres."""
GOAL = {"x": 3.5, "y": 0.5, "yaw": 0.0}
"""Where each drive to a goal leads."""
FAR = {"x": 7.5, "y": 7.5, "yaw": 0.0}
"""Where plans lead."""
PLANS = 4
DRIVE_S = 2.0
ARC = {"speed": 0.3, "turn_rate": 0.6}
"""The arc of the mapper's drive, m/s and rad/s; the way back along it does not count."""
PATIENCE_S = 8.0
"""A task that is not done by then has failed: its time counts as this, and is more in truth."""
PLANS_S = 4.0
"""The same for the plans together."""
QUICK_PATIENCE_S = 60.0
"""The same for each task of a quick run, which shows that it can be done, also on a busy machine."""
READY_S = 60.0
ANSWERS = {NAVIGATION: "command", MAPPING: "pose"}
"""What is made of scans: the control delay is the time from a scan to the first of them that knows it."""
MODEL = "turtlebot2"
SETTLE_S = 0.3
"""From a change of the link, or of the share of a core, to the next task."""
BACK_S = {NAVIGATION: 1.5, MAPPING: 3.0}
"""About how long the way back to the start takes, for the plan."""
START_S = {ROBOT: 3.0, CLOUD: 8.0}
TASK_S = {NAVIGATION: 5.0, PLANNING: 1.5, MAPPING: 3.0}
"""About how long all takes, for the plan."""


class Offload(Experiment):
    """Tasks on the robot and in the cloud."""

    name = "offload"
    title = "AMCL, mapping and planning on a robot's netbook or in the cloud, over several links"

    def setups(self, options: Options) -> list[Condition]:
        """Return both places, if the Cloud Robotics System and our software are to be measured."""
        if "cloud" not in options.systems or "rce" not in options.software:
            return []
        return [Condition.of(self.name, "cloud", "rce", place=place) for place in (ROBOT, CLOUD)]

    def links(self, options: Options) -> Sequence[Link]:
        """Return the links over which the cloud is measured."""
        return links_of(CLOUD, options) if self.setups(options) else ()

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        return self._seconds(setup, options, len(links_of(dict(setup.factors)["place"], options)))

    def _seconds(self, setup: Condition, options: Options, links: int) -> float:
        tasks = tasks_of(options)
        each = sum(TASK_S[task] + SETTLE_S for task in tasks)
        back = links * BACK_S[NAVIGATION] + (links - 1) * (BACK_S[MAPPING] if MAPPING in tasks else 0.0)
        return START_S[dict(setup.factors)["place"]] + each * links + back

    def warm_up_seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes with one link only."""
        return self._seconds(setup, options, 1)

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run the tasks in one place, over all links in random order."""
        place = dict(trial.setup.factors)["place"]
        links = links_of(place, trial.options)[: 1 if trial.is_warm_up else None]
        order = np.random.default_rng(trial.seed).permutation(len(links))
        async with Bench(seed=trial.seed) as bench:
            cloud = Cloud(bench, software_of(trial.setup.software), Layout()) if place == CLOUD else None
            return await _Run(trial, bench, cloud).measure([links[index] for index in order])


class _Run:
    """The tasks of one run.

    Args:
        trial: The run.
        bench: Its machines.
        cloud: Where the nodes run; None: on the robot.
    """

    def __init__(self, trial: Trial, bench: Bench, cloud: Cloud | None) -> None:
        self._trial = trial
        self._bench = bench
        self._cloud = cloud
        self._robot = TaskRobot(bench, START)
        self._found: list[Measured] = []

    async def measure(self, links: Sequence[Link]) -> list[Measured]:
        """Do the tasks over the links, and return what was measured."""
        tasks = tasks_of(self._trial.options)
        starting = [self._robot.start()]
        if self._cloud is not None:
            starting.append(self._cloud.start_engine(packages=write_packages(self._bench.folder)))
        await together(*starting)
        for nodes, own in ((NAVIGATION, (PLANNING, NAVIGATION)), (MAPPING, (MAPPING,))):
            if not set(own) & set(tasks):
                continue
            await self._robot.start_nodes(nodes, self._cloud)
            await self._robot.wait_ready(nodes, READY_S, **FAR)
            for link in links:
                await self._set(link, NETBOOK_CORES)
                await asyncio.sleep(SETTLE_S)
                for task in own:
                    await self._do(task, link)
                if (nodes, link) != (MAPPING, links[-1]):
                    await self._go_back(nodes)
            await self._set(LINKS[0], 0.0)
            await self._robot.end_nodes()
        return self._found

    async def _go_back(self, nodes: str) -> None:
        """Have the robot where the nodes' tasks begin, over a link that also empties the last one's queues.

        Raises:
            ExperimentError: It was not found there.
        """
        await self._set(LINKS[0], 0.0)
        await asyncio.sleep(SETTLE_S)
        if nodes == MAPPING:
            # It does not count: the map need not be good.
            await self._robot.do(MAPPING, QUICK_PATIENCE_S, **drive(-1))
        elif not (await self._robot.do(RETURN, READY_S, x=START[0], y=START[1], yaw=0.0))["success"]:
            raise ExperimentError(f"the robot was not localized at its start within {READY_S:g} s")

    async def _set(self, link: Link, cores: float) -> None:
        """Give the client a link and a share of a core."""
        await self._bench.set_rate(1e6 * link.rate)
        await self._bench.set_delay(link.delay / 1000)
        if self._bench.meters[CLIENT].limits:
            self._bench.meters[CLIENT].limit(cores)

    async def _do(self, task: str, link: Link) -> None:
        readings = await self._read()
        report = await self._robot.do(task, self._patience(task), **order_of(task))
        later = await self._read()
        values = [value for machine in readings for value in used(machine, readings[machine], later[machine])]
        factors = {"task": task, **link.factors}
        if not self._bench.meters[CLIENT].limits:
            factors["cores"] = "all"
        found = figures_of(task, report, values, has_share="cores" not in factors)
        self._found += self._trial.measured(found, **factors)

    def _patience(self, task: str) -> float:
        if self._trial.options.quick:
            return QUICK_PATIENCE_S
        return PLANS_S if task == PLANNING else PATIENCE_S

    async def _read(self) -> dict[str, Reading]:
        return {machine: await self._bench.read(machine) for machine in (CLIENT, SERVER)}


def order_of(task: str) -> Mapping[str, float]:
    """Return what belongs to each task of a kind."""
    if task == PLANNING:
        return {**FAR, "plans": PLANS}
    return GOAL if task == NAVIGATION else drive(1)


def drive(direction: int) -> Mapping[str, float]:
    """Return the order of the mapper's drive, forward (1) or backward (-1)."""
    return {**{name: direction * value for name, value in ARC.items()}, "drive_s": DRIVE_S}


def links_of(place: str, options: Options) -> Sequence[Link]:
    """Return the links that are measured."""
    return LINKS[: 1 if options.quick or place == ROBOT else None]


def tasks_of(options: Options) -> Sequence[str]:
    """Return the tasks that are measured."""
    return (PLANNING, NAVIGATION) if options.quick else (PLANNING, NAVIGATION, MAPPING)


def figures_of(
    task: str, report: Mapping[str, object], values: Sequence[Value], *, has_share: bool = True
) -> list[Value]:
    """Return the figures of a task.

    Args:
        task: Which.
        report: What the judge told, see :mod:`rce_fleet.experiments.task_judge`.
        values: What the machines used meanwhile, per second.
        has_share: Whether the robot had a netbook's share of a core; else its programs cannot be told from
            its simulated hardware, and there is neither their processor time nor an energy.
    """
    seconds, metres, radians = (float(str(report[name])) for name in ("seconds", "metres", "radians"))
    by_metric = {value.metric: value.value for value in values}
    is_done = bool(report["success"])
    # A series of plans that was not answered counts as one that was not.
    times = PLANS if task == PLANNING and is_done else 1
    found = [
        Value("task_time", seconds / times, "s"),
        Value("success", float(is_done), ""),
        Value("server.cpu", by_metric[f"{SERVER}.cpu"], "cores"),
        *(
            Value(f"robot.network_{way}", by_metric[f"{CLIENT}.network_{way}"], "B/s")
            for way in ("in", "out")
        ),
    ]
    if has_share:
        cpu = by_metric[f"{CLIENT}.cpu"]
        effort = Effort(seconds, metres, radians, cpu / NETBOOK_CORES)
        energy = energy_of(effort, load_model(MODEL).battery) / times
        found += [Value("robot.cpu", cpu, "cores"), Value("energy", energy, "J")]
    delays, answered = report["delays"], report["answered"]
    assert isinstance(delays, dict)
    assert isinstance(answered, dict)
    if control := delays.get(ANSWERS.get(task)):
        median, late = (float(value) for value in np.percentile(control, (50, 95)))
        found += [Value("control_delay", median, "s"), Value("control_delay_p95", late, "s")]
    if task == MAPPING:
        scans = float(str(report["scans"]))
        used_scans = answered.get(ANSWERS[task], 0)
        found.append(Value("scans_used", min(1.0, used_scans / scans) if scans else 0.0, "share"))
    return found
