"""Uses what a ``provider`` provides, and tells each answer with its time: ``watcher TOPICS``.

It takes the numbers, calls the service five times a second whether former calls are answered or not, and
looks for each new topic when it is made.
"""

from __future__ import annotations

import argparse
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from .graph import open_graph
from .provider import NEW_S, SERVICE, TEXT, TOPIC, TRIGGER, new_topic
from .telling import tell, tell_ready

if TYPE_CHECKING:
    from .graph import Graph

CALL_PERIOD_S = 0.2
NUMBER, CALL, NEW = "number", "call", "new"
"""What has an answer: a number of the topic, a call, the first message of a new topic."""


class Watcher:
    """Watches.

    Args:
        graph: Its graph.
        topics: Number of new topics.
    """

    def __init__(self, graph: Graph, topics: int) -> None:
        self._graph = graph
        self._topics = topics
        self._lock = threading.Lock()
        self._missing = {NUMBER, CALL, NEW}
        self._found: set[int] = set()
        self._begin = 0.0
        self._next = 0
        graph.take(TOPIC, TEXT, lambda message: self._tell(NUMBER, time.time(), int(message.data)))

    def step(self) -> float:
        """Call, and look for new topics; return the seconds until the next call."""
        self._graph.call(SERVICE, TRIGGER, self._answered)
        now = time.time()
        while self._begin and self._next < min(self._topics, (now - self._begin) / NEW_S):
            self._graph.take(new_topic(self._next), TEXT, partial(self._taken, self._next))
            self._next += 1
        return CALL_PERIOD_S

    def _answered(self, answer: Any) -> None:
        self._begin = float(answer.message)
        self._tell(CALL, time.time())

    def _taken(self, number: int, _message: Any) -> None:
        if number not in self._found:
            self._found.add(number)
            self._tell(NEW, time.time(), number)

    def _tell(self, what: str, at: float, number: int = 0) -> None:
        tell({"what": what, "at": at, "number": number})
        with self._lock:
            if what in self._missing:
                self._missing.discard(what)
                if not self._missing:
                    tell_ready()


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="watcher", description=__doc__)
    parser.add_argument("topics", type=int)
    options = parser.parse_args()
    graph = open_graph("watcher")
    graph.run(Watcher(graph, options.topics).step)


if __name__ == "__main__":
    main()
