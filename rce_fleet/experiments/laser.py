"""The paper's first experiment: robots' laser scans, printed on machine 1."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import SETTLE_S, START_S, Experiment, Measured, Options, Trial
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.streaming import Part, Streaming
from rce_fleet.experiments.systems.base import Flow, Layout, Workload
from rce_fleet.experiments.workloads.control import PRINTED, QUIET
from rce_fleet.experiments.workloads.robots import SCAN

if TYPE_CHECKING:
    from rce_fleet.experiments.systems.base import System

ASKED_HZ = 30.0
"""The rate that robots try to reach."""
FIXED_HZ = 4.0
"""A rate that all systems reach: the lowest that the paper tells."""
PAPER_HZ = 7.5
"""The rate that the paper's robots reached in its Single Master System."""
CALIBRATION_STEPS = 7
QUICK_CORES = 0.03
"""The client's share of a core where only the programs are tried."""
LEAST_CORES, MOST_CORES = 0.002, 1.0
FULL_CORES = "full_cores"
"""What the preparation finds: the share of a core with which the client reaches the paper's rate."""


class Laser(Experiment):
    """Scans of some robots in the three systems."""

    name = "laser"
    title = "laser scans of five robots, printed on machine 1 (the paper's experiment 1)"
    programs = ("listener", "robots")

    def setups(self, options: Options) -> list[Condition]:
        """Return a set-up for each system and software."""
        software = options.software[:1] if options.quick else options.software
        return [
            Condition.of(self.name, setup.system, setup.software, robots=options.robots)
            for setup in self.each(options, software=software)
        ]

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        del setup
        return START_S + len(parts(options, 1.0)) * (SETTLE_S + options.seconds)

    def preparation_seconds(self, options: Options) -> float:
        """Return about how long it takes to find the client's share."""
        return 0.0 if options.quick else START_S + CALIBRATION_STEPS * (SETTLE_S + 1.0)

    async def prepare(self, options: Options, seed: int) -> dict[str, float]:
        """Find the client's share of a core with which the Single Master System reaches the paper's rate."""
        setup = Condition.of(self.name, "single_master", options.software[0], robots=options.robots)
        trial = Trial(setup, options, seed)
        async with Bench(seed=seed) as bench:
            if not bench.meters[CLIENT].limits:
                return {}
            streaming = await start(trial.system(bench), options.robots)
            low, high = LEAST_CORES, MOST_CORES
            for _ in range(CALIBRATION_STEPS):
                middle = (low * high) ** 0.5
                part = Part({}, PRINTED, ASKED_HZ, client_cores=middle)
                if await streaming.sent_rate(part, 1.0) < PAPER_HZ:
                    low = middle
                else:
                    high = middle
        return {FULL_CORES: (low * high) ** 0.5}

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once."""
        options = trial.options
        full = QUICK_CORES if options.quick else trial.prepared.get(FULL_CORES, 0.0)
        async with Bench(seed=trial.seed) as bench:
            streaming = await start(trial.system(bench, Layout(robots=options.robots)), options.robots)
            wanted = parts(options, full if bench.meters[CLIENT].limits else 0.0)
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


def parts(options: Options, full_cores: float) -> list[Part]:
    """Return what is measured in each run: the paper's condition, and one for each factor.

    Args:
        options: How experiments are done.
        full_cores: The client's share of a core where it is as full as the paper's; 0: not limited here.
    """
    main = {"printed": "yes", "client_cpu": "all", "rate": "free"}
    found = [Part(main, PRINTED, ASKED_HZ)]
    if full_cores:
        found.append(Part(main | {"client_cpu": "full"}, PRINTED, ASKED_HZ, client_cores=full_cores))
    if not options.quick:
        found.append(Part(main | {"rate": "fixed"}, PRINTED, FIXED_HZ))
        found.append(Part(main | {"printed": "no"}, QUIET, ASKED_HZ))
    return found
