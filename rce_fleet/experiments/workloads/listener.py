"""Takes topics, prints them where it is asked to, and notes when: ``listener TOPIC=TYPE...``.

Whether a message is printed, and what it is part of, is in its frame. At the end of the last phase the
program tells stamp and arrival of every message.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections import defaultdict
from functools import partial
from typing import Any

from .control import END, PRINTED, phase_of
from .graph import open_graph, stamp_of
from .telling import show, tell, tell_ready, tell_samples

POLL_S = 0.1


class Listener:
    """Takes messages.

    Args:
        topics: Those that it waits for before it is ready.
    """

    def __init__(self, topics: list[str]) -> None:
        self._lock = threading.Lock()
        self._missing = set(topics)
        self._samples: dict[tuple[str, str], list[tuple[int, ...]]] = defaultdict(list)
        self._open: set[str] = set()
        """Topics that have had a message, but not their last one."""
        self._is_told = False

    def take(self, topic: str, message: Any) -> None:
        """Take a message."""
        stamp = stamp_of(message)
        phase, mode = phase_of(stamp.frame)
        with self._lock:
            if mode == PRINTED:
                show(message)
            now = time.time_ns()
            if mode == END:
                self._open.discard(topic)
                if not self._open and not self._is_told:
                    self._tell()
            else:
                self._open.add(topic)
                self._samples[phase, topic].append((stamp.ns // 1000, now // 1000))
            if topic in self._missing:
                self._missing.discard(topic)
                if not self._missing:
                    tell_ready()

    def _tell(self) -> None:
        self._is_told = True
        for (phase, topic), samples in self._samples.items():
            tell_samples(phase, topic, samples)
        tell({"phase": END})


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="listener", description=__doc__)
    parser.add_argument("topics", nargs="+", metavar="TOPIC=TYPE")
    options = parser.parse_args()
    topics = dict(topic.split("=", 1) for topic in options.topics)
    listener = Listener(list(topics))
    graph = open_graph("listener")
    for topic, kind in topics.items():
        graph.take(topic, kind, partial(listener.take, topic))
    graph.run(lambda: POLL_S)


if __name__ == "__main__":
    main()
