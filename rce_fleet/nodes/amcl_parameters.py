"""Parameters of the node ``amcl``: those of the filter, and those of its topics and frames."""

from __future__ import annotations

from dataclasses import dataclass, field

from rce_fleet.localization.parameters import AmclParameters

UNUSED = (
    "bag_scan_period",
    "force_update_after_initialpose",
    "force_update_after_set_map",
    "gui_publish_rate",
    "restore_defaults",
)
"""Parameters of ROS 1's node without use here: it always updates after an initial pose or a new map."""


@dataclass(frozen=True, kw_only=True)
class AmclNodeParameters(AmclParameters):
    """All parameters of the node.

    Attributes:
        odom_frame_id: Frame of the odometry.
        base_frame_id: Frame of the robot's base.
        global_frame_id: Frame of the map.
        transform_tolerance: Seconds that a published transform is dated into the future.
        tf_broadcast: Whether ``map`` -> ``odom`` is published.
        use_map_topic: Take the map from the topic ``map`` instead of the service ``static_map``.
        first_map_only: Ignore all maps on the topic but the first.
        last_pose_timeout: How long the node waits at its start for the service ``last_pose`` of the node
            ``pose_keeper``, which knows where the robot was localized before, seconds; 0: not at all.
        save_pose_rate: How often the pose is stored in the parameters ``initial_pose_*``, ``initial_cov_*``
            and ``stored_pose``, 1/s; not positive: never.
        stored_pose: Set by the node: the pose of ``initial_pose_*`` with the odometry of its time, as JSON.
            While they have the same pose, the node that is started again begins where the robot has driven
            since.
        std_warn_level_x: Standard deviation from which ``/diagnostics`` warns, metres.
        std_warn_level_y: The same along y.
        std_warn_level_yaw: The same of the heading, radians.
        compiled: Compile the inner loops when the node starts. This needs ``rce[compiled]``, a second and
            about 100 MB of memory; without it the answers are the same. The beam model always does it.
    """

    odom_frame_id: str = "odom"
    base_frame_id: str = "base_link"
    global_frame_id: str = "map"
    transform_tolerance: float = field(default=0.1, metadata={"minimum": 0.0})
    tf_broadcast: bool = True
    use_map_topic: bool = False
    first_map_only: bool = False
    last_pose_timeout: float = field(default=0.0, metadata={"minimum": 0.0})
    save_pose_rate: float = 0.5
    stored_pose: str = ""
    std_warn_level_x: float = field(default=0.2, metadata={"above": 0.0})
    std_warn_level_y: float = field(default=0.2, metadata={"above": 0.0})
    std_warn_level_yaw: float = field(default=0.1, metadata={"above": 0.0})
    compiled: bool = False
