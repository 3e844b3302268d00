"""What a robot uses on the server: ``provider TOPICS`` publishes numbers and provides a service.

From the first call on it makes a new topic now and then, ``TOPICS`` in all, and publishes on the newest ones.
The answer of the service says when the first call was, from which the caller knows when topics are made. Each
second the program tells how many numbers it has sent.
"""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from .graph import open_graph
from .telling import tell

if TYPE_CHECKING:
    from .graph import Graph, Output

TOPIC, TEXT = "/numbers", "std_msgs/String"
SERVICE, TRIGGER = "/begin", "std_srvs/Trigger"
PERIOD_S = 0.1
"""From one number to the next."""
NEW_S = 1.5
"""From one new topic to the next."""
NEWEST = 3
"""So many of the newest topics have messages."""
TELL_EVERY = 10


def new_topic(number: int) -> str:
    """Return the name of a new topic."""
    return f"/new_{number}"


class Provider:
    """Publishes and provides.

    Args:
        graph: Its graph.
        topics: Number of topics that it makes.
    """

    def __init__(self, graph: Graph, topics: int) -> None:
        self._graph = graph
        self._topics = topics
        self._output = graph.output(TOPIC, TEXT)
        self._new: list[Output] = []
        self._begin = 0.0
        self._sent = 0
        self._due = time.monotonic()
        graph.provide(SERVICE, TRIGGER, self.answer)

    def answer(self) -> dict[str, Any]:
        """Answer a call: when the first one was, seconds since 1970."""
        self._begin = self._begin or time.time()
        return {"success": True, "message": repr(self._begin)}

    def step(self) -> float:
        """Send what is due; return the seconds until the next call."""
        self._output.send({"data": str(self._sent)})
        self._sent += 1
        if self._sent % TELL_EVERY == 0:
            tell({"sent": self._sent, "at": time.time()})
        if self._begin and len(self._new) < min(self._topics, (time.time() - self._begin) / NEW_S):
            self._new.append(self._graph.output(new_topic(len(self._new)), TEXT))
        for output in self._new[-NEWEST:]:
            output.send({})
        now = time.monotonic()
        self._due = max(self._due + PERIOD_S, now)
        return self._due - now


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="provider", description=__doc__)
    parser.add_argument("topics", type=int)
    options = parser.parse_args()
    graph = open_graph("provider")
    graph.run(Provider(graph, options.topics).step)


if __name__ == "__main__":
    main()
