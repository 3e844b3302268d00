"""Measures streams of messages: sources on the client, listeners on the server, in several parts of a run."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from itertools import chain, count
from math import ceil, inf
from typing import TYPE_CHECKING, NamedTuple

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
    lasted,
    message_bytes,
    over_time,
    used,
)
from rce_fleet.experiments.workloads.control import END, NOTHING, Phase, give
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
FEWEST = 3
"""Messages of each topic in a part that is measured whole, at least."""
STILL_S = 0.2
"""Machines are still that use so long less than the following."""
STILL_B_S = 50_000.0
STILL_CORES = 0.08
PAUSE = Phase("pause", stream=NOTHING)
PATIENCE_S = 10.0
"""Machines that are not still after so long are not waited for, seconds."""


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
        is_whole: Whether it is measured from before its first message until the last one has arrived, so
            that all bytes and work belong to its messages, also to few large ones; else in the middle.
    """

    factors: Mapping[str, str]
    mode: str
    rate: float
    stream: str = ""
    client_cores: float = 0.0
    work_s: float = 0.0
    is_whole: bool = False

    def seconds(self, wanted: float) -> float:
        """Return how long it is measured: so long as wanted, or whole periods if it is measured whole."""
        return max(FEWEST, round(wanted * self.rate)) / self.rate if self.is_whole else wanted


class _Moment(NamedTuple):
    """All meters at about the same time."""

    server: Reading
    client: Reading
    emulation_s: float


@dataclass(slots=True)
class _Watched:
    """What was read during a part.

    Attributes:
        before: Before the first message of the part.
        begin: At the begin of the measurement.
        after: From the planned end until all was still.
        server: Machine 1 at the begin, and when it was ``due``.
        due: As planned, seconds after the begin.
    """

    before: _Moment
    begin: _Moment
    after: list[_Moment]
    server: list[Reading]
    due: list[float]

    def end_of(self, received: Mapping[str, Sequence[Sample]]) -> _Moment:
        """Return the first moment after the part at which all that arrived was there."""
        last = max((sample.arrival for samples in received.values() for sample in samples), default=0)
        return next((one for one in self.after if one.server.at > last * MICRO), self.after[-1])


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
        waits = any(part.is_whole for part in parts)
        if waits:
            give(self._control, PAUSE)
            await self._still(STILL_S)
        watched = [
            await self._watch(f"{number}", part, seconds, waits=waits) for number, part in enumerate(parts)
        ]
        self._limit(0.0)
        if after is not None:
            await after()
        give(self._control, Phase("end", END))
        sent, received = await asyncio.gather(self._told(self._sources), self._told(self._listeners))
        return [
            (part, values_of(part, watched[number], sent, received, f"{number}"))
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
        give(self._control, PAUSE)
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

    async def _watch(self, name: str, part: Part, seconds: float, *, waits: bool = False) -> _Watched:
        """Do a part, and read what is used; if it waits, until nothing of the part is under way."""
        self._limit(part.client_cores)
        before = await self._moment()
        give(self._control, Phase(name, part.mode, part.rate, part.stream, part.work_s))
        if not part.is_whole:
            await asyncio.sleep(SETTLE_S)
        moment = before if part.is_whole else await self._moment()
        server, begin, due = [moment.server], time.monotonic(), readings_due(part.seconds(seconds))
        # Sources look at the phase now and then: half a period early, and none begins another message.
        pausing = [due[-1] - 0.5 / part.rate] if part.is_whole else []
        for at in due:
            if pausing and pausing[0] < at:
                await asyncio.sleep(max(0.0, begin + pausing.pop() - time.monotonic()))
                give(self._control, PAUSE)
            await asyncio.sleep(max(0.0, begin + at - time.monotonic()))
            server.append(await self._bench.read(SERVER))
        after = [_Moment(server[-1], await self._bench.read(CLIENT), await self._bench.emulation_s())]
        if waits:
            give(self._control, PAUSE)
            # A system may wait without any work; if it carries the rate, no wait is longer than a period.
            after += await self._still(max(STILL_S, 1 / part.rate))
        self._bench.check()
        return _Watched(before if waits else moment, moment, after, server, due)

    async def _moment(self) -> _Moment:
        emulation = await self._bench.emulation_s()
        client = await self._bench.read(CLIENT)
        return _Moment(await self._bench.read(SERVER), client, emulation)

    async def _still(self, seconds: float) -> list[_Moment]:
        """Wait until the machines have been still for some seconds; return all moments meanwhile."""
        found = [await self._moment()]
        since = found[0].server.at
        deadline = time.monotonic() + PATIENCE_S
        while found[-1].server.at - since < seconds and time.monotonic() < deadline:
            await asyncio.sleep(STILL_S)
            found.append(await self._moment())
            if not is_still(*found[-2:]):
                since = found[-1].server.at
        return found

    def _limit(self, cores: float) -> None:
        meter = self._bench.meters[CLIENT]
        if meter.limits:
            meter.limit(cores)

    async def _told(self, workloads: Sequence[RunningWorkload]) -> list[dict[str, object]]:
        return list(chain.from_iterable([await told(workload, DRAIN_S) for workload in workloads]))


def values_of(
    part: Part,
    watched: _Watched,
    sent: Sequence[Mapping[str, object]],
    received: Sequence[Mapping[str, object]],
    name: str,
) -> list[Value]:
    """Return the values of a part.

    Args:
        part: The part.
        watched: What was read.
        sent: What sources told.
        received: What listeners told.
        name: Of the part's phase.
    """
    stamps = {topic: [one[0] for one in samples] for topic, samples in by_topic(sent, name).items()}
    arrivals = {
        topic: [Sample(*one) for one in samples] for topic, samples in by_topic(received, name).items()
    }
    before, begin, there = watched.before, watched.begin, watched.end_of(arrivals)
    end = there if part.is_whole else watched.after[0]
    sent_s = watched.due[-1] if part.is_whole else 0.0
    seconds = lasted(arrivals, sent_s) if part.is_whole else 0.0
    emulation = (end.emulation_s - begin.emulation_s) / (seconds or end.client.at - begin.client.at)
    window = begin.server.at, end.server.at
    # After a wait, all that arrived belongs to what was carried.
    whole = window if len(watched.after) == 1 else (before.server.at, inf)
    return [
        *used(SERVER, begin.server, end.server, seconds),
        *used(CLIENT, begin.client, end.client, seconds),
        Value("link.cpu", emulation, "cores"),
        *delivered(stamps, arrivals, window, sent_s, seconds),
        *message_bytes(arrivals, whole, carried_bytes(before.server, there.server)),
        *over_time(watched.server, watched.due),
    ]


def is_still(before: _Moment, after: _Moment) -> bool:
    """Return whether both machines carried and worked almost nothing between two moments."""
    return all(
        carried_bytes(first, last) < STILL_B_S * (last.at - first.at)
        and last.usage.cpu_s - first.usage.cpu_s < STILL_CORES * (last.at - first.at)
        for first, last in ((before.server, after.server), (before.client, after.client))
    )


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
