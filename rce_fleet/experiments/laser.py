"""The paper's first experiment: robots' laser scans, printed on machine 1.

The paper's machine 2 was full with the simulation of its robots. So here it is a netbook where it is full,
and the program that sends the scans uses processor time for each, as a simulator does: so much that the
robots reach the paper's rate in the Single Master System. A share so small that sending alone fills it (0.5 %
of a core) would measure the kernel instead: it stops the machine for several periods after each clock tick.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import (
    NETBOOK_CORES,
    SETTLE_S,
    START_S,
    Experiment,
    Measured,
    Options,
    Trial,
)
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.streaming import Part, Streaming
from rce_fleet.experiments.systems.base import Flow, Layout, Workload
from rce_fleet.experiments.workloads.control import PRINTED, QUIET
from rce_fleet.experiments.workloads.robots import SCAN

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce_fleet.experiments.systems.base import System

ASKED_HZ = 30.0
"""The rate that robots try to reach."""
FIXED_HZ = 4.0
"""A rate that all systems reach: the lowest that the paper tells."""
PAPER_HZ = 7.5
"""The rate that the paper's robots reached in its Single Master System."""
CALIBRATION_STEPS = 7
CALIBRATION_S = 2.0
"""How long the rate is measured in each step."""
LEAST_SHARE = 0.1
"""Making scans takes this share of a full client's processor time at least."""
SCAN_WORK = "scan_work"
"""What the preparation finds: processor time for a scan with which a full client reaches the paper's rate."""


class Laser(Experiment):
    """Scans of some robots in the three systems."""

    name = "laser"
    title = "laser scans of five robots, printed on machine 1 (the paper's experiment 1)"
    programs = ("listener", "robots")

    def setups(self, options: Options) -> list[Condition]:
        """Return a set-up for each system and software; quickly, with the last one, which starts soonest."""
        software = options.software[-1:] if options.quick else options.software
        return [
            Condition.of(self.name, setup.system, setup.software, robots=options.robots)
            for setup in self.each(options, software=software)
        ]

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        return START_S + len(parts(options, setup, 1.0)) * (SETTLE_S + options.seconds)

    def preparation_seconds(self, options: Options) -> float:
        """Return about how long it takes to find the client's share."""
        return 0.0 if options.quick else START_S + CALIBRATION_STEPS * (SETTLE_S + CALIBRATION_S)

    async def prepare(self, options: Options, seed: int) -> list[Value]:
        """Find the work for a scan with which the Single Master System reaches the paper's rate."""
        setup = Condition.of(self.name, "single_master", options.software[0], robots=options.robots)
        trial = Trial(setup, options, seed)
        async with Bench(seed=seed) as bench:
            if not bench.meters[CLIENT].limits:
                return []
            streaming = await start(trial.system(bench), options.robots)

            async def rate_with(work_s: float) -> float:
                part = Part({}, PRINTED, ASKED_HZ, client_cores=NETBOOK_CORES, work_s=work_s)
                return await streaming.sent_rate(part, CALIBRATION_S)

            return [Value(SCAN_WORK, await calibrated(rate_with, options.robots), "s")]

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once."""
        options = trial.options
        work_s = most_work(options.robots) if options.quick else trial.prepared.get(SCAN_WORK, 0.0)
        async with Bench(seed=trial.seed) as bench:
            streaming = await start(trial.system(bench, Layout(robots=options.robots)), options.robots)
            wanted = parts(options, trial.setup, work_s if bench.meters[CLIENT].limits else 0.0)
            found = await streaming.measure(wanted[: 1 if trial.is_warm_up else None], options.seconds)
        return [one for part, values in found for one in trial.measured(values, **part.factors)]


async def start(system: System, robots: int) -> Streaming:
    """Start a system with robots that send scans, and a listener for all of them."""
    bench = system.bench
    numbers = range(1, robots + 1)
    flows = [Flow(f"/Robot{number}/scan", SCAN, robot=number) for number in numbers]
    control = bench.folder / "scans.json"
    source = ("--control", str(control), *map(str, numbers))
    listener, robot = await system.start(
        flows,
        [
            Workload("listener", "listener", tuple(f"{flow.topic}={flow.kind}" for flow in flows), SERVER),
            Workload("robots", "robots", source, CLIENT),
        ],
    )
    return Streaming(bench, control, [robot], [listener])


async def calibrated(rate_with: Callable[[float], Awaitable[float]], robots: int) -> float:
    """Return the work for a scan with which the robots reach the paper's rate, seconds of processor time.

    Args:
        rate_with: Returns the rate, Hz, that robots reach with so much work.
        robots: Their number.
    """
    high = most_work(robots)
    low = LEAST_SHARE * high
    for _ in range(CALIBRATION_STEPS):
        middle = sqrt(low * high)
        if await rate_with(middle) < PAPER_HZ:
            high = middle
        else:
            low = middle
    return sqrt(low * high)


def most_work(robots: int) -> float:
    """Return the processor time for a scan with which nothing is left of a full client, seconds."""
    return NETBOOK_CORES / (PAPER_HZ * robots)


def parts(options: Options, setup: Condition, work_s: float) -> list[Part]:
    """Return what is measured in each run: the main conditions, and one for each further factor.

    Args:
        options: How experiments are done.
        setup: What is started.
        work_s: Processor time for a scan where the client is as full as the paper's; 0: it cannot be limited.
    """
    main = {"printed": "yes", "client_cpu": "all", "rate": "free"}
    found = [Part(main, PRINTED, ASKED_HZ)]
    if work_s:
        full = main | {"client_cpu": "full"}
        found.append(Part(full, PRINTED, ASKED_HZ, client_cores=NETBOOK_CORES, work_s=work_s))
    if options.has_all(setup):
        found.append(Part(main | {"rate": "fixed"}, PRINTED, FIXED_HZ))
        found.append(Part(main | {"printed": "no"}, QUIET, ASKED_HZ))
    return found
