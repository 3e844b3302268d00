"""The layers that a page can show of a robot, and the topics that they are made from. Pure.

A robot offers a topic to the station by an interface whose tag is ``layer_ROBOT_KEY``, such as
``layer_Robot1_scan``, in its own config or in its container. No connection belongs to it: the station makes
one while a page shows the layer.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class LayerTopic:
    """A topic that a layer is made from.

    Attributes:
        key: Names the topic in the tags of interfaces.
        type_name: Type of the messages.
        names: Names that the topic may have, without namespace; the first one is ROS's default.
        is_global: Whether all robots of a ROS graph may share the topic, outside of their namespaces.
    """

    key: str
    type_name: str
    names: tuple[str, ...]
    is_global: bool = False

    def interface_tag(self, robot: str) -> str:
        """Return the tag of the interface that offers this topic of a robot."""
        return f"layer_{robot}_{self.key}"


@dataclass(frozen=True, slots=True)
class LayerKind:
    """A layer.

    Attributes:
        name: Names the layer in messages between page and station.
        topic: The topic that it is made from.
        period_s: Minimum time between two frames, seconds.
        updates: The topic with changes of parts, if there is one.
        needs_transforms: Whether its messages are usually in another frame than the map's.
        is_on_robot: Whether this frame is fixed to the robot.
    """

    name: str
    topic: LayerTopic
    period_s: float
    updates: LayerTopic | None = field(default=None)
    needs_transforms: bool = False
    is_on_robot: bool = False


_GRID, _UPDATE = "nav_msgs/OccupancyGrid", "map_msgs/OccupancyGridUpdate"
_LOCAL, _GLOBAL = "move_base/local_costmap/costmap", "move_base/global_costmap/costmap"
_PLANS = ("move_base/NavfnROS/plan", "move_base/GlobalPlanner/plan", "plan")

MAP = LayerTopic("map", _GRID, ("map",), is_global=True)
SCAN = LayerTopic("scan", "sensor_msgs/LaserScan", ("scan",))
PARTICLES = LayerTopic("particles", "geometry_msgs/PoseArray", ("particlecloud",))
PLAN = LayerTopic("plan", "nav_msgs/Path", _PLANS)
LOCAL_COSTMAP = LayerTopic("local_costmap", _GRID, (_LOCAL,))
LOCAL_UPDATES = LayerTopic("local_costmap_updates", _UPDATE, (f"{_LOCAL}_updates",))
GLOBAL_COSTMAP = LayerTopic("global_costmap", _GRID, (_GLOBAL,))
GLOBAL_UPDATES = LayerTopic("global_costmap_updates", _UPDATE, (f"{_GLOBAL}_updates",))
TF = LayerTopic("tf", "tf2_msgs/TFMessage", ("tf",), is_global=True)
TF_STATIC = LayerTopic("tf_static", "tf2_msgs/TFMessage", ("tf_static",), is_global=True)

LAYERS = {
    kind.name: kind
    for kind in (
        LayerKind("map", MAP, 1.0),
        LayerKind("global_costmap", GLOBAL_COSTMAP, 1.0, GLOBAL_UPDATES),
        LayerKind("local_costmap", LOCAL_COSTMAP, 0.5, LOCAL_UPDATES, needs_transforms=True),
        LayerKind("plan", PLAN, 0.5, needs_transforms=True),
        LayerKind("particles", PARTICLES, 0.25),
        LayerKind("scan", SCAN, 0.1, needs_transforms=True, is_on_robot=True),
    )
}
"""All layers by name."""

TOPICS = (
    *(topic for kind in LAYERS.values() for topic in (kind.topic, kind.updates) if topic is not None),
    TF,
    TF_STATIC,
)
"""All topics of layers."""
