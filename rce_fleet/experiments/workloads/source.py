"""Sends messages of several topics at the rate that is asked for; tells their stamps after each phase."""

from __future__ import annotations

import hashlib
import time
from collections import defaultdict, deque
from typing import TYPE_CHECKING, Any, NamedTuple

from .control import END, Control, Phase
from .graph import Stamp
from .telling import tell, tell_samples

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from .graph import Graph

LOOK_S = 0.1
"""How often it looks at the phase, seconds."""
LAST_HZ = 5.0
"""Rate at which it says that the last phase has ended."""
_BLOCK = bytes(65_536)
"""Work is hashes of it, which take a fraction of a millisecond each."""


class Stream(NamedTuple):
    """What is sent on a topic.

    Attributes:
        name: By which a phase chooses it.
        topic: The topic.
        kind: Its type.
        messages: The fields of each message.
        last: Those of a small message, by which listeners hear that a topic is there, and that all was sent.
    """

    name: str
    topic: str
    kind: str
    messages: Iterator[Mapping[str, Any]]
    last: Mapping[str, Any]


class Source:
    """Sends streams.

    Args:
        graph: Where it sends them.
        streams: All that it can send. Streams of one topic have one type.
        control: File with the phase.
    """

    def __init__(self, graph: Graph, streams: list[Stream], control: Path) -> None:
        kinds = {stream.topic: stream.kind for stream in streams}
        self._outputs = {topic: graph.output(topic, kind) for topic, kind in kinds.items()}
        self._streams = streams
        self._control = Control(control)
        self._sent: dict[tuple[str, str], list[tuple[int, ...]]] = defaultdict(list)
        self._due = time.monotonic()
        self._pending: deque[Stream] = deque()
        """Whose messages are due."""
        self._look_at = 0.0
        self._phase = self._control.read()

    def step(self) -> float:
        """Send what is due; return the seconds until the next call."""
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + LOOK_S
            phase = self._control.read()
            if phase != self._phase:
                self._tell()
                self._phase, self._due = phase, now
                self._pending.clear()
        if now >= self._due and not self._pending:
            self._pending.extend(one for one in self._streams if phase_has(self._phase, one))
            period = 1.0 / (LAST_HZ if self._phase.mode == END else self._phase.rate)
            # What could not be sent in time is not made up for.
            self._due = max(self._due + period, now)
        while self._pending:
            self._send(self._pending.popleft())
            if self._pending and self._phase.work_s:
                return 0.0  # the program's graph writes each message before the next one is worked on
        return max(0.0, min(self._due, self._look_at) - time.monotonic())

    def _tell(self) -> None:
        for (phase, topic), samples in self._sent.items():
            tell_samples(phase, topic, samples)
        self._sent.clear()
        if self._control.read().mode == END:
            tell({"phase": END})

    def _send(self, stream: Stream) -> None:
        phase = self._phase
        if not phase.is_small:
            work(phase.work_s)
        fields = stream.last if phase.is_small else next(stream.messages)
        stamp = time.time_ns() // 1000 * 1000
        self._outputs[stream.topic].send(fields, Stamp(stamp, phase.frame))
        if not phase.is_small:
            self._sent[phase.name, stream.topic].append((stamp // 1000,))


def phase_has(phase: Phase, stream: Stream) -> bool:
    """Return whether a stream is sent in a phase."""
    return not phase.stream or stream.name == phase.stream


def work(seconds: float) -> None:
    """Use so much processor time, seconds; other threads run on, as beside a simulator in C++."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        hashlib.sha256(_BLOCK)
