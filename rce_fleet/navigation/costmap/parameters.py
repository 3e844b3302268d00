"""Parameters of a costmap: names and defaults of ROS 1's costmap_2d."""

from __future__ import annotations

from dataclasses import dataclass, field

from rce_fleet.navigation.costmap.footprint import Footprint

MAX_CELLS = 100_000_000
"""Maximum size of a costmap without a map, so that a wrong parameter does not fill the memory."""


@dataclass(frozen=True, slots=True)
class ObservationSource:
    """A sensor of the obstacle layer: ``~NAME_costmap/obstacle_layer/SOURCE/...``.

    Attributes:
        topic: Topic; empty: the source's name.
        sensor_frame: Frame of the sensor; empty: the frame that its messages name.
        observation_persistence: Seconds for which an observation is kept; 0: only the latest.
        expected_update_rate: Seconds between two messages above which the robot does not drive; 0: any.
        data_type: ``LaserScan``, ``PointCloud`` or ``PointCloud2``.
        clearing: Rays clear cells.
        marking: Hits mark cells.
        max_obstacle_height: Highest point that is used, metres.
        min_obstacle_height: Lowest point that is used, metres.
        obstacle_range: Farthest hit that marks a cell, metres.
        obstacle_min_range: Nearest hit that marks a cell, metres (from nav2).
        raytrace_range: Farthest cell that a ray clears, metres.
        raytrace_min_range: Nearest cell that a ray clears, metres (from nav2).
        inf_is_valid: A beam without return clears up to its longest range; else it is ignored.
    """

    topic: str = ""
    sensor_frame: str = ""
    observation_persistence: float = 0.0
    expected_update_rate: float = 0.0
    data_type: str = "PointCloud"
    clearing: bool = False
    marking: bool = True
    max_obstacle_height: float = 2.0
    min_obstacle_height: float = 0.0
    obstacle_range: float = 2.5
    obstacle_min_range: float = 0.0
    raytrace_range: float = 3.0
    raytrace_min_range: float = 0.0
    inf_is_valid: bool = False


@dataclass(frozen=True, slots=True)
class StaticLayerParameters:
    """The layer of the map: ``~NAME_costmap/static_layer/...``.

    Attributes:
        enabled: Whether the layer is used.
        map_topic: Topic of the map.
        first_map_only: Ignore later maps.
        subscribe_to_updates: Take ``MAP_TOPIC_updates`` too.
        track_unknown_space: Unknown pixels stay unknown; else they are free.
        use_maximum: The larger cost of this and the layers below counts; else this one replaces them.
        unknown_cost_value: The pixel value that means unknown.
        lethal_cost_threshold: Pixel values from this on are obstacles.
        trinary_costmap: Only free, obstacle and unknown; else costs in proportion.
    """

    enabled: bool = True
    map_topic: str = "map"
    first_map_only: bool = False
    subscribe_to_updates: bool = False
    track_unknown_space: bool = True
    use_maximum: bool = False
    unknown_cost_value: int = -1
    lethal_cost_threshold: int = 100
    trinary_costmap: bool = True


@dataclass(frozen=True, slots=True)
class ObstacleLayerParameters:
    """The layer of what sensors see: ``~NAME_costmap/obstacle_layer/...``.

    Attributes:
        enabled: Whether the layer is used.
        observation_sources: Names of the sources, separated by spaces.
        track_unknown_space: Cells that no sensor has seen are unknown; else they are free.
        footprint_clearing_enabled: Cells under the robot are cleared.
        combination_method: 1: the larger cost counts; 0: this layer replaces those below.
    """

    enabled: bool = True
    observation_sources: str = ""
    track_unknown_space: bool = False
    footprint_clearing_enabled: bool = True
    combination_method: int = 1


@dataclass(frozen=True, slots=True)
class InflationParameters:
    """The layer of costs around obstacles: ``~NAME_costmap/inflation_layer/...``.

    Attributes:
        enabled: Whether the layer is used.
        inflation_radius: Distance up to which cells have a cost, metres.
        cost_scaling_factor: How quickly costs fall with the distance, per metre.
        inflate_unknown: Costs are written into unknown cells too.
    """

    enabled: bool = True
    inflation_radius: float = 0.55
    cost_scaling_factor: float = 10.0
    inflate_unknown: bool = False


@dataclass(frozen=True)
class CostmapGridParameters:
    """Size and frame of a costmap: ``~global_costmap/...`` or ``~local_costmap/...``.

    Attributes:
        global_frame: Frame of the costmap.
        robot_base_frame: Frame of the robot's centre.
        transform_tolerance: Oldest transform with which the robot drives, seconds.
        update_frequency: Updates in a second.
        publish_frequency: Publications in a second; 0: none.
        rolling_window: The costmap moves with the robot; else it has the size of the static map, if any.
        width: Size along x, metres.
        height: Size along y, metres.
        resolution: Edge of a cell, metres.
        origin_x: Outer corner of cell (0, 0), metres.
        origin_y: The same along y.
        always_send_full_costmap: Publish no updates of areas, only whole costmaps.
        footprint: Corners ``[[x, y], ...]``; empty: a disc of ``robot_radius``.
        robot_radius: Metres.
        footprint_padding: Metres by which the footprint is made larger.
        track_unknown_space: Cells of which nothing is known are unknown; else they are free.
    """

    global_frame: str = "map"
    robot_base_frame: str = "base_link"
    transform_tolerance: float = 0.3
    update_frequency: float = 5.0
    publish_frequency: float = 0.0
    rolling_window: bool = False
    width: float = 10.0
    height: float = 10.0
    resolution: float = 0.05
    origin_x: float = 0.0
    origin_y: float = 0.0
    always_send_full_costmap: bool = False
    footprint: str | tuple[tuple[float, float], ...] = ()
    robot_radius: float = 0.46
    footprint_padding: float = 0.01
    track_unknown_space: bool = False

    def __post_init__(self) -> None:
        for name in ("update_frequency", "width", "height", "resolution", "transform_tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, found {getattr(self, name)}")
        cells = self.width / self.resolution * (self.height / self.resolution)
        if cells > MAX_CELLS:
            raise ValueError(
                f"width, height, resolution: expected at most {MAX_CELLS} cells, found {cells:.0f}"
            )
        Footprint.read(self.footprint, self.robot_radius, self.footprint_padding)


@dataclass(frozen=True)
class CostmapParameters(CostmapGridParameters):
    """A costmap with its layers.

    Attributes:
        static_layer: The map; None: not used.
        obstacle_layer: What sensors see; None: not used.
        inflation_layer: Costs around obstacles; None: not used.
        sources: Sensors of the obstacle layer by name.
    """

    static_layer: StaticLayerParameters | None = None
    obstacle_layer: ObstacleLayerParameters | None = None
    inflation_layer: InflationParameters | None = None
    sources: dict[str, ObservationSource] = field(default_factory=dict)
