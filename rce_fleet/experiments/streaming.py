"""Measures streams of messages: sources on the client, listeners on the server, in several parts of a run."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from itertools import chain, count
from math import ceil
from typing import TYPE_CHECKING

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, SERVER, Reading
from rce_fleet.experiments.experiment import SETTLE_S
from rce_fleet.experiments.measures import (
    MICRO,
    Sample,
    Value,
    by_topic,
    carried_bytes,
    delivered,
    over_time,
    used,
)
from rce_fleet.experiments.workloads.control import END, Phase, give
from rce_fleet.experiments.workloads.telling import reports

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence
    from pathlib import Path

    from rce_fleet.experiments.bench import Bench
    from rce_fleet.experiments.systems.base import RunningWorkload

STEP_S = 0.5
"""Between two readings of machine 1's network, seconds."""
DRAIN_S = 30.0
"""How long messages may be under way after the last part, seconds."""
POLL_S = 0.3


@dataclass(frozen=True, slots=True)
class Part:
    """A condition that is measured.

    Attributes:
        factors: What distinguishes it from the other parts of the run.
        mode: Of the phase: whether messages are printed.
        rate: Messages that are to be sent, per second and topic.
        stream: Which stream; empty: all.
        client_cores: Share of a core that the client has; 0: all that there is.
        work_s: Processor time that making a message takes, seconds.
    """

    factors: Mapping[str, str]
    mode: str
    rate: float
    stream: str = ""
    client_cores: float = 0.0
    work_s: float = 0.0


@dataclass(slots=True)
class _Watched:
    """What was read during a part.

    Attributes:
        due: When the server was read after the first time, as planned, seconds.
    """

    server: list[Reading]
    client: list[Reading]
    due: list[float]
    emulation_s: float


class Streaming:
    """Streams on a bench.

    Args:
        bench: The machines.
        control: The file by which sources know what to send.
        sources: Those.
        listeners: Those.
    """

    def __init__(
        self,
        bench: Bench,
        control: Path,
        sources: Sequence[RunningWorkload],
        listeners: Sequence[RunningWorkload],
    ) -> None:
        self._bench = bench
        self._control = control
        self._sources = sources
        self._listeners = listeners
        self._trials = count()

    async def measure(
        self,
        parts: Sequence[Part],
        seconds: float,
        after: Callable[[], Awaitable[None]] | None = None,
    ) -> list[tuple[Part, list[Value]]]:
        """Do the parts one after another, and return what was measured.

        Args:
            parts: What is measured.
            seconds: How long, each.
            after: Called after the last part, while its messages still flow.

        Raises:
            ExperimentError: A program ended, or did not tell what it had seen.
        """
        for listener in self._listeners:
            await listener.wait_ready()
        watched = [await self._watch(f"{number}", part, seconds) for number, part in enumerate(parts)]
        self._limit(0.0)
        if after is not None:
            await after()
        give(self._control, Phase("end", END))
        sent, received = await asyncio.gather(self._told(self._sources), self._told(self._listeners))
        return [
            (part, self._values(watched[number], sent, received, f"{number}"))
            for number, part in enumerate(parts)
        ]

    async def sent_rate(self, part: Part, seconds: float) -> float:
        """Do a part whose messages nothing else is told of, and return how many were sent, 1/s and topic.

        Raises:
            ExperimentError: A program ended, or did not tell what it had sent.
        """
        name = f"trial-{next(self._trials)}"
        for listener in self._listeners:
            await listener.wait_ready()
        watched = await self._watch(name, part, seconds)
        give(self._control, Phase("pause"))
        deadline = time.monotonic() + DRAIN_S
        while not (found := by_topic(await self._told_so_far(), name)):
            if time.monotonic() > deadline:
                raise ExperimentError(f"a source did not tell what it had sent within {DRAIN_S:g} s")
            await asyncio.sleep(POLL_S)
        begin, end = watched.server[0].at, watched.server[-1].at
        stamps = [one[0] for samples in found.values() for one in samples]
        inside = sum(begin <= stamp * MICRO < end for stamp in stamps)
        return inside / (end - begin) / len(found)

    async def _told_so_far(self) -> list[dict[str, object]]:
        return [report for source in self._sources for report in reports(await source.lines())]

    async def _watch(self, name: str, part: Part, seconds: float) -> _Watched:
        self._limit(part.client_cores)
        give(self._control, Phase(name, part.mode, part.rate, part.stream, part.work_s))
        await asyncio.sleep(SETTLE_S)
        emulation = await self._bench.emulation_s()
        client = [await self._bench.read(CLIENT)]
        server = [await self._bench.read(SERVER)]
        begin, due = time.monotonic(), readings_due(seconds)
        for at in due:
            await asyncio.sleep(max(0.0, begin + at - time.monotonic()))
            server.append(await self._bench.read(SERVER))
        client.append(await self._bench.read(CLIENT))
        self._bench.check()
        return _Watched(server, client, due, await self._bench.emulation_s() - emulation)

    def _limit(self, cores: float) -> None:
        meter = self._bench.meters[CLIENT]
        if meter.limits:
            meter.limit(cores)

    async def _told(self, workloads: Sequence[RunningWorkload]) -> list[dict[str, object]]:
        return list(chain.from_iterable([await told(workload, DRAIN_S) for workload in workloads]))

    def _values(
        self,
        watched: _Watched,
        sent: Sequence[Mapping[str, object]],
        received: Sequence[Mapping[str, object]],
        name: str,
    ) -> list[Value]:
        server, client = watched.server, watched.client
        first, last = server[0], server[-1]
        stamps = {topic: [one[0] for one in samples] for topic, samples in by_topic(sent, name).items()}
        arrivals = {
            topic: [Sample(*one) for one in samples] for topic, samples in by_topic(received, name).items()
        }
        seconds = client[-1].at - client[0].at
        return [
            *used(SERVER, first, last),
            *used(CLIENT, client[0], client[-1]),
            Value("link.cpu", watched.emulation_s / seconds, "cores"),
            *delivered(stamps, arrivals, (first.at, last.at), carried_bytes(first, last)),
            *over_time(server, watched.due),
        ]


def readings_due(seconds: float) -> list[float]:
    """Return when a machine is read after a measurement began: at each step, and at its end; seconds."""
    steps = ceil(seconds / STEP_S)
    return [min(seconds, number * STEP_S) for number in range(1, steps + 1)]


async def told(workload: RunningWorkload, patience: float) -> list[dict[str, object]]:
    """Return what a program tells when everything was done.

    Raises:
        ExperimentError: It does not tell it in time.
    """
    deadline = time.monotonic() + patience
    while True:
        found = list(reports(await workload.lines()))
        if found and found[-1] == {"phase": END}:
            return found
        if time.monotonic() > deadline:
            raise ExperimentError(
                f"a program of the experiment did not tell its figures within {patience:g} s"
            )
        await asyncio.sleep(POLL_S)
