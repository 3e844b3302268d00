"""The parameters of the node ``fleet_planner``; ``share/README.md`` describes them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.exceptions import LanesError, PlannerError
from rce_fleet.nodes.grid_choice import CHOSEN
from rce_fleet.nodes.grid_parameters import GRID_PARAMETERS, read_count, read_number
from rce_fleet.planning.lane_files import parse_lanes, read_lane_text, read_lanes
from rce_fleet.planning.motion import Motion
from rce_fleet.planning.planner import planner_names

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.lanes import LaneGraph

KNOWN = GRID_PARAMETERS | frozenset(
    {
        *("blocked", "lanes", CHOSEN, "robot_radius", "seed", "pose_only_after", "lost_spread", "lost_yaw"),
        *("planner", "resolve_deadlocks", "quarter_turn", "stop", "answers", "known_robots", "plan_timeout"),
        *("improve_seconds", "learn_congestion", "obstacle_reach", "sensed_lifetime"),
    }
)
"""Names of all parameters."""
_MARKS_OF_TEXT = "\n{"
"""A text of lanes has one of them, and the path of a file hardly."""
IMPROVE_SECONDS = 0.05
"""How long better paths are looked for. Nothing is granted meanwhile: less than a tick's time."""


def read_settings(values: Mapping[str, Any]) -> FleetSettings:
    """Return the planner's settings.

    Raises:
        ValueError: A value is of another type, or out of range; the text names its parameter.
        PlannerError: There is no such planner.
    """
    default = FleetSettings()
    settings = FleetSettings(
        robot_radius=read_number(values, "robot_radius", default.robot_radius),
        seed=read_count(values, "seed", 0),
        pose_only_after=read_number(values, "pose_only_after", default.pose_only_after),
        lost_spread=read_number(values, "lost_spread", default.lost_spread),
        lost_yaw=read_number(values, "lost_yaw", default.lost_yaw),
        obstacle_reach=read_number(values, "obstacle_reach", default.obstacle_reach),
        sensed_lifetime=read_number(values, "sensed_lifetime", default.sensed_lifetime),
        plan_timeout=read_number(values, "plan_timeout", default.plan_timeout),
        planner=str(values.get("planner", default.planner)),
        resolve_deadlocks=bool(values.get("resolve_deadlocks", False)),
        quarter_turn=read_number(values, "quarter_turn", 0.0),
        stop=read_number(values, "stop", 0.0),
        learn_congestion=bool(values.get("learn_congestion", default.learn_congestion)),
        improve_seconds=read_number(values, "improve_seconds", IMPROVE_SECONDS),
    )
    above_zero = ("robot_radius", "pose_only_after", "lost_spread", "lost_yaw", "obstacle_reach")
    for name in (*above_zero, "plan_timeout"):
        if getattr(settings, name) <= 0:
            raise ValueError(f"the parameter {name} must be above 0, not {getattr(settings, name):g}")
    for name in ("improve_seconds", "sensed_lifetime"):
        if getattr(settings, name) < 0:
            raise ValueError(f"the parameter {name} must be 0 or more, not {getattr(settings, name):g}")
    Motion(settings.quarter_turn, settings.stop)  # an impossible value has its reason
    if settings.planner not in planner_names():
        known = ", ".join(planner_names())
        raise PlannerError(f"the parameter planner is {settings.planner!r}; installed planners are {known}")
    return settings


def read_lane_graph(
    values: Mapping[str, Any], grid: GridMap, robot_radius: float
) -> tuple[LaneGraph | None, list[str]]:
    """Return the lanes of the parameter ``lanes``, and a remark about each that is too narrow for the robots.

    Its value is the path of a file, or what is in such a file: its text, or a mapping, as ``rosparam load``
    makes one of it. So a container needs no file.

    Args:
        values: The parameters.
        grid: The grid that the lanes lie on.
        robot_radius: Metres.

    Returns:
        The lanes that robots fit on; None: the parameter is not set.

    Raises:
        LanesError: The file cannot be read, its lanes cannot be driven on the grid, or all are too narrow.
    """
    given = values.get("lanes", "")
    if given == "":
        return None, []
    source = "the parameter lanes"
    if not isinstance(given, str):
        found = parse_lanes(given, grid, source)
    elif any(mark in given for mark in _MARKS_OF_TEXT):
        found = read_lane_text(given, grid, source)
    else:
        source = given
        found = read_lanes(Path(given), grid)
    lanes, narrow = found.fitting(2 * robot_radius)
    remarks = [
        f"{source}: lane {lane.name!r} is {lane.width:g} m wide, and robots with a radius of"
        f" {robot_radius:g} m need {2 * robot_radius:g} m: it is not used"
        for lane in narrow
    ]
    if not lanes.lanes:
        raise LanesError(f"{remarks[0]}; no lane is left")
    return lanes, remarks
