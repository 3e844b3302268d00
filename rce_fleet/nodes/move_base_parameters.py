"""Reads the parameters of ``move_base``, which are spread over many namespaces. Pure.

Costmaps are read as costmap_2d reads them: with ``plugins`` each layer has a namespace of its own; without,
all parameters stand in the costmap's namespace, as before ROS hydro.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, TypeVar

from rce_fleet.navigation.costmap.parameters import (
    CostmapGridParameters,
    CostmapParameters,
    InflationParameters,
    ObservationSource,
    ObstacleLayerParameters,
    StaticLayerParameters,
)
from rce_fleet.navigation.move_base.parameters import MoveBaseParameters
from rce_fleet.navigation.move_base.stack import RECOVERY_TYPES, NavigationSettings, RecoverySpec
from rce_fleet.navigation.planners.global_planner import GlobalPlannerParameters
from rce_fleet.navigation.planners.local_parameters import LocalPlannerParameters
from rce_fleet.nodes.parameter_values import Problem, read_values

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

UNUSED = ("shutdown_costmaps", "make_plan_clear_costmap", "clearing_radius")
_READ_APART = ("plugins", "static_map", "recovery_behaviors")
"""Parameters that no dataclass declares."""


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


_UNUSED_BY_COSTMAPS = _names(
    "map_type origin_z z_resolution z_voxels unknown_threshold mark_threshold publish_voxel_map"
)
_UNUSED_BY_PLANNERS = _names(
    "acc_lim_y acc_lim_trans max_vel_y min_vel_y max_vel_trans min_vel_trans vx_samples vy_samples"
    " vth_samples vtheta_samples path_distance_bias goal_distance_bias occdist_scale"
    " forward_point_distance scaling_speed max_scaling_factor oscillation_reset_dist"
    " oscillation_reset_angle prune_plan angular_sim_granularity publish_traj_pc publish_cost_grid_pc"
    " publish_cost_grid global_frame_id holonomic_robot escape_vel dwa meter_scoring pdist_scale"
    " gdist_scale heading_lookahead heading_scoring heading_scoring_timestep use_dwa simple_attractor"
    " controller_frequency escape_reset_dist escape_reset_theta y_vels twirling_scale"
)
"""Parameters of ROS's local planners that this one does not need."""
_UNUSED_BY_NAVFN = _names(
    "planner_window_x planner_window_y visualize_potential use_dijkstra use_quadratic use_grid_path"
    " lethal_cost old_navfn_behavior neutral_cost cost_factor publish_potential orientation_mode"
    " orientation_window_size outline_map"
)
_OTHER_NAMES = {
    "max_rotational_vel": "max_vel_theta",
    "max_rot_vel": "max_vel_theta",
    "min_rot_vel": "min_vel_theta",
    "min_in_place_vel_theta": "min_vel_theta",
    "min_in_place_rotational_vel": "min_vel_theta",
    "acc_lim_th": "acc_lim_theta",
    "rot_stopped_vel": "theta_stopped_vel",
}
"""Names that older releases of ROS's local planners use, and those of today."""
_SOURCE_DEFAULTS = ("obstacle_range", "raytrace_range", "max_obstacle_height")
"""Parameters of a source that may stand in its layer's namespace."""


@dataclass(frozen=True, slots=True)
class LayerNames:
    """The names of a costmap's layers; None: the costmap has no such layer."""

    static: str | None
    obstacle: str | None
    inflation: str | None


def read_settings(values: Mapping[str, Any], prefix: str = "~") -> tuple[NavigationSettings, list[Problem]]:
    """Return all parameters of ``move_base`` and what was wrong with them.

    Args:
        values: The parameters in the node's private namespace, as a tree.
        prefix: Put before the names in the problems' texts.
    """
    reader = _SettingsReader(prefix)
    move_base = reader.read(MoveBaseParameters, values, "", UNUSED)
    global_planner = values.get(space_of(move_base.base_global_planner), {})
    local_planner = values.get(space_of(move_base.base_local_planner), {})
    settings = NavigationSettings(
        move_base,
        reader.read_costmap(values, "global_costmap"),
        reader.read_costmap(values, "local_costmap"),
        reader.read(
            GlobalPlannerParameters,
            global_planner,
            space_of(move_base.base_global_planner) + "/",
            _UNUSED_BY_NAVFN,
        ),
        reader.read(
            LocalPlannerParameters,
            _renamed(local_planner),
            space_of(move_base.base_local_planner) + "/",
            _UNUSED_BY_PLANNERS,
        ),
        reader.read_recoveries(values),
    )
    return settings, reader.problems


def space_of(planner: str) -> str:
    """Return the namespace of a planner's parameters and topics, such as ``NavfnROS``."""
    return planner.replace("::", "/").rpartition("/")[2] or planner


def _renamed(values: Any) -> Any:
    if not isinstance(values, Mapping):
        return values
    renamed = {new: values[old] for old, new in _OTHER_NAMES.items() if old in values}
    return {**renamed, **{name: value for name, value in values.items() if name not in _OTHER_NAMES}}


