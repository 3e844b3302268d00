"""The client configs of a fleet: one for each robot, and one for the operator, with the planner.

Robot N has its own container ``cTag_0N``, in which a move client sends it from cell to cell. The planner runs
in the operator's container ``cTag_fleet``, where the robots' topics are in namespaces. Robot N's config makes
three groups of connections:

* robot - own container: poses to the container; goals and states of its ``move_base``; limits of its speed;
* robot - planner: poses, cells that the robot found blocked, and its battery;
* own container - planner: granted cells, cancellations and the map; back, the move client's reports.

The robot also offers the topics of the page's layers, which the station connects while a page shows them, and
topics that the station publishes on without the planner: emergency stop, velocities by hand, initial pose.

This module made ``fleet.config`` and ``robot1.config`` to ``robot3.config`` in ``configs``.
``robot1-long.config`` is the same as ``robot1.config`` without bridges, with the paper's names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rce_fleet.station.commands.kinds import LIGHT_COMMANDS, command_interfaces
from rce_fleet.station.layers.kinds import MAP, SCAN, TF, TF_STATIC, TOPICS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

FLEET_CONTAINER = "cTag_fleet"
OPERATOR = "fleetOperator"
VOLUME = {"name": "fleet", "path": "/volumes/fleet", "size": "128M", "snapshots": 30}
"""The volume with the journal of the fleet manager, which finds it by its name. If its machine is lost, the
fleet continues on another one, without what happened since the last snapshot."""
ROBOTS_OF_SLOT = 250
"""So many robots need no more than the memory of one slot, 512 MB: 366 MB were used when 300 had joined."""
BASE_MEMORY, ROBOTS_OF_MB = 512, 2
"""MB for a larger fleet, and robots for each MB more. 1000 robots used 625 MB when all started at once
after the container had died."""
FLOOR_PARAMETERS: dict[str, bool | int | float | str | list[Any]] = {
    "rows": 8,
    "columns": 8,
    "cell_size": 1.0,
    "walls": [9, 20, 21, 23, 37, 41, 42, 45, 50],
    "quarter_turn": 0.9,
    "stop": 0.64,
}
"""The planner's parameters for the floor of ``configs/scene.yaml`` and its robots, which drive 0.8 m/s."""

_POSE = "geometry_msgs/PoseWithCovarianceStamped"
_BATTERY = "sensor_msgs/BatteryState"
_CELLS = "std_msgs/Int32MultiArray"
_SPEED = "std_msgs/Float64"
_OF_BASE = (SCAN, TF, TF_STATIC)
"""Topics of layers that come from the robot's sensors and wheels, wherever its other nodes run."""


@dataclass(frozen=True, slots=True)
class FleetAccount:
    """The engine's address, and the user account of the robots."""

    url: str = "http://localhost:9000/"
    user: str = "testUser"
    password: str = "testUser"  # noqa: S105 - the development user that `--dev` makes
    robot_prefix: str = "testRobot_"


def robot_config(number: int, account: FleetAccount | None = None) -> dict[str, Any]:
    """Return the config of robot ``number``, counted from 1.

    Args:
        number: Names robot (``testRobot_1``), container (``cTag_01``) and namespace (``Robot1``).
        account: Engine and user; None for those of a development engine.
    """
    account = account or FleetAccount()
    robot, container, namespace = f"{account.robot_prefix}{number}", f"cTag_{number:02}", f"Robot{number}"
    return {
        "url": account.url,
        "userID": account.user,
        "password": account.password,
        "robotID": robot,
        "containers": [{"cTag": container}],
        "nodes": [
            {
                "cTag": container,
                "nTag": f"moveClient_{number}",
                "pkg": "fleet",
                "exe": "move_client.py",
                "namespace": namespace,
            }
        ],
        "interfaces": [*layer_interfaces(robot, namespace), *command_interfaces(robot, namespace)],
        "bridges": list(_bridges(container, namespace)),
    }


def light_config(first: int, last: int, account: FleetAccount | None = None) -> dict[str, Any]:
    """Return the config of light robots ``first`` to ``last`` that share a container and a bridge.

    Their ROS graph has each robot's topics in its namespace. One process in the container,
    ``move_clients.py``, sends all of them from cell to cell. The station sends emergency stops, and
    velocities of robots that are driven by hand.

    Args:
        first: Number of the first robot, counted from 1.
        last: Number of the last one.
        account: Engine and user; None for those of a development engine.

    Raises:
        ValueError: There is no robot between the two.
    """
    if not 1 <= first <= last:
        raise ValueError(f"robots are numbered from 1 on, first to last, not {first} to {last}")
    account = account or FleetAccount()
    container, planner = f"cTag_{first}_{last}", FLEET_CONTAINER
    own = f"{account.robot_prefix}{first}_{last}"
    robots = [f"Robot{number}" for number in range(first, last + 1)]
    bridges = [_topic("/fleet/map", "nav_msgs/OccupancyGrid", planner, container)]
    for robot in robots:
        bridges += [
            _topic(f"/{robot}/amcl_pose", _POSE, "robot", planner),
            _topic(f"/{robot}/battery_state", _BATTERY, "robot", planner),
            _topic(f"/{robot}/goalNodesList", _CELLS, planner, container),
            _topic(f"/{robot}/cancelGoal", "std_msgs/Bool", planner, container),
            _topic(f"/{robot}/moveClient/status", "fleet/MoveStatus", container, planner),
            _topic(f"/{robot}/move_base/goal", "move_base_msgs/MoveBaseActionGoal", container, "robot"),
            _topic(f"/{robot}/move_base/cancel", "actionlib_msgs/GoalID", container, "robot"),
            _topic(f"/{robot}/move_base/status", "actionlib_msgs/GoalStatusArray", "robot", container),
            _topic(f"/{robot}/speed_limit", _SPEED, container, "robot"),
            _topic(f"/{robot}/move_base/result", "move_base_msgs/MoveBaseActionResult", "robot", container),
        ]
    return {
        "url": account.url,
        "userID": account.user,
        "password": account.password,
        "robotID": own,
        "containers": [{"cTag": container}],
        "parameters": [{"cTag": container, "name": "/move_clients/robots", "value": robots}],
        "nodes": [
            {
                "cTag": container,
                "nTag": "moveClients",
                "pkg": "fleet",
                "exe": "move_clients.py",
                "name": "move_clients",
            }
        ],
        "interfaces": [
            interface
            for robot in robots
            for interface in command_interfaces(own, robot, LIGHT_COMMANDS, prefix=f"/{robot}")
        ],
        "bridges": bridges,
    }


