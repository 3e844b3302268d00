"""Round trips over the size of messages, as the paper defines them, and the other way round."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import START_S, Experiment, Measured, Options, Trial
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.streaming import told
from rce_fleet.experiments.systems.base import Flow, Layout, System, Workload, other
from rce_fleet.experiments.workloads.echo import KIND

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

TRIPS = {7: 20, 100: 10, 1_000: 10, 10_000: 10, 100_000: 6, 1_000_000: 3, 10_000_000: 1}
"""Trips of each size, bytes, in a run, from machine 1, as in the paper."""
BACK_TRIPS = {size: trips for size, trips in TRIPS.items() if size < max(TRIPS)}
"""The same from machine 2, and with further software."""
FEW_TRIPS = {7: 10, 1_000: 5, 100_000: 3, 1_000_000: 1}
"""The same from machine 1 for the delays that are not the link's usual one."""
QUICK_TRIPS = {7: 3, 1_000: 3, 100_000: 1}
DELAYS_MS = (5, 0, 20)
"""Delays of the link in each direction, milliseconds; the first one is the wireless LAN's."""
TRIP_RATE = 4e6
"""About how many bytes pass the link in a second."""
PATIENCE_S = 120.0
CONTAINER = "container"
LONGEST_TRIP_S = 20.0
"""A message that is not back by then is lost."""


class RoundTrip(Experiment):
    """The time until a message is back that another machine publishes again."""

    name = "round-trip"
    title = "round trip of messages of 7 B to 10 MB, from both machines, over links with more and less delay"
    programs = ("asker", "echo")

    def setups(self, options: Options) -> list[Condition]:
        """Return set-ups by system and software; where there are containers, with and without them."""
        found = []
        software = options.software[-1:] if options.quick else options.software
        for setup in self.each(options, software=software):
            if setup.system == "cloud":
                found.append(Condition.of(self.name, setup.system, setup.software, place=CONTAINER))
            found.append(Condition.of(self.name, setup.system, setup.software, place="graph"))
        return found

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        found = START_S
        for origin, delay, _ in rounds_of(setup, options):
            trips = trips_of(setup, options, origin, delay)
            found += 0.5 + sum(number * (0.02 + 2 * size / TRIP_RATE) for size, number in trips.items())
        return found

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once."""
        found: list[Measured] = []
        place = dict(trial.setup.factors)["place"]
        flows = [
            Flow(f"/{machine}_{way}", KIND, to=machine if way == "back" else other(machine))
            for machine in (SERVER, CLIENT)
            for way in ("there", "back")
        ]
        rounds = rounds_of(trial.setup, trial.options)
        async with Bench(seed=trial.seed, delay=rounds[0].delay / 1000) as bench:
            system = trial.system(bench, Layout(server_graph=place == "graph"))
            await system.start(flows, [echo_on(machine) for machine in (SERVER, CLIENT)])
            for number, (origin, delay, name) in enumerate(rounds):
                if trial.is_warm_up and number:
                    break
                await bench.set_delay(delay / 1000)
                trips = trips_of(trial.setup, trial.options, origin, delay)
                if trial.is_warm_up:
                    trips = {size: 1 for size in trips if size < max(TRIPS)}
                reports = await ask(system, origin, f"asker_{number}", trips)
                for report in reports:
                    condition = Condition.of(
                        self.name,
                        trial.setup.system,
                        trial.setup.software,
                        origin=name,
                        delay=delay,
                        bytes=report["bytes"],
                    )
                    found += [Measured(condition, value) for value in values_of(report)]
        return found


def values_of(report: Mapping[str, object]) -> list[Value]:
    """Return the figures of one size: median and 95th percentile, and how many messages were lost."""
    trips, lost = report["trips"], report["lost"]
    assert isinstance(trips, list)
    assert isinstance(lost, int)
    found = [Value("lost", lost / (lost + len(trips)), "")]
    if trips:
        median, high = np.percentile(np.array(trips, np.float64), (50, 95))
        found += [Value("round_trip", float(median), "s"), Value("round_trip_p95", float(high), "s")]
    return found


async def ask(
    system: System, origin: str, name: str, trips: Mapping[int, int]
) -> Sequence[Mapping[str, object]]:
    """Do trips from a machine, and return what was found of each size.

    Raises:
        ExperimentError: The program that asks does not start or end.
    """
    sizes = tuple(f"{size}:{number}" for size, number in trips.items())
    words = (f"/{origin}_there", f"/{origin}_back", *sizes, "--patience", f"{LONGEST_TRIP_S:g}")
    asker = await system.run(Workload(name, "asker", words, origin))
    try:
        reports = await told(asker, PATIENCE_S)
    finally:
        await asker.end()
    return [report for report in reports if "trips" in report]


def echo_on(machine: str) -> Workload:
    """Return what sends back on a machine what the other one asks."""
    asking = other(machine)
    return Workload(f"echo_{machine}", "echo", (f"/{asking}_there", f"/{asking}_back"), machine)


class Round(NamedTuple):
    """A series of trips: where they begin, delay in milliseconds, and the origin's name in the results."""

    origin: str
    delay: int
    name: str


def rounds_of(setup: Condition, options: Options) -> list[Round]:
    """Return the series of trips, the longest delay first.

    A connection that is there when a delay grows takes that for congestion (HyStart of TCP CUBIC), and is
    slow for long: CRS keeps its connections, the other systems make new ones for each series.
    """
    place = dict(setup.factors)["place"]
    is_cloud = setup.system == "cloud"
    origins = [(SERVER, CONTAINER if place == CONTAINER else SERVER)]
    if not is_cloud or place == CONTAINER:
        origins.append((CLIENT, CLIENT))
    delays = DELAYS_MS if options.has_all(setup) else DELAYS_MS[:1]
    first, first_name = origins[0]
    further = [Round(first, delay, first_name) for delay in delays[1:]]
    found = [*(Round(origin, delays[0], name) for origin, name in origins), *further]
    return sorted(found, key=lambda one: -one.delay)


def trips_of(setup: Condition, options: Options, origin: str, delay: int) -> Mapping[int, int]:
    """Return how many trips of each size, bytes, are made from a machine."""
    if options.quick:
        return QUICK_TRIPS
    if delay != DELAYS_MS[0]:
        return FEW_TRIPS
    return TRIPS if origin == SERVER and options.has_all(setup) else BACK_TRIPS
