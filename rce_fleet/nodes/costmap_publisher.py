"""Publishes a costmap as ROS's costmap_2d does: whole when it moved or a subscriber joined, else areas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.costmap.cost_grid import NOWHERE, Area
from rce_fleet.navigation.costmap.costs import to_occupancy
from rce_fleet.nodes.planar import pose_fields

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher
    from rce_fleet.navigation.costmap.layered import LayeredCostmap


WHOLE_EVERY = 10.0
"""Seconds after which a whole costmap is published again: clients of a bridge join unnoticed."""


class CostmapPublisher:
    """Publishes ``~NAME/costmap``, ``~NAME/costmap_updates`` and ``~NAME/footprint``.

    Args:
        node: Running node.
        name: ``global_costmap`` or ``local_costmap``.
        costmap: The costmap.
    """

    def __init__(self, node: Node, name: str, costmap: LayeredCostmap) -> None:
        self._node = node
        self._name = name
        self._costmap = costmap
        self._changed = NOWHERE
        self._sent: tuple[object, ...] = ()
        self._readers = 0
        self._published_at = self._renewed_at = float("-inf")
        self._whole: Publisher
        self._updates: Publisher
        self._footprint: Publisher

    async def start(self) -> None:
        """Advertise the topics."""
        node, name = self._node, self._name
        # Latched, so that a bridge gives the last one to clients that join it later.
        self._whole = await node.advertise(
            f"~{name}/costmap", "nav_msgs/OccupancyGrid", latch=True, queue_size=2
        )
        self._updates = await node.advertise(f"~{name}/costmap_updates", "map_msgs/OccupancyGridUpdate")
        self._footprint = await node.advertise(f"~{name}/footprint", "geometry_msgs/PolygonStamped")

    def note(self, changed: Area) -> None:
        """Note which cells changed since the last call."""
        self._changed = self._changed.joined(changed)

    def publish(self, robot: Pose, frame: str) -> None:
        """Publish what changed, if it is time and there are subscribers.

        Args:
            robot: Pose of the robot in the costmap's frame.
            frame: Full name of this frame.
        """
        now, frequency = self._node.time(), self._costmap.parameters.publish_frequency
        if frequency <= 0 or 0 <= now - self._published_at < 1 / frequency:
            return
        self._published_at = now
        header = {"stamp": self._node.now(), "frame_id": frame}
        if self._footprint.connections:
            outline = self._costmap.footprint.at(robot.x, robot.y, robot.yaw)
            points = [{"x": float(x), "y": float(y)} for x, y in outline]
            self._footprint.publish(header=header, polygon={"points": points})
        readers = self._whole.connections
        grid = self._costmap.grid
        place = (grid.shape, grid.origin, grid.resolution)
        renew = readers > self._readers or not 0 <= now - self._renewed_at < WHOLE_EVERY
        self._readers = readers
        if not readers:
            self._sent = ()
            return
        changed = self._changed.clipped(*grid.shape)
        if renew or place != self._sent or self._costmap.parameters.always_send_full_costmap:
            self._publish_whole(header)
            self._sent, self._renewed_at = place, now
        elif not changed.is_empty:
            self._publish_update(header, changed)
        self._changed = NOWHERE

    def _publish_whole(self, header: dict[str, Any]) -> None:
        grid = self._costmap.grid
        rows, columns = grid.shape
        self._whole.publish(
            header=header,
            info={
                "map_load_time": header["stamp"],
                "resolution": grid.resolution,
                "width": columns,
                "height": rows,
                "origin": pose_fields(Pose(*grid.origin, 0.0)),
            },
            data=to_occupancy(grid.values).reshape(-1),
        )

    def _publish_update(self, header: dict[str, Any], area: Area) -> None:
        values = to_occupancy(self._costmap.grid.values[area.slices])
        self._updates.publish(
            header=header,
            x=area.left,
            y=area.low,
            width=values.shape[1],
            height=values.shape[0],
            data=values.reshape(-1),
        )
