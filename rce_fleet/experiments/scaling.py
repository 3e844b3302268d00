"""More and more robots: what each further one costs, and at how many a system breaks.

Robots send scans as in the experiment ``laser``, which are not printed: a console is full long before a
system is. The simulated robots are spread over several programs, so that these are not what breaks first.
"""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING

from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import SETTLE_S, START_S, Experiment, Measured, Options, Trial
from rce_fleet.experiments.laser import ASKED_HZ
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.round_trip import ask, echo_on, values_of
from rce_fleet.experiments.streaming import Part, Streaming
from rce_fleet.experiments.systems.base import Flow, Layout, Workload
from rce_fleet.experiments.workloads.control import QUIET
from rce_fleet.experiments.workloads.echo import KIND
from rce_fleet.experiments.workloads.robots import SCAN
from rce_fleet.experiments.workloads.telling import READY, reports

if TYPE_CHECKING:
    from rce_fleet.experiments.systems.base import RunningWorkload, System

ROBOTS = (1, 10, 50)
"""The experiment ``laser`` has five. A run of fifty takes a minute: more numbers would leave fewer runs."""
QUICK_ROBOTS = (2,)
ONE, EACH = "one", "each"
"""One container for all robots, or one for each."""
WARMED_UP = ROBOTS[0]
"""Robots of the only set-up that is warmed up: the others run the same programs."""
ROBOTS_PER_PROGRAM = 5
TRIPS = {7: 10}
"""Round trips, by the bytes of their messages."""
ROBOT_S = {ONE: 0.4, EACH: 0.8}
"""About how long a robot takes to start in a cloud, by the containers, seconds."""
NODE_S = 0.05
"""About how long it takes elsewhere, seconds."""


class Scaling(Experiment):
    """Scans of one to fifty robots in the three systems."""

    name = "scaling"
    title = "1 to 50 robots with laser scans; one container for all against one for each"
    programs = ("asker", "echo", "listener", "robots")

    def setups(self, options: Options) -> list[Condition]:
        """Return set-ups by number of robots and system, with the first software."""
        return [
            Condition.of(self.name, setup.system, setup.software, robots=robots, containers=containers)
            for setup in self.each(options, software=options.software[:1])
            for robots in (QUICK_ROBOTS if options.quick else ROBOTS)
            for containers in containers_of(setup.system)[-1 if options.quick else 0 :]
        ]

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        in_cloud = setup.system == "cloud"
        per_robot = ROBOT_S[dict(setup.factors)["containers"]] if in_cloud else NODE_S
        return START_S + SETTLE_S + options.seconds + robots_of(setup) * per_robot

    def warm_up_seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long the run takes that does not count."""
        return self.seconds(setup, options) if robots_of(setup) == WARMED_UP else 0.0

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once."""
        robots = robots_of(trial.setup)
        if trial.is_warm_up and robots != WARMED_UP:
            return []
        containers = dict(trial.setup.factors)["containers"]
        async with Bench(seed=trial.seed) as bench:
            system = trial.system(bench, Layout(robots=robots, containers=containers))
            streaming, listeners = await start(system)
            trips: list[Value] = []

            async def take_trips() -> None:
                for report in await ask(system, CLIENT, "asker", TRIPS):
                    trips.extend(value for value in values_of(report) if value.metric != "lost")

            ((_, values),) = await streaming.measure(
                [Part({}, QUIET, ASKED_HZ)], trial.options.seconds, take_trips
            )
            started = Value("start", await ready_at(listeners) - system.robots_at, "s")
        return trial.measured([*values, *trips, started])


def robots_of(setup: Condition) -> int:
    """Return the number of robots of a set-up."""
    return int(dict(setup.factors)["robots"])


def containers_of(system: str) -> tuple[str, ...]:
    """Return how robots share containers in a system."""
    return (ONE, EACH) if system == "cloud" else (ONE,)


async def start(system: System) -> tuple[Streaming, list[RunningWorkload]]:
    """Start a system with robots that send scans; return the listeners too."""
    bench, robots = system.bench, system.layout.robots
    scans = {number: Flow(f"/Robot{number}/scan", SCAN, robot=number) for number in range(1, robots + 1)}
    trips = [Flow(f"/{CLIENT}_there", KIND), Flow(f"/{CLIENT}_back", KIND, to=CLIENT)]
    control = bench.folder / "scans.json"
    listening = [
        Workload(
            f"listener{flows[0].robot}",
            "listener",
            tuple(f"{one.topic}={one.kind}" for one in flows),
            SERVER,
            flows[0].robot,
        )
        for flows in (
            [[flow] for flow in scans.values()] if system.layout.containers == EACH else [[*scans.values()]]
        )
    ]
    sources = [
        Workload(f"robots{part[0]}", "robots", ("--control", str(control), *map(str, part)), CLIENT)
        for part in shares(list(scans))
    ]
    running = await system.start([*scans.values(), *trips], [*listening, echo_on(SERVER), *sources])
    listeners = running[: len(listening)]
    return Streaming(bench, control, running[len(listening) + 1 :], listeners), listeners


def shares(robots: list[int]) -> list[list[int]]:
    """Return the robots of each program that simulates some, about as many in each."""
    programs = ceil(len(robots) / ROBOTS_PER_PROGRAM)
    return [robots[number::programs] for number in range(programs)]


async def ready_at(listeners: list[RunningWorkload]) -> float:
    """Return when all listeners had heard of all their robots, seconds since 1970."""
    found = [report for listener in listeners for report in reports(await listener.lines())]
    return max(float(report[READY]) for report in found if READY in report)
