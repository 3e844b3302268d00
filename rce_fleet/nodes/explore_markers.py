"""Frontiers as markers, as rviz shows them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from rce.ros.node import Node, Publisher
    from rce_fleet.navigation.exploration.explorer import Explorer
    from rce_fleet.navigation.exploration.frontiers import FrontierSearch

SPHERE, POINTS = 2, 8
ADD, DELETE_ALL = 0, 3
"""Values of ``visualization_msgs/Marker``."""
OPEN = {"b": 1.0, "a": 1.0}
OVER = {"r": 1.0, "a": 1.0}
GOAL = {"g": 1.0, "a": 1.0}
POINT_SIZE, GOAL_SIZE = 0.1, 0.25


class FrontierMarkers:
    """Publishes ``~frontiers``: open frontiers in blue, others in red, the present goal in green.

    Args:
        node: Running node.
        publisher: Of the topic.
    """

    def __init__(self, node: Node, publisher: Publisher) -> None:
        self._node = node
        self._publisher = publisher

    @classmethod
    async def start(cls, node: Node) -> Self:
        """Return the markers of a node."""
        return cls(node, await node.advertise("~frontiers", "visualization_msgs/MarkerArray", latch=True))

    def publish(self, search: FrontierSearch, explorer: Explorer, frame: str) -> None:
        """Publish the frontiers of a map, in place of those before.

        Args:
            search: The frontiers.
            explorer: Knows which of them are over, and where the robot drives.
            frame: The map's frame.
        """
        header = {"frame_id": frame.lstrip("/"), "stamp": self._node.now()}
        markers: list[dict[str, Any]] = [{"header": header, "action": DELETE_ALL}]
        groups = [(one.points, OVER if explorer.is_over(one) else OPEN) for one in search.frontiers]
        groups += [(points, OVER) for points in search.unreachable]
        for number, (points, color) in enumerate(groups):
            markers.append(_marker(header, number, POINTS, POINT_SIZE, color, points=_points(points)))
        if explorer.target is not None:
            goal = explorer.target.goal
            place = {"position": {"x": goal.x, "y": goal.y}, "orientation": {"w": 1.0}}
            markers.append(_marker(header, len(groups), SPHERE, GOAL_SIZE, GOAL, pose=place))
        self._publisher.publish(markers=markers)


def _marker(
    header: dict[str, Any], number: int, shape: int, size: float, color: dict[str, float], **fields: Any
) -> dict[str, Any]:
    scale = {"x": size, "y": size, "z": size}
    upright = {"pose": {"orientation": {"w": 1.0}}}
    return {
        "header": header,
        "ns": "frontiers",
        "id": number,
        "type": shape,
        "action": ADD,
        "scale": scale,
        "color": color,
        **upright,
        **fields,
    }


def _points(points: NDArray[Any]) -> Iterable[dict[str, float]]:
    return [{"x": float(x), "y": float(y)} for x, y in points]
