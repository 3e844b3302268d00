"""The client configs of a fleet: one for each robot, and one for the operator, with the planner.

Robot N has its own container ``cTag_0N``, in which a move client sends it from cell to cell. The planner runs
in the operator's container ``cTag_fleet``, where the robots' topics are in namespaces. Robot N's config makes
three groups of connections:

* robot - own container: poses to the container; goals and states of its ``move_base``;
* robot - planner: poses, and cells that the robot found blocked;
* own container - planner: granted cells, cancellations and the map; back, the move client's reports.

The robot also offers the topics of the page's layers, which the station connects while a page shows them.

This module made ``fleet.config`` and ``robot1.config`` to ``robot3.config`` in ``configs``.
``robot1-long.config`` is the same as ``robot1.config`` without bridges, with the paper's names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rce_fleet.station.layers.kinds import SCAN, TF, TF_STATIC, TOPICS

if TYPE_CHECKING:
    from collections.abc import Iterator

FLEET_CONTAINER = "cTag_fleet"
OPERATOR = "fleetOperator"
FLOOR_PARAMETERS: dict[str, bool | int | float | str | list[Any]] = {
    "rows": 8,
    "columns": 8,
    "cell_size": 1.0,
    "walls": [9, 20, 21, 23, 37, 41, 42, 45, 50],
}
"""The planner's parameters for the floor of ``configs/scene.yaml``."""

_POSE = "geometry_msgs/PoseWithCovarianceStamped"
_CELLS = "std_msgs/Int32MultiArray"
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
        "interfaces": list(layer_interfaces(robot, namespace)),
        "bridges": list(_bridges(container, namespace)),
    }


def fleet_config(
    account: FleetAccount | None = None,
    parameters: dict[str, bool | int | float | str | list[Any]] | None = None,
) -> dict[str, Any]:
    """Return the operator's config: the container with the planner.

    Args:
        account: Engine and user; None for those of a development engine.
        parameters: The planner's parameters by name, such as ``rows``; those of the floor of
            ``configs/scene.yaml`` if None.
    """
    account = account or FleetAccount()
    given = FLOOR_PARAMETERS if parameters is None else parameters
    return {
        "url": account.url,
        "userID": account.user,
        "password": account.password,
        "robotID": OPERATOR,
        "containers": [{"cTag": FLEET_CONTAINER}],
        "parameters": [
            {"cTag": FLEET_CONTAINER, "name": f"/fleet/{name}", "value": value}
            for name, value in given.items()
        ],
        "nodes": [
            {"cTag": FLEET_CONTAINER, "nTag": "fleetPlanner", "pkg": "fleet", "exe": "fleet_planner.py"}
        ],
    }


def layer_interfaces(robot: str, namespace: str, container: str = "") -> Iterator[dict[str, Any]]:
    """Offer the topics of layers to the station, which connects them while a page shows them.

    Args:
        robot: The robot's ID in the engine.
        namespace: The robot's ID in the fleet.
        container: Container that localization and navigation run in; empty: they run on the robot.
    """
    for topic in TOPICS:
        ends = {robot: "SubscriberForwarder"}
        if container and topic not in _OF_BASE:
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


def _topic(name: str, type_: str, source: str, to: str | list[str]) -> dict[str, Any]:
    return {"topic": name, "type": type_, "from": source, "to": to}
