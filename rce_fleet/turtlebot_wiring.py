"""The client configs of a fleet of TurtleBots, wired twice from the same launch file.

``configs/turtlebot/botmotion.launch`` names a robot's nodes and their parameters. They run on the robot, with
the planner in the cloud (:func:`onboard_config`); or in the robot's container, so that only sensors and the
safety stage stay on the robot (:func:`offloaded_config`): scans and odometry go up, velocities come down.

This module made ``robot1.config``, ``robot1-offload.config`` and those of robots 2 and 3 in
``configs/turtlebot``.
"""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

from rce.config import configs_dir
from rce.ros.launch import LaunchPlan, MachineInputs, NodePlan, load_launch_files
from rce.ros.packages import PackageIndex
from rce_fleet.station.commands.kinds import command_interfaces
from rce_fleet.wiring import (
    FLEET_CONTAINER,
    FleetAccount,
    layer_interfaces,
    robot_config,
    speed_limit_bridge,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

LAUNCH_FILE = "turtlebot/botmotion.launch"
_MAP = "/map.yaml"
"""Stands for the map's file while the launch file is read."""
_MAP_IN_CONTAINER = "$(find turtlebot)/../map.yaml"

UP = (
    ("/scan", "sensor_msgs/LaserScan"),
    ("/odom", "nav_msgs/Odometry"),
    ("/tf", "tf2_msgs/TFMessage"),
    ("/tf_static", "tf2_msgs/TFMessage"),
    ("/initialpose", "geometry_msgs/PoseWithCovarianceStamped"),
    ("/move_base_simple/goal", "geometry_msgs/PoseStamped"),
)
"""What an off-loaded robot sends to its container."""
DOWN = (("/raw_cmd_vel", "geometry_msgs/Twist"),)
"""What it gets: velocities, for the safety stage before the wheels."""
LAST_POSE_TIMEOUT = 30.0
"""Seconds that a new container waits for the robot to say where it is."""
_CELLS = "std_msgs/Int32MultiArray"
_STATE = ("/fleet/state", "fleet/FleetState")
_GRID = ("/fleet/map", "nav_msgs/OccupancyGrid")


def onboard_config(number: int, account: FleetAccount | None = None) -> dict[str, Any]:
    """Return the config of robot ``number`` that runs all nodes of its launch file itself.

    Args:
        number: Names robot, container and namespace, as for :func:`rce_fleet.wiring.robot_config`.
        account: Engine and user; None for those of a development engine.
    """
    config = robot_config(number, account)
    planner, namespace = FLEET_CONTAINER, f"Robot{number}"
    config["bridges"] += [
        _topic("/freedCells", _CELLS, "robot", f"{planner}:/{namespace}/freedCells"),
        *(_topic(name, kind, planner, "robot") for name, kind in (_GRID, _STATE)),
    ]
    return config


def offloaded_config(
    number: int,
    account: FleetAccount | None = None,
    *,
    initial_pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    launch_arguments: Mapping[str, object] | None = None,
    own_map: bool = False,
) -> dict[str, Any]:
    """Return the config of robot ``number`` whose container runs all its nodes but the safety stage.

    The robot itself runs ``botmotion.launch offload:=true``, with ``own_map:=true`` if it brings its map.

    Args:
        number: Names robot, container and namespace, as for :func:`rce_fleet.wiring.robot_config`.
        account: Engine and user; None for those of a development engine.
        initial_pose: Where the robot starts, (x, y, yaw) in metres and radians.
        launch_arguments: More arguments of the launch file, such as ``initial_cov_xx``.
        own_map: The robot publishes the map; else the container has that of ``configs/map.yaml``.

    Raises:
        LaunchFileError: The shipped launch file cannot be read.
    """
    config = robot_config(number, account)
    container, namespace = config["containers"][0]["cTag"], f"Robot{number}"
    x, y, yaw = initial_pose
    pose = {"initial_pose_x": f"{x}", "initial_pose_y": f"{y}", "initial_pose_a": f"{yaw}"}
    given = {name: str(value) for name, value in (launch_arguments or {}).items()}
    # The planner hears the pose from the container itself.
    left_out = {"relay", "map_server"} if own_map else {"relay"}
    nodes, config["parameters"] = moved_nodes(
        container, {"robot": namespace, **pose, **given}, left_out=left_out
    )
    more = {"last_pose_timeout": LAST_POSE_TIMEOUT, **({"use_map_topic": True} if own_map else {})}
    config["parameters"] += [
        {"cTag": container, "name": f"/amcl/{name}", "value": value} for name, value in more.items()
    ]
    client = config["nodes"][0]
    client["args"] = " ".join(
        f"move_base/{topic}:=/move_base/{topic}"
        for topic in ("goal", "cancel", "status", "result", "feedback")
    )
    # What the container's nodes say does not show that the robot is there; its odometry does.
    client["args"] += " _alive_topic:=/odom"
    config["nodes"] = [*nodes, client]
    robot = config["robotID"]
    config["interfaces"] = [
        *layer_interfaces(robot, namespace, container, own_map=own_map),
        *command_interfaces(robot, namespace),
    ]
    config["bridges"] = list(_offload_bridges(container, namespace))
    if own_map:
        config["bridges"].append(_topic("/map", "nav_msgs/OccupancyGrid", "robot", container))
    return config


def moved_nodes(
    container: str, arguments: Mapping[str, str], *, file: str = LAUNCH_FILE, left_out: Collection[str] = ()
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the nodes and parameters of a container, for what a launch file does not start if off-loaded.

    Args:
        container: Tag of the container.
        arguments: Of the launch file.
        file: The launch file, in the folder of the shipped configs; its arguments include ``map`` and
            ``offload``.
        left_out: Types of nodes that stay where they are.

    Raises:
        LaunchFileError: The launch file cannot be read.
    """
    everything = _launch_plan(file, {"map": _MAP, **arguments})
    stays = {node.name for node in _launch_plan(file, {"offload": "true"}).nodes}
    moved = [node for node in everything.nodes if node.name not in stays and node.type not in left_out]
    names = tuple(f"{node.name}/" for node in moved)
    parameters = [
        {"cTag": container, "name": name, "value": value}
        for name, value in everything.parameters.items()
        if name.startswith(names)
    ]
    return [_node(container, node) for node in moved], parameters


def _launch_plan(file: str, arguments: dict[str, str]) -> LaunchPlan:
    folder = configs_dir()
    inputs = MachineInputs(PackageIndex([folder]), {})
    return load_launch_files([folder / file], arguments, inputs=inputs)


def _node(container: str, node: NodePlan) -> dict[str, Any]:
    """Return a node of the launch file as a node of a container."""
    name = node.name.removeprefix("/")
    remappings = (f"{source}:={target}" for source, target in node.remappings)
    args = shlex.join([*node.arguments, *remappings]).replace(_MAP, _MAP_IN_CONTAINER)
    made = {"cTag": container, "nTag": name, "pkg": node.package, "exe": node.type, "name": name}
    if args:
        made["args"] = args
    if node.respawn:
        made["restart"] = "always"
    return made


def _offload_bridges(container: str, namespace: str) -> Iterator[dict[str, Any]]:
    planner = FLEET_CONTAINER
    for name, kind in UP:
        yield _topic(name, kind, "robot", container)
    for name, kind in DOWN:
        yield _topic(name, kind, container, "robot")
    pose = "geometry_msgs/PoseWithCovarianceStamped"
    # The robot keeps its pose for the next `amcl`, if this container is made again.
    yield _topic("/amcl_pose", pose, container, [f"{planner}:/{namespace}/amcl_pose", "robot"])
    yield {"service": "/last_pose", "type": "fleet/GetLastPose", "server": "robot", "clients": container}
    battery = f"{planner}:/{namespace}/battery_state"
    yield _topic("/battery_state", "sensor_msgs/BatteryState", "robot", battery)
    for name, kind in (("blockedCells", _CELLS), ("freedCells", _CELLS)):
        yield _topic(f"/{name}", kind, container, f"{planner}:/{namespace}/{name}")
    yield _topic(f"/{namespace}/moveClient/status", "fleet/MoveStatus", container, planner)
    yield _topic(f"/{namespace}/goalNodesList", _CELLS, planner, container)
    yield _topic(f"/{namespace}/cancelGoal", "std_msgs/Bool", planner, container)
    yield speed_limit_bridge(container, namespace)
    for name, kind in (_GRID, _STATE):
        yield _topic(name, kind, planner, container)


def _topic(name: str, kind: str, source: str, target: str | list[str]) -> dict[str, Any]:
    return {"topic": name, "type": kind, "from": source, "to": target}
