"""Figures of a part of a run: from readings of meters and from the stamps of messages."""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rce_fleet.experiments.bench import SERVER

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rce_fleet.experiments.bench import Reading

MICRO = 1e-6
LATE_S = 0.5
"""Messages younger than this at the end of the measurement may be under way: they do not count as lost."""
PERCENTILES = (50, 95, 99)
FEWEST_OF_TAILS = 20
"""Of fewer delays only the median is told: the other percentiles would be the largest one."""


class Value(NamedTuple):
    """A value that was measured."""

    metric: str
    value: float
    unit: str


class Sample(NamedTuple):
    """A message that arrived: when it was sent and when it was there, microseconds since 1970."""

    stamp: int
    arrival: int


def used(machine: str, first: Reading, last: Reading, seconds: float = 0.0) -> list[Value]:
    """Return what a machine used between two readings, per second.

    Args:
        machine: The machine.
        first: The first reading.
        last: The last one.
        seconds: By how many seconds it is divided; 0: by those between the readings.
    """
    seconds = seconds or last.at - first.at
    rates = {
        "cpu": (last.usage.cpu_s - first.usage.cpu_s, "cores"),
        "network_in": (last.traffic.received_bytes - first.traffic.received_bytes, "B/s"),
        "network_out": (last.traffic.sent_bytes - first.traffic.sent_bytes, "B/s"),
        "packets_in": (last.traffic.received_packets - first.traffic.received_packets, "1/s"),
        "packets_out": (last.traffic.sent_packets - first.traffic.sent_packets, "1/s"),
    }
    found = [Value(f"{machine}.{name}", value / seconds, unit) for name, (value, unit) in rates.items()]
    return [*found, Value(f"{machine}.memory", float(last.usage.memory), "B")]


def over_time(readings: Sequence[Reading], due: Sequence[float]) -> list[Value]:
    """Return the network of machine 1 in both directions, by the seconds since the measurement began.

    Args:
        readings: Of the beginning, and one for each time.
        due: When they were to be read, seconds: the same in all runs, while readings take a while.
    """
    return [
        Value(
            f"{SERVER}.network@{at:.1f}",
            (_carried(after) - _carried(before)) / (after.at - before.at),
            "B/s",
        )
        for (before, after), at in zip(pairwise(readings), due, strict=True)
    ]


def delivered(
    sent: Mapping[str, Sequence[int]],
    received: Mapping[str, Iterable[Sample]],
    window: tuple[float, float],
    sent_s: float = 0.0,
    arrived_s: float = 0.0,
) -> list[Value]:
    """Return how messages were delivered within a window.

    Args:
        sent: Stamps of what was sent on each topic, microseconds since 1970.
        received: What arrived on each topic.
        window: Begin and end of the measurement, seconds since 1970.
        sent_s: For how many seconds messages were sent in it; 0: all the time.
        arrived_s: For how many they arrived, at an even rate; 0: all the time.
    """
    begin, end = window
    topics = max(1, len(sent))
    inside = [stamp for stamps in sent.values() for stamp in stamps if begin <= stamp * MICRO < end]
    there = _arrived(received, window)
    found = [
        Value("rate", len(inside) / (sent_s or end - begin) / topics, "Hz"),
        Value("received", len(there) / (arrived_s or end - begin) / topics, "Hz"),
    ]
    if there:
        delays = np.array([sample.arrival - sample.stamp for sample in there]) * MICRO
        shares = PERCENTILES if len(there) >= FEWEST_OF_TAILS else PERCENTILES[:1]
        figures = np.percentile(delays, shares)
        found += [
            Value(f"delay_p{share}", float(figure), "s")
            for share, figure in zip(shares, figures, strict=True)
        ]
    lost = _lost(sent, received, begin, end)
    return found if lost is None else [*found, Value("lost", lost, "")]


def message_bytes(
    received: Mapping[str, Iterable[Sample]], window: tuple[float, float], carried: float
) -> list[Value]:
    """Return the bytes that were carried for each message that arrived; none if nothing did.

    Args:
        received: What arrived on each topic.
        window: Between which times, seconds since 1970.
        carried: Bytes that machine 1 sent and received between them.
    """
    there = _arrived(received, window)
    return [Value("message_bytes", carried / len(there), "B")] if there else []


def lasted(received: Mapping[str, Sequence[Sample]], sent_s: float) -> float:
    """Return for how long messages arrived at an even rate, seconds, if all of them are measured.

    So long as they were sent, or longer where they arrived at a lower rate: the time from the first arrival
    to the last one is that of all messages but one.
    """
    found = [sent_s]
    for samples in received.values():
        arrivals = sorted(sample.arrival for sample in samples)
        if len(arrivals) > 1:
            found.append((arrivals[-1] - arrivals[0]) * MICRO * len(arrivals) / (len(arrivals) - 1))
    return max(found)


def _arrived(received: Mapping[str, Iterable[Sample]], window: tuple[float, float]) -> list[Sample]:
    begin, end = window
    arrived = [sample for samples in received.values() for sample in samples]
    return [sample for sample in arrived if begin <= sample.arrival * MICRO < end]


def _lost(
    sent: Mapping[str, Sequence[int]], received: Mapping[str, Iterable[Sample]], begin: float, end: float
) -> float | None:
    """Return the share of the messages that never arrived; None if none was old enough."""
    count = missing = 0
    for topic, stamps in sent.items():
        there = {sample.stamp for sample in received.get(topic, ())}
        old = [stamp for stamp in stamps if begin <= stamp * MICRO < end - LATE_S]
        count += len(old)
        missing += sum(stamp not in there for stamp in old)
    return missing / count if count else None


def carried_bytes(first: Reading, last: Reading) -> float:
    """Return the bytes that a machine sent and received between two readings."""
    return float(_carried(last) - _carried(first))


def by_topic(reports: Iterable[Mapping[str, object]], phase: str) -> dict[str, list[tuple[int, ...]]]:
    """Return the samples that programs told of a phase, by topic."""
    found: dict[str, list[tuple[int, ...]]] = defaultdict(list)
    for report in reports:
        samples = report.get("samples")
        if report.get("phase") == phase and isinstance(samples, list):
            found[str(report["topic"])] += [tuple(sample) for sample in samples]
    return dict(found)


def _carried(reading: Reading) -> int:
    return reading.traffic.sent_bytes + reading.traffic.received_bytes
