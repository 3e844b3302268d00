"""The grid of a fleet as ``nav_msgs/OccupancyGrid``: one pixel per cell, on ``/fleet/map``.

Earlier planners published it as ``/map``, which is now the map that robots localize on. Robot files from
before still connect ``/map``: the planner publishes the grid there too while only an environment's interfaces
listen, and a move client that hears no ``/fleet/map`` takes it from there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.occupancy import occupancy
from rce_fleet.nodes.planar import pose_fields, read_pose
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rce.ros.types import Message, Time

GRID_TOPIC = "/fleet/map"
OLD_TOPIC = "/map"
ENVIRONMENT = "/rce_environment"
"""The node of a container's interfaces."""
LEAST_CELL = 0.2
"""On the old topic, a map with smaller pixels is one that robots localize on, metres."""
MAP_FRAME = "map"


def grid_fields(
    grid: GridMap, blocked: Iterable[int], stamp: Time, made: Time | None = None
) -> dict[str, Any]:
    """Return the fields of a grid's message.

    Args:
        grid: The grid.
        blocked: Cells that are blocked besides the grid's own.
        stamp: When it holds.
        made: When the planner took the grid; names it. By default ``stamp``.
    """
    picture = occupancy(grid, blocked)
    return {
        "header": {"stamp": stamp, "frame_id": MAP_FRAME},
        "info": {
            "map_load_time": stamp if made is None else made,
            "resolution": picture.resolution,
            "width": picture.width,
            "height": picture.height,
            "origin": pose_fields(Pose(*picture.origin, picture.yaw)),
        },
        "data": picture.data,
    }


def read_grid(message: Message) -> GridMap:
    """Return size and place of the cells of a grid's message: one pixel is one cell.

    Raises:
        ValueError: They are not those of a grid.
    """
    info = message.info
    corner = read_pose(info.origin)
    return GridMap(
        rows=info.height,
        columns=info.width,
        cell_size=info.resolution,
        origin=(corner.x, corner.y),
        yaw=corner.yaw,
    )


def grid_name(made: Time) -> str:
    """Return the name of a grid in lists of cells: when the planner took it; empty if that is unknown."""
    return f"{made.secs}.{made.nsecs:09}" if made else ""


def wants_old_topic(
    publishers: Mapping[str, Sequence[str]], subscribers: Mapping[str, Sequence[str]], planner: str
) -> bool:
    """Return whether the grid has to be on the old topic too, for robot files from before.

    Args:
        publishers: Topic to nodes.
        subscribers: Topic to nodes.
        planner: Name of the planner's node.
    """
    others = set(publishers.get(OLD_TOPIC, ())) - {planner}
    return not others and set(subscribers.get(OLD_TOPIC, ())) == {ENVIRONMENT}
