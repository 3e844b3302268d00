"""A ROS graph as the programs of the experiments see it: by rospy, or by our nodes."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

SOFTWARE = "EXPERIMENT_SOFTWARE"
"""Environment variable that says by what: ``ros``, ``client`` (of an engine), or ``rce``, the default."""
QUEUE = 10
"""Messages that wait for a slow subscriber before the oldest is dropped."""


CALL_S = 10.0
"""How long a call of our nodes may take; rospy's have no limit."""


class Stamp(NamedTuple):
    """Header of a message.

    Attributes:
        ns: Nanoseconds since 1970.
        frame: The frame, by which programs of the experiments say what a message is part of.
    """

    ns: int
    frame: str


class Output(Protocol):
    """A topic that the program publishes."""

    def send(self, fields: Mapping[str, Any], stamp: Stamp | None = None) -> None:
        """Publish a message with these fields, and with a header."""


class Graph(Protocol):
    """Where a program publishes and subscribes, provides services and calls them.

    What is asked for while the program runs is made beside the rest, since a core that has ended or cannot be
    reached may keep it waiting. If it cannot be made, an error is printed.
    """

    def output(self, topic: str, kind: str) -> Output:
        """Publish a topic of a type."""

    def take(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Call back with each message of a topic; with rospy, in a thread of the connection."""

    def provide(self, service: str, kind: str, answer: Callable[[], Mapping[str, Any]]) -> None:
        """Answer the calls of a service with these fields; with rospy, in a thread of the connection."""

    def call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Call a service without fields; call back with its answer, if there is one.

        The service's provider is looked up for each call, as rospy and roscpp do unless told otherwise.
        """

    def run(self, step: Callable[[], float]) -> None:
        """Call ``step`` until the program is told to stop; it returns the seconds until its next call."""


def open_graph(name: str) -> Graph:
    """Return the graph that the environment asks for.

    Args:
        name: Of the program's node.
    """
    if os.environ.get(SOFTWARE) == "ros":
        from .ros_graph import RosGraph

        return RosGraph(name)
    if os.environ.get(SOFTWARE) == "client":
        from .client_graph import ClientGraph

        return ClientGraph()
    from .rce_graph import RceGraph

    return RceGraph(name)


def stamp_of(message: Any) -> Stamp:
    """Return the header of a message."""
    stamp = message.header.stamp
    return Stamp(stamp.secs * 1_000_000_000 + stamp.nsecs, message.header.frame_id)
