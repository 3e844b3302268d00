"""Parameters of the node ``slam_graph``."""

from __future__ import annotations

from dataclasses import dataclass, field

from rce_fleet.mapping.graph.parameters import GraphParameters

GMAPPING_ONLY = (
    "astep",
    "inverted_laser",
    "iterations",
    "kernelSize",
    "lasamplerange",
    "lasamplestep",
    "llsamplerange",
    "llsamplestep",
    "lsigma",
    "lskip",
    "lstep",
    "maxRange",
    "minimumScore",
    "ogain",
    "particles",
    "resampleThreshold",
    "sigma",
    "srr",
    "srt",
    "str",
    "stt",
    "temporalUpdate",
    "xmax",
    "xmin",
    "ymax",
    "ymin",
)
"""Parameters of ``slam_gmapping`` without use here: a launch file of gmapping can be used as it is."""


@dataclass(frozen=True, kw_only=True)
class SlamGraphParameters:
    """Parameters of ``slam_graph``; names and defaults are those of ``slam_gmapping`` where it has them.

    Attributes:
        robots: Namespaces of the robots that are mapped together, such as ``[Robot1, Robot2]``; by default
            the one in the node's own namespace.
        base_frame: Frame of the robot's base. With ``robots`` each has its own: ``Robot1/base_link``.
        map_frame: Frame of the map.
        odom_frame: Frame of the odometry; with ``robots`` as ``base_frame``.
        use_odom_topic: Take odometry from the topic ``odom`` instead of ``tf``; the laser is then at
            ``laser_pose``.
        laser_pose: Pose of the laser on the base, x, y (metres) and yaw (radians), with ``use_odom_topic``.
        throttle_scans: Use one in so many scans.
        map_update_interval: Time between two published maps, seconds.
        transform_publish_period: Time between two published transforms, seconds; 0 publishes none.
        tf_delay: Transforms are dated this far into the future, seconds; by default
            ``transform_publish_period``.
        linearUpdate: A scan becomes part of the map after this way, metres.
        angularUpdate: ... or this turn, radians.
        maxUrange: Points farther from the laser are not used, metres.
        delta: Cell size of the map, metres.
        occ_thresh: A cell is occupied if more than this share of the beams through it ended there.
        map_file: File of the graph map (``.npz``): what ``~save_map`` writes and ``~load_map`` reads.
        load_map: Load ``map_file`` when the node starts, and continue it.
        initial_pose: About where the first robot starts on a loaded map, x, y, yaw; without it the robot is
            searched. On a new map, exactly where; without it at 0, 0, 0.
        localize_only: Localize the robots in ``map_file``, and leave the map as it is.
    """

    robots: tuple[str, ...] = ()
    base_frame: str = "base_link"
    map_frame: str = "map"
    odom_frame: str = "odom"
    use_odom_topic: bool = False
    laser_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    throttle_scans: int = field(default=1, metadata={"minimum": 1})
    map_update_interval: float = field(default=5.0, metadata={"above": 0.0})
    transform_publish_period: float = field(default=0.05, metadata={"minimum": 0.0})
    tf_delay: float | None = field(default=None, metadata={"minimum": 0.0})
    linear_update: float = field(default=0.3, metadata={"name": "linearUpdate", "minimum": 0.05})
    angular_update: float = field(default=0.25, metadata={"name": "angularUpdate", "minimum": 0.02})
    max_usable_range: float = field(default=30.0, metadata={"name": "maxUrange", "above": 0.0})
    delta: float = field(default=0.05, metadata={"minimum": 0.005, "maximum": 1.0})
    occ_thresh: float = field(default=0.25, metadata={"minimum": 0.0, "maximum": 1.0})
    map_file: str = ""
    load_map: bool = False
    initial_pose: tuple[float, ...] = ()
    localize_only: bool = False

    def graph_parameters(self) -> GraphParameters:
        """Return the parameters of the mapper."""
        return GraphParameters(
            usable_range=self.max_usable_range,
            key_distance=self.linear_update,
            key_turn=self.angular_update,
        )
