"""What a program of one robot sees of another robot and can do to it: ``reach NUMBER CORE_URI``.

The other robot's number, and the address of the core that its programs use. It looks, sends velocities to the
other robot, calls its service, looks again, as what is shared may come late, and at last tells the other
robot's nodes to end, all by ordinary means of ROS.
"""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from .core_api import CoreApi
from .graph import open_graph
from .robot_base import TRIGGER, TWIST
from .telling import tell

if TYPE_CHECKING:
    from .graph import Graph, Output

PERIOD_S = 0.2
SECONDS = 2.0
"""How long it tries."""
END = {"phase": "end"}
TOLD_TO_END = "nodes_told_to_end"


class Reach:
    """Tries, step by step.

    Args:
        graph: The robot's.
        core: Of its graph.
        other: Of the other robot.
        number: The other robot's.
    """

    def __init__(self, graph: Graph, core: CoreApi, other: CoreApi, number: int) -> None:
        self._graph = graph
        self._core = core
        self._other = other
        self._name = f"/Robot{number}"
        self._own = f"{self._name}/cmd_vel"
        """The topic that it sends to."""
        self._output: Output | None = None
        self._seen: dict[str, int] = {}
        """The largest counts so far."""
        self._begin = 0.0
        self._is_told = False

    def step(self) -> float:
        """Do what is next; return the seconds until the next call."""
        if not self._begin:
            self._begin = time.monotonic()
            self._look()
            self._output = self._graph.output(self._own, TWIST)
        elif self._is_told or self._output is None:
            return PERIOD_S
        elif time.monotonic() - self._begin < SECONDS:
            self._output.send({})
            self._graph.call(f"{self._name}/enable", TRIGGER, lambda _answer: None)
        else:
            self._is_told = True
            self._look()
            nodes = self._nodes()
            tell({**self._seen, TOLD_TO_END: len(nodes)})
            for node in nodes:
                self._core.end_node(node)
            tell(END)
        return PERIOD_S

    def _look(self) -> None:
        # Its own topic is not the other robot's.
        topics = [topic for topic in self._core.published_topics() if topic != self._own]
        found = {
            "topics_visible": len(topics),
            "topics_others": len(self._of_other(topics)),
            "nodes_others": len(self._nodes()),
            "parameters_others": len(self._of_other(self._core.parameters())),
            "can_use_core": int(self._other.answers()),
        }
        self._seen = {name: max(count, self._seen.get(name, 0)) for name, count in found.items()}

    def _nodes(self) -> list[str]:
        return self._of_other(self._core.nodes())

    def _of_other(self, names: list[str]) -> list[str]:
        return [name for name in names if name.startswith((f"{self._name}/", f"{self._name}_"))]


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="reach", description=__doc__)
    parser.add_argument("number", type=int)
    parser.add_argument("core_uri")
    options = parser.parse_args()
    graph = open_graph("reach")
    reach = Reach(graph, CoreApi("/reach"), CoreApi("/reach", options.core_uri), options.number)
    graph.run(reach.step)


if __name__ == "__main__":
    main()