class _SettingsReader:
    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self.problems: list[Problem] = []

    def read(self, kind: type[T], values: Any, space: str, unused: Sequence[str] = ()) -> T:
        if not isinstance(values, Mapping):
            text = f"parameter {self._prefix}{space} must be a namespace; the defaults are used"
            self.problems.append(Problem(text))
            values = {}
        values = {name: value for name, value in values.items() if name not in _READ_APART}
        made, problems = read_values(kind, values, prefix=self._prefix + space, unused=unused)
        self.problems += problems
        return made

    def read_costmap(self, values: Mapping[str, Any], space: str) -> CostmapParameters:
        found = values.get(space, {})
        if not isinstance(found, Mapping):
            self.problems.append(Problem(f"parameter {self._prefix}{space} must be a namespace"))
            found = {}
        names = self._layers(found, space)
        if "plugins" in found:
            static = self._layer(StaticLayerParameters, found, space, names.static)
            inflation = self._layer(InflationParameters, found, space, names.inflation)
            obstacle, sources = self._obstacle_layer(found, found.get(names.obstacle or "", {}), space, names)
            grid = self.read(CostmapGridParameters, found, f"{space}/", _UNUSED_BY_COSTMAPS)
        else:
            known = {one.name for one in fields(CostmapGridParameters)}
            layers = {name: value for name, value in found.items() if name not in known}
            static = self._old_layer(StaticLayerParameters, layers) if names.static else None
            inflation = self._old_layer(InflationParameters, {**layers, **_inner(found, "inflation_layer")})
            obstacle, sources = self._obstacle_layer(
                found, {**layers, **_inner(found, "obstacle_layer")}, space, names
            )
            old = {
                one.name
                for kind in (StaticLayerParameters, InflationParameters, ObstacleLayerParameters)
                for one in fields(kind)
            }
            own = {name: value for name, value in found.items() if name in known or name not in old}
            own = {name: value for name, value in own.items() if name not in _SOURCE_DEFAULTS}
            grid = self.read(CostmapGridParameters, own, f"{space}/", _UNUSED_BY_COSTMAPS)
        return CostmapParameters(
            **asdict(grid),
            static_layer=static,
            obstacle_layer=obstacle,
            inflation_layer=inflation,
            sources=sources,
        )

    def _layers(self, found: Mapping[str, Any], space: str) -> LayerNames:
        plugins = found.get("plugins")
        if plugins is None:
            rolling = bool(found.get("rolling_window", False))
            static = bool(found.get("static_map", not rolling))
            return LayerNames("static_layer" if static else None, "obstacle_layer", "inflation_layer")
        names: dict[str, str] = {}
        for plugin in plugins if isinstance(plugins, (list, tuple)) else ():
            kind = str(plugin.get("type", "")) if isinstance(plugin, Mapping) else ""
            for word in ("Static", "Obstacle", "Voxel", "Inflation"):
                if word in kind:
                    names["Obstacle" if word == "Voxel" else word] = str(plugin.get("name", ""))
                    break
            else:
                text = f"{self._prefix}{space}/plugins: {plugin} is ignored; known are StaticLayer, "
                self.problems.append(Problem(text + "ObstacleLayer, VoxelLayer and InflationLayer"))
        return LayerNames(names.get("Static"), names.get("Obstacle"), names.get("Inflation"))

    def _layer(self, kind: type[T], found: Mapping[str, Any], space: str, name: str | None) -> T | None:
        return None if name is None else self.read(kind, found.get(name, {}), f"{space}/{name}/")

    def _old_layer(self, kind: type[T], values: Mapping[str, Any]) -> T:
        """Read a layer from the costmap's own namespace, where other parts have parameters too."""
        names = {one.name for one in fields(kind)}
        return self.read(kind, {name: value for name, value in values.items() if name in names}, "")

    def _obstacle_layer(
        self, found: Mapping[str, Any], values: Any, space: str, names: LayerNames
    ) -> tuple[ObstacleLayerParameters | None, dict[str, ObservationSource]]:
        if names.obstacle is None:
            return None, {}
        layer = values if isinstance(values, Mapping) else {}
        parameters = self._old_layer(ObstacleLayerParameters, layer)
        common = {name: layer.get(name, found.get(name)) for name in _SOURCE_DEFAULTS}
        common = {name: value for name, value in common.items() if value is not None}
        sources = {}
        for name in parameters.observation_sources.split():
            own = layer.get(name, {})
            where = f"{space}/{names.obstacle}/{name}/"
            if not isinstance(own, Mapping) or not own:
                self.problems.append(Problem(f"{self._prefix}{where}: the source has no parameters"))
                own = {}
            sources[name] = self.read(ObservationSource, {**common, **own}, where)
        return parameters, sources

    def read_recoveries(self, values: Mapping[str, Any]) -> tuple[RecoverySpec, ...] | None:
        listed = values.get("recovery_behaviors")
        if listed is None:
            return None
        specs = []
        for one in listed if isinstance(listed, (list, tuple)) else ():
            name = str(one.get("name", "")) if isinstance(one, Mapping) else ""
            kind = str(one.get("type", "")) if isinstance(one, Mapping) else ""
            if not name or kind not in RECOVERY_TYPES:
                known = ", ".join(RECOVERY_TYPES)
                text = (
                    f"{self._prefix}recovery_behaviors: {one} is ignored; expected a name and one of {known}"
                )
                self.problems.append(Problem(text))
                continue
            own = {key: value for key, value in _inner(values, name).items() if key in _RECOVERY_FIELDS}
            chosen = self.read(_RecoveryValues, own, f"{name}/")
            specs.append(RecoverySpec(name, kind, **asdict(chosen)))
        return tuple(specs)


@dataclass(frozen=True, slots=True)
class _RecoveryValues:
    reset_distance: float = 3.0
    distance: float = 0.3
    seconds: float = 5.0


_RECOVERY_FIELDS = frozenset(one.name for one in fields(_RecoveryValues))


def _inner(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = values.get(name, {})
    return found if isinstance(found, Mapping) else {}