def fleet_config(
    account: FleetAccount | None = None,
    parameters: dict[str, bool | int | float | str | list[Any]] | None = None,
    manager: Mapping[str, bool | int | float | str | list[Any]] | None = None,
    *,
    robots: int = 0,
) -> dict[str, Any]:
    """Return the operator's config: the container with planner and fleet manager.

    Args:
        account: Engine and user; None for those of a development engine.
        parameters: The planner's parameters by name, such as ``rows``; those of the floor of
            ``configs/scene.yaml`` if None.
        manager: The manager's parameters by name, such as ``chargers``.
        robots: Size of the fleet; more than :data:`ROBOTS_OF_SLOT` robots need a larger container.
    """
    account = account or FleetAccount()
    given = FLOOR_PARAMETERS if parameters is None else parameters
    container: dict[str, Any] = {"cTag": FLEET_CONTAINER, "volumes": [VOLUME]}
    if robots > ROBOTS_OF_SLOT:
        container["memory"] = f"{BASE_MEMORY + robots // ROBOTS_OF_MB}M"
    return {
        "url": account.url,
        "userID": account.user,
        "password": account.password,
        "robotID": OPERATOR,
        "containers": [container],
        "parameters": [
            {"cTag": FLEET_CONTAINER, "name": f"/fleet/{name}", "value": value}
            for name, value in given.items()
        ]
        + [
            {"cTag": FLEET_CONTAINER, "name": f"/fleet_manager/{name}", "value": value}
            for name, value in (manager or {}).items()
        ],
        "nodes": [
            {"cTag": FLEET_CONTAINER, "nTag": tag, "pkg": "fleet", "exe": exe}
            for tag, exe in (("fleetPlanner", "fleet_planner.py"), ("fleetManager", "fleet_manager.py"))
        ],
    }


def layer_interfaces(
    robot: str, namespace: str, container: str = "", *, own_map: bool = False
) -> Iterator[dict[str, Any]]:
    """Offer the topics of layers to the station, which connects them while a page shows them.

    Args:
        robot: The robot's ID in the engine.
        namespace: The robot's ID in the fleet.
        container: Container that localization and navigation run in; empty: they run on the robot.
        own_map: The robot publishes the map. A container's interface does not receive what another of its
            interfaces publishes.
    """
    of_robot = (*_OF_BASE, MAP) if own_map else _OF_BASE
    for topic in TOPICS:
        ends = {robot: "SubscriberForwarder"}
        if container and topic not in of_robot:
            ends = {container: "SubscriberInterface"}
        elif container and topic is TF:
            ends[container] = "SubscriberInterface"
        for endpoint, interface_type in ends.items():
            yield {
                "eTag": endpoint,
                "iTag": topic.interface_tag(namespace),
                "iType": interface_type,
                "iCls": topic.type_name,
                "addr": f"/{topic.names[0]}",
            }


def _bridges(container: str, namespace: str) -> Iterator[dict[str, Any]]:
    planner = FLEET_CONTAINER
    pose, cells = f"/{namespace}/amcl_pose", f"/{namespace}/blockedCells"
    yield _topic("/amcl_pose", _POSE, "robot", [f"{container}:{pose}", f"{planner}:{pose}"])
    yield _topic("/blockedCells", _CELLS, "robot", f"{planner}:{cells}")
    yield _topic("/battery_state", _BATTERY, "robot", f"{planner}:/{namespace}/battery_state")
    yield {
        "action": "/move_base",
        "type": "move_base_msgs/MoveBase",
        "server": "robot",
        "clients": f"{container}:/{namespace}/move_base",
    }
    yield _topic(f"/{namespace}/goalNodesList", _CELLS, planner, container)
    yield _topic(f"/{namespace}/cancelGoal", "std_msgs/Bool", planner, container)
    yield _topic("/fleet/map", "nav_msgs/OccupancyGrid", planner, container)
    yield _topic(f"/{namespace}/moveClient/status", "fleet/MoveStatus", container, planner)
    yield speed_limit_bridge(container, namespace)


def speed_limit_bridge(container: str, namespace: str) -> dict[str, Any]:
    """Return the bridge that tells a robot the greatest speed in slow zones."""
    return _topic(f"/{namespace}/speed_limit", _SPEED, container, "robot:/speed_limit")


def _topic(name: str, type_: str, source: str, to: str | list[str]) -> dict[str, Any]:
    return {"topic": name, "type": type_, "from": source, "to": to}
