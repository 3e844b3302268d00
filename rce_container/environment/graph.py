"""What an environment needs of the graph that its container's nodes talk in; ROS 1 is one such graph.

An environment knows topics, services and parameters by name only. How nodes find the graph, how it names
types and what its messages look like is the graph's own affair (:mod:`rce_container.environment.ros1_graph`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rce.link import Interface, Port
    from rce.model import ParameterValue


class GraphError(Exception):
    """The graph refuses something; the text says why."""


class Subscription(Protocol):
    """A topic that is listened to."""

    async def close(self) -> None:
        """Listen no longer."""


class NodeListener(Protocol):
    """Listens to nodes that appear in the graph."""

    def node_appeared(self, name: str) -> bool:
        """Take note of a node; return whether its name says which process it is."""

    def node_identified(self, name: str, pid: int) -> None:
        """Take note of the process of a node whose name did not say it."""


class Graph(Protocol):
    """The graph of one container, while it lives."""

    @property
    def variables(self) -> Mapping[str, str]:
        """Environment variables by which nodes find the graph."""

    def make_interface(self, port: Port) -> Interface:
        """Make an end of connections that is a topic or service of the graph (an ``InterfaceFactory``).

        Raises:
            InterfaceError: The port's spec cannot be fulfilled; the text says what to do.
        """

    def set_parameter(self, name: str, value: ParameterValue) -> None:
        """Set a parameter."""

    def delete_parameter(self, name: str) -> None:
        """Delete a parameter that was set."""

    async def listen(self, topic: str, on_message: Callable[[], None]) -> Subscription:
        """Call ``on_message`` for each message of a topic, of any type.

        Raises:
            GraphError: The topic cannot be listened to.
        """

    async def wait_for_service(self, service: str, timeout: float) -> None:
        """Wait until a service answers.

        Raises:
            GraphError: None does within ``timeout`` seconds.
        """

    async def save_state(self, service: str, timeout: float) -> bytes:
        """Ask a node for its state.

        Raises:
            GraphError: It did not give it within ``timeout`` seconds.
        """

    async def restore_state(self, service: str, state: bytes, timeout: float) -> None:
        """Give a node its state.

        Raises:
            GraphError: It did not take it within ``timeout`` seconds.
        """

    async def watch_nodes(self, listener: NodeListener) -> None:
        """Report nodes that register, until cancelled."""
