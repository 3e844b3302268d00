"""A small room with a robot, as its ROS nodes would publish it; for the page's layers and rviz."""

from __future__ import annotations

import asyncio
from math import cos, inf, nan, pi, sin
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.types import Time

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher

RESOLUTION = 0.05
SIDE_M = 8.0
CELLS = int(SIDE_M / RESOLUTION)
RANGES = 360
ROBOT = (2.5, 3.0, 0.6)
"""Pose of the robot: metres, radians."""
STATE: dict[str, Any] = {
    "rows": 8,
    "columns": 8,
    "cell_size": 1.0,
    "origin_x": 0.0,
    "origin_y": 0.0,
    "blocked": [27],
    "pending": [],
    "walls": [],
    "started": "1.0",
    "robots": [
        {
            "id": robot,
            "state": "idle",
            "reason": "",
            "cell": cell,
            "goal": -1,
            "plan": [],
            "granted": [],
            "replans": 0,
        }
        for robot, cell in (("Robot1", 26), ("Robot2", 45))
    ],
}
"""A ``fleet/FleetState`` in its JSON form, of a fleet in this room."""


def room() -> np.ndarray[Any, np.dtype[np.int8]]:
    """The map of the room, shape (rows, columns): walls around it, a block, and a part that is unknown."""
    cells = np.zeros((CELLS, CELLS), np.int8)
    cells[:3] = cells[-3:] = 100
    cells[:, :3] = cells[:, -3:] = 100
    cells[70:90, 66:86] = 100
    cells[120:, 120:] = -1
    return cells


def header(frame: str, stamp: float) -> dict[str, Any]:
    """The fields of a ``std_msgs/Header``."""
    return {"frame_id": frame, "stamp": Time(int(stamp), int(stamp % 1 * 1e9))}


def pose(x: float, y: float, yaw: float) -> dict[str, Any]:
    """The fields of a ``geometry_msgs/Pose``."""
    turned = {"x": 0.0, "y": 0.0, "z": sin(yaw / 2), "w": cos(yaw / 2)}
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turned}


def grid(
    frame: str, stamp: float, cells: np.ndarray[Any, np.dtype[np.int8]], origin: dict[str, Any]
) -> dict[str, Any]:
    """The fields of a ``nav_msgs/OccupancyGrid``."""
    rows, columns = cells.shape
    info = {"resolution": RESOLUTION, "width": columns, "height": rows, "origin": origin}
    return {"header": header(frame, stamp), "info": info, "data": cells.ravel().tolist()}


def scan(frame: str, stamp: float, **changes: Any) -> dict[str, Any]:
    """The fields of a ``sensor_msgs/LaserScan``: the room's walls, one ray without a return, one NaN."""
    x, y, yaw = ROBOT
    ranges = []
    for index in range(RANGES):
        turn = yaw - pi + 2 * pi * index / RANGES
        along = [
            ((SIDE_M - 0.15 if part > 0 else 0.15) - start) / part
            for start, part in ((x, cos(turn)), (y, sin(turn)))
            if abs(part) > 1e-9
        ]
        ranges.append(min(along))
    ranges[10], ranges[20] = inf, nan
    return {
        "header": header(frame, stamp),
        "angle_min": -pi,
        "angle_max": pi - 2 * pi / RANGES,
        "angle_increment": 2 * pi / RANGES,
        "range_min": 0.1,
        "range_max": 12.0,
        "ranges": ranges,
        **changes,
    }


def transform(parent: str, child: str, stamp: float, x: float, y: float, yaw: float) -> dict[str, Any]:
    """The fields of a ``geometry_msgs/TransformStamped``."""
    turned = pose(0.0, 0.0, yaw)["orientation"]
    moved = {"translation": {"x": x, "y": y, "z": 0.0}, "rotation": turned}
    return {"header": header(parent, stamp), "child_frame_id": child, "transform": moved}


class RobotTopics:
    """Publishes all topics of layers of a robot that stands in the room.

    Args:
        node: The node that publishes; its namespace is the robot's.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers: dict[str, Publisher] = {}

    async def start(self) -> None:
        """Advertise all topics, and publish those that are latched."""
        for name, kind, latch in (
            ("map", "nav_msgs/OccupancyGrid", True),
            ("scan", "sensor_msgs/LaserScan", False),
            ("particlecloud", "geometry_msgs/PoseArray", False),
            ("move_base/NavfnROS/plan", "nav_msgs/Path", True),
            ("move_base/global_costmap/costmap", "nav_msgs/OccupancyGrid", True),
            ("move_base/local_costmap/costmap", "nav_msgs/OccupancyGrid", True),
            ("move_base/local_costmap/costmap_updates", "map_msgs/OccupancyGridUpdate", False),
            ("tf", "tf2_msgs/TFMessage", False),
            ("tf_static", "tf2_msgs/TFMessage", True),
        ):
            self._publishers[name] = await self._node.advertise(name, kind, latch=latch)
        now = self._node.time()
        self.send("map", **grid("map", now, room(), pose(0.0, 0.0, 0.0)))
        self.send("move_base/global_costmap/costmap", **grid("map", now, self.costs(), pose(0.0, 0.0, 0.0)))
        self.send("tf_static", transforms=[transform("base_link", "laser", now, 0.1, 0.0, 0.0)])
        path = [pose(2.5 + 0.1 * k, 3.0 + 0.02 * k * k / 4, 0.4) for k in range(30)]
        poses = [{"header": header("map", now), "pose": one} for one in path]
        self.send("move_base/NavfnROS/plan", header=header("map", now), poses=poses)
        local = np.zeros((60, 60), np.int8)
        local[40:46, 30:60], local[46:50, 30:60] = 99, 100
        self.send("move_base/local_costmap/costmap", **grid("odom", now, local, pose(0.5, 0.5, 0.0)))

    async def run(self) -> None:
        """Publish the others ten times a second until cancelled."""
        while True:
            self.publish_once()
            await asyncio.sleep(0.1)

    def publish_once(self) -> None:
        """Publish transforms, scan and particle cloud once."""
        now = self._node.time()
        x, y, yaw = ROBOT
        edges = [transform("map", "odom", now, x - 2.0, y - 2.0, 0.0)]
        edges.append(transform("odom", "base_link", now, 2.0, 2.0, yaw))
        self.send("tf", transforms=edges)
        self.send("scan", **scan("laser", now))
        draw = np.random.default_rng(1)
        cloud = [pose(*(np.array(ROBOT) + draw.normal(0.0, 0.15, 3))) for _ in range(200)]
        self.send("particlecloud", header=header("map", now), poses=cloud)

    def costs(self) -> np.ndarray[Any, np.dtype[np.int8]]:
        """The room as a costmap, with costs that fall with the distance."""
        cells = room()
        costs = np.where(cells == 100, 100, 0).astype(np.int8)
        reached = costs == 100
        for cost in (99, 99, 80, 60, 40, 25, 12, 5):
            grown = reached.copy()
            grown[1:] |= reached[:-1]
            grown[:-1] |= reached[1:]
            grown[:, 1:] |= reached[:, :-1]
            grown[:, :-1] |= reached[:, 1:]
            costs[grown & ~reached] = cost
            reached = grown
        return costs

    def send(self, topic: str, **fields: Any) -> None:
        """Publish a message."""
        self._publishers[topic].publish(fields)
