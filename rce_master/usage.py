"""The usage of containers over time: current rates, and a history for advice.

Task sets tell counters every other second. Kept are the newest two of each container, for rates, and one
every :data:`STEP_S` for the last :data:`WINDOW_S`; the same amount for each container.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from rce.control import EndpointUsage, NodeUsage, Usage

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence


STEP_S = 10.0
WINDOW_S = 600.0
_LEAST_S = 0.1
"""Counters closer together than this give no rate."""


class Sample(NamedTuple):
    """Counters of a container at a time."""

    time: float
    """Seconds on a clock that never goes back."""
    usage: EndpointUsage


class Rates(NamedTuple):
    """What a container does in a second."""

    cpu: float = 0.0
    """Cores in use."""
    throttled: float = 0.0
    """Share of the time in which it was held back by its CPU limit."""
    io_read: float = 0.0
    """Bytes per second; so are the others."""
    io_written: float = 0.0
    link_in: float = 0.0
    link_out: float = 0.0


NO_RATES = Rates()


def rates_between(before: Sample, now: Sample) -> Rates:
    """Tell what happened in a second between two samples of one incarnation of a container."""
    elapsed = now.time - before.time
    if elapsed < _LEAST_S:
        return NO_RATES

    def rate(key: str) -> float:
        return float(max(0.0, getattr(now.usage, key) - getattr(before.usage, key)) / elapsed)

    return Rates(
        cpu=rate("cpu_s"),
        throttled=min(1.0, rate("throttled_s")),
        io_read=rate("io_read"),
        io_written=rate("io_written"),
        link_in=rate("link_in"),
        link_out=rate("link_out"),
    )


@dataclass(slots=True)
class History:
    """One incarnation of a container."""

    before: Sample
    now: Sample
    steps: deque[Sample] = field(default_factory=lambda: deque(maxlen=int(WINDOW_S / STEP_S)))
    """From old to new; beside ``now``."""
    most_memory: int = 0
    """Bytes, the most in any report since the oldest step."""
    _peaks: deque[int] = field(default_factory=lambda: deque(maxlen=int(WINDOW_S / STEP_S) + 1))

    @classmethod
    def begin(cls, first: Sample) -> History:
        """Begin with the first sample."""
        made = cls(first, first)
        made.steps.append(first)
        made._peaks.append(first.usage.memory)
        made.most_memory = first.usage.memory
        return made

    def note(self, sample: Sample) -> None:
        """Take in the next sample."""
        self.before, self.now = self.now, sample
        if sample.time - self.steps[-1].time >= STEP_S:
            self.steps.append(sample)
            self._peaks.append(sample.usage.memory)
        else:
            self._peaks[-1] = max(self._peaks[-1], sample.usage.memory)
        self.most_memory = max(self._peaks)

    @property
    def rates(self) -> Rates:
        """What happens at the moment."""
        return rates_between(self.before, self.now)

    @property
    def samples(self) -> Sequence[Sample]:
        """The kept samples, from old to new."""
        return [*self.steps, *([self.now] if self.now is not self.steps[-1] else [])]

    def node_cpu(self, node: str) -> float:
        """Tell how many cores a node uses at the moment."""
        elapsed = self.now.time - self.before.time
        if elapsed < _LEAST_S:
            return 0.0
        before = self.before.usage.nodes.get(node, NodeUsage())
        now = self.now.usage.nodes.get(node, NodeUsage())
        return max(0.0, (now.cpu_s - before.cpu_s) / elapsed)


class UsageBook:
    """The last usage report of each task set, and the history of each container.

    Args:
        clock: Seconds that never go back.

    Attributes:
        newest: By the process name of the task set.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.newest: dict[str, Usage] = {}
        self._histories: dict[str, dict[str, History]] = {}
        self._clock = clock

    def note(self, process: str, usage: Usage, containers: Collection[str]) -> None:
        """Take in a report.

        Args:
            process: The task set.
            usage: The report.
            containers: Ids of the containers that are placed there; only of these there is a history.
        """
        self.newest[process] = usage
        now = self._clock()
        known = self._histories.get(process, {})
        self._histories[process] = {
            id_: _continued(known.get(id_), Sample(now, told))
            for id_, told in usage.endpoints.items()
            if id_ in containers
        }

    def forget(self, process: str) -> None:
        """Forget a task set that left."""
        self.newest.pop(process, None)
        self._histories.pop(process, None)

    def history(self, process: str, id_: str) -> History | None:
        """Find the history of a container at a task set."""
        return self._histories.get(process, {}).get(id_)


def _continued(history: History | None, sample: Sample) -> History:
    # Less processor time than before: it was made again, and counts from the beginning.
    if history is None or sample.usage.cpu_s < history.now.usage.cpu_s:
        return History.begin(sample)
    history.note(sample)
    return history
