"""A node's state on ``/diagnostics``, as ROS's diagnostic tools and rviz show it."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce.ros.node import Node, Publisher

TOPIC = "/diagnostics"


class Level(IntEnum):
    """The levels of ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Diagnostics:
    """Publishes one status of a node.

    Args:
        node: The node.
        name: Name of the status.
        publisher: Of ``/diagnostics``.
    """

    def __init__(self, node: Node, name: str, publisher: Publisher) -> None:
        self._node = node
        self._name = name
        self._publisher = publisher

    @classmethod
    async def start(cls, node: Node, name: str) -> Self:
        """Return the diagnostics of a running node."""
        return cls(node, name, await node.advertise(TOPIC, "diagnostic_msgs/DiagnosticArray"))

    def publish(self, level: Level, message: str, values: Mapping[str, str]) -> None:
        """Publish the state."""
        status = {
            "level": int(level),
            "name": f"{self._node.name}: {self._name}",
            "message": message,
            "hardware_id": self._node.namespace.strip("/"),
            "values": [{"key": key, "value": value} for key, value in values.items()],
        }
        self._publisher.publish(header={"stamp": self._node.now()}, status=[status])
