"""A core or master is killed, or a machine cut off: what stops, for how long, and what is lost.

Meanwhile the robot takes a topic of the server, calls a service of it, and looks for each topic that is newly
made there. What was killed is started again after some seconds, as by a supervisor: a ROS core, and in MMS
discovery and sync; the engine's master is started again by ``rce up`` itself. Programs are not restarted.
New topics are declared beforehand where a system needs it: in MMS they are shared, in CRS they have bridges.

A run takes up to a minute, and waits for most of it, so several are done at the same time.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, NamedTuple

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import START_S, Experiment, Measured, Options, Trial
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.systems.base import Flow, Workload
from rce_fleet.experiments.systems.registry import system_of
from rce_fleet.experiments.workloads.provider import (
    NEW_S,
    PERIOD_S,
    SERVICE,
    TEXT,
    TOPIC,
    TRIGGER,
    new_topic,
)
from rce_fleet.experiments.workloads.telling import reports
from rce_fleet.experiments.workloads.watcher import CALL, CALL_PERIOD_S, NEW, NUMBER

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rce_fleet.experiments.systems.base import RunningWorkload, System

CORE, MASTER, CUT = "core_killed", "master_killed", "machine_cut"
AT_ONCE = 4
BEFORE_S = 15.0
"""How long topics may be made before the fault."""
STEADY_S = 1.5
"""What answers for so long after the repair has come back."""
SLACK_S = 1.0
"""What was sent less than so long before the end does not count as lost."""
LATE_S = 5.0
"""What arrives so long after the end is late, and not lost."""
TOLD_S = 60.0
"""How long the provider may take to tell what it sent."""
POLL_S = 0.3


class Times(NamedTuple):
    """How long parts of a run take, seconds.

    Attributes:
        down: From the fault to its end.
        watch: From then to the end of the observation, at most.
    """

    down: float
    watch: float


TIMES = {CORE: Times(5.0, 10.0), MASTER: Times(5.0, 10.0), CUT: Times(20.0, 25.0)}
QUICK_TIMES = {CORE: Times(2.0, 4.0), MASTER: Times(2.0, 4.0), CUT: Times(3.0, 8.0)}


class Robustness(Experiment):
    """Faults in the three systems."""

    name = "robustness"
    title = "core or master killed, machine cut off for 20 s: what stops, for how long, what is lost"
    programs = ("provider", "watcher")
    at_once = AT_ONCE

    def setups(self, options: Options) -> list[Condition]:
        """Return set-ups by fault and system; with further software, only a killed core.

        Quickly, one of each system is done, with the first software.
        """
        found = [
            Condition.of(self.name, setup.system, setup.software, fault=fault)
            for setup in self.each(options, software=options.software[:1])
            for fault in faults(setup.system, is_quick=options.quick)
        ]
        further = () if options.quick else options.software[1:]
        return found + [
            Condition.of(self.name, setup.system, setup.software, fault=CORE)
            for setup in self.each(options, software=further)
        ]

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        return START_S + sum(times_of(setup, options))

    def warm_up_seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long the run takes that does not count: there is none."""
        del setup, options
        return 0.0

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once."""
        if trial.is_warm_up:
            return []
        fault = dict(trial.setup.factors)["fault"]
        times = times_of(trial.setup, trial.options)
        topics = ceil((BEFORE_S + sum(times)) / NEW_S)
        async with Bench(seed=trial.seed) as bench:
            system = trial.system(bench)
            provider, watcher = await system.start(
                flows(topics),
                [
                    Workload("provider", "provider", (str(topics),), SERVER),
                    Workload("watcher", "watcher", (str(topics),), CLIENT),
                ],
            )
            await watcher.wait_ready()
            begin = time.time()
            await _break(system, fault)
            await asyncio.sleep(times.down)
            await _repair(system, fault)
            repaired = time.time()
            steady = repaired + STEADY_S
            seen = Seen()
            end = repaired
            watched = time.monotonic() + times.watch
            while time.monotonic() < watched:
                await asyncio.sleep(POLL_S)
                end = time.time()  # before it is read: that takes a second where all are busy
                seen = Seen.of(reports(await watcher.lines()))
                if seen.is_steady(steady):
                    break
            sent = await _told(provider)
            late = time.monotonic() + LATE_S
            while missing(seen, sent, begin, end) and time.monotonic() < late:
                await asyncio.sleep(POLL_S)
                seen = Seen.of(reports(await watcher.lines()))
        found = values_of(seen, begin, steady, end)
        if (count := missing(seen, sent, begin, end)) is not None:
            found.append(Value("lost_messages", float(count), "count"))
        return trial.measured(found)


@dataclass(frozen=True, slots=True)
class Seen:
    """What a watcher told.

    Attributes:
        answers: When there was an answer, seconds since 1970, by what.
        numbers: The numbers that arrived.
    """

    answers: Mapping[str, list[float]] = field(default_factory=dict)
    numbers: frozenset[int] = frozenset()

    @classmethod
    def of(cls, told: Iterable[Mapping[str, object]]) -> Seen:
        """Read reports."""
        answers: dict[str, list[float]] = {NUMBER: [], CALL: [], NEW: []}
        numbers = set()
        for report in told:
            if "what" in report:
                answers[str(report["what"])].append(float(str(report["at"])))
                if report["what"] == NUMBER:
                    numbers.add(int(str(report["number"])))
        return cls(answers, frozenset(numbers))

    def is_steady(self, since: float) -> bool:
        """Return whether there were answers of each after a time."""
        return all(any(at > since for at in times) for times in self.answers.values())


class Outage(NamedTuple):
    """For how long something was without answer, seconds, and whether it came back."""

    seconds: float
    came_back: bool


def outage(answers: Iterable[float], period: float, begin: float, steady: float, end: float) -> Outage:
    """Return the longest time without answer.

    Args:
        answers: When there was one.
        period: Usual time from one answer to the next; it does not count.
        begin: Begin of the observation.
        steady: What answers from then on has come back.
        end: End of the observation.
    """
    inside = sorted(at for at in answers if begin <= at <= end)
    moments = [begin, *inside, end]
    longest = max(after - before for before, after in pairwise(moments))
    return Outage(max(0.0, longest - period), any(at > steady for at in inside))


def values_of(seen: Seen, begin: float, steady: float, end: float) -> list[Value]:
    """Return how long topics, services and new topics stopped, and whether they came back."""
    found = []
    for name, what, period in (
        ("topics", NUMBER, PERIOD_S),
        ("services", CALL, CALL_PERIOD_S),
        ("new_topics", NEW, NEW_S),
    ):
        one = outage(seen.answers.get(what, ()), period, begin, steady, end)
        found.append(Value(f"{name}_stopped", one.seconds, "s"))
        found.append(Value(f"{name}_came_back", float(one.came_back), "count"))
    return found


def missing(seen: Seen, sent: Sequence[Mapping[str, object]], begin: float, end: float) -> int | None:
    """Return how many numbers that were sent during the observation have not arrived; None: none was sent."""
    counts = [(float(str(one["at"])), int(str(one["sent"]))) for one in sent if "sent" in one]
    inside = [count for at, count in counts if begin <= at <= end - SLACK_S]
    if not inside:
        return None
    return sum(number not in seen.numbers for number in range(inside[0], inside[-1]))


def flows(topics: int) -> list[Flow]:
    """Return what the robot uses of the server."""
    return [
        Flow(TOPIC, TEXT, to=CLIENT),
        Flow(SERVICE, TRIGGER, to=CLIENT, is_service=True),
        *(Flow(new_topic(number), TEXT, to=CLIENT) for number in range(topics)),
    ]


def faults(system: str, *, is_quick: bool) -> tuple[str, ...]:
    """Return the faults that are made in a system."""
    if system_of(system).has_master:
        return (MASTER,) if is_quick else (CORE, MASTER, CUT)
    return (CORE,) if is_quick else (CORE, CUT)


def times_of(setup: Condition, options: Options) -> Times:
    """Return how long parts of a run take."""
    return (QUICK_TIMES if options.quick else TIMES)[dict(setup.factors)["fault"]]


async def _told(provider: RunningWorkload) -> list[dict[str, object]]:
    """Return what the provider told; in CRS that is read by the master, which may have to start again.

    Raises:
        ExperimentError: It told nothing in time.
    """
    deadline = time.monotonic() + TOLD_S
    while not (found := list(reports(await provider.lines()))):
        if time.monotonic() > deadline:
            raise ExperimentError(f"the provider did not tell what it had sent within {TOLD_S:g} s")
        await asyncio.sleep(POLL_S)
    return found


async def _break(system: System, fault: str) -> None:
    if fault == CORE:
        await system.kill_core()
    elif fault == MASTER:
        await system.kill_master()
    else:
        await system.bench.cut(CLIENT, is_cut=True)


async def _repair(system: System, fault: str) -> None:
    if fault == CORE:
        await system.restart_core()
    elif fault == MASTER:
        await system.restart_master()
    else:
        await system.bench.cut(CLIENT, is_cut=False)
