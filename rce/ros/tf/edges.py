"""One frame's transforms to its parent: over time, or static. Pure.

Times are nanoseconds.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from operator import attrgetter
from typing import NamedTuple, Protocol

from rce.ros.tf.exceptions import ExtrapolationError
from rce.ros.tf.transform import Transform

_time = attrgetter("time")


class Sample(NamedTuple):
    """A frame's place at one time."""

    time: int
    parent: str
    transform: Transform
    """``parent_from_child``."""


class Edge(Protocol):
    """A frame's place."""

    @property
    def latest(self) -> Sample:
        """The newest sample; its time is 0 if it is static."""

    def at(self, child: str, time: int) -> Sample:
        """Return the place at a time; ``child`` is for errors.

        Raises:
            ExtrapolationError: The place is not known at that time.
        """


class StaticEdge:
    """A place that never changes."""

    def __init__(self, parent: str, transform: Transform) -> None:
        self.latest = Sample(0, parent, transform)

    def at(self, child: str, time: int) -> Sample:
        """Return it."""
        del child
        return self.latest._replace(time=time)


class TimedEdge:
    """Samples in the order of time, for as long as the cache reaches back from the newest.

    Invariants: there is at least one sample after the first :meth:`insert`; no two have the same time.
    """

    def __init__(self, length: int) -> None:
        self.samples: list[Sample] = []
        self._length = length

    @property
    def latest(self) -> Sample:
        """The newest sample."""
        return self.samples[-1]

    def insert(self, sample: Sample) -> bool:
        """Take a sample.

        Returns:
            False if it is too old, or if there is one of that time already: then nothing changes.
        """
        samples = self.samples
        if not samples or sample.time > samples[-1].time:
            samples.append(sample)
        elif sample.time < samples[-1].time - self._length:
            return False
        else:
            index = bisect_left(samples, sample.time, key=_time)
            if samples[index].time == sample.time:
                return False
            insort(samples, sample, key=_time)
        del samples[: bisect_left(samples, samples[-1].time - self._length, key=_time)]
        return True

    def at(self, child: str, time: int) -> Sample:
        """Return the sample of a time, or interpolate between its neighbours.

        Between samples with different parents, the older one holds.

        Raises:
            ExtrapolationError: The time is before the first or after the last sample.
        """
        samples = self.samples
        index = bisect_left(samples, time, key=_time)
        if index < len(samples) and samples[index].time == time:
            return samples[index]
        if index in {0, len(samples)}:
            first, last = samples[0], samples[-1]
            parent = last.parent if index else first.parent
            raise ExtrapolationError(child, parent, time, first.time, last.time)
        older, newer = samples[index - 1], samples[index]
        if older.parent != newer.parent:
            return Sample(time, older.parent, older.transform)
        fraction = (time - older.time) / (newer.time - older.time)
        return Sample(time, older.parent, older.transform.interpolate(newer.transform, fraction))
