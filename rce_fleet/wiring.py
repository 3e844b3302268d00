"""The configs of a fleet: one for each robot, one for the operator who has the planner.

Robot N has a container ``cTag_0N`` of its own, in which a move client sends it from cell to cell. The
planner lives in the operator's container ``cTag_fleet``, whose ROS graph knows the robots by their
namespaces. So there are three kinds of wires, all of which robot N's config makes:

* robot - own container: poses up; the goals and states of its ``move_base`` down and up;
* robot - planner: poses and cells that turn out to be blocked;
* own container - planner: cells to drive on, cancellations, the map; the move client's reports back.

``configs/robot1.config`` to ``robot3.config`` and ``fleet.config`` are what this module makes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

FLEET_CONTAINER = "cTag_fleet"
OPERATOR = "fleetOperator"

_POSE = "geometry_msgs/PoseWithCovarianceStamped"
_CELLS = "std_msgs/Int32MultiArray"


@dataclass(frozen=True, slots=True)
class Wire:
    """A topic that is carried from one place to another.

    The names of the two interfaces tell sender and receiver, as in the paper: ``amclPoseSender_1``,
    ``amclPoseReceiver_1``.
    """

    name: str
    cls: str
    source: str
    """Topic where the messages come from."""
    target: str
    """Topic where they go to."""


@dataclass(frozen=True, slots=True)
class Account:
    """Where the engine is, and whose robots these are."""

    url: str = "http://localhost:9000/"
    user: str = "testUser"
    password: str = "testUser"  # noqa: S105 - the development user that `--dev` makes
    robot_prefix: str = "testRobot_"


def robot_config(number: int, account: Account | None = None) -> dict[str, Any]:
    """Return the config of robot ``number``, counted from 1.

    Args:
        number: Names robot (``testRobot_1``), container (``cTag_01``) and namespace (``Robot1``).
        account: Engine and user; the development ones if None.
    """
    account = account or Account()
    robot, container, namespace = f"{account.robot_prefix}{number}", f"cTag_{number:02}", f"Robot{number}"
    sketch = _Sketch(number)
    pose = Wire("amclPose", _POSE, "/amcl_pose", f"/{namespace}/amcl_pose")
    sketch.join(pose, robot, container)
    sketch.join(pose, robot, FLEET_CONTAINER)
    sketch.join(
        Wire("blockedCells", _CELLS, "/blockedCells", f"/{namespace}/blockedCells"), robot, FLEET_CONTAINER
    )
    for wire in _down_to_move_base(namespace):
        sketch.join(wire, container, robot)
    for wire in _up_from_move_base(namespace):
        sketch.join(wire, robot, container)
    for wire in _from_planner(namespace):
        sketch.join(wire, FLEET_CONTAINER, container)
    status = f"/{namespace}/moveClient/status"
    sketch.join(Wire("moveClientStatus", "fleet/MoveStatus", status, status), container, FLEET_CONTAINER)
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
        "interfaces": sketch.interfaces,
        "connections": sketch.connections,
    }


def fleet_config(
    account: Account | None = None, parameters: dict[str, bool | int | float | str | list[Any]] | None = None
) -> dict[str, Any]:
    """Return the operator's config: the container with the planner.

    Args:
        account: Engine and user; the development ones if None.
        parameters: The planner's parameters by name, such as ``rows``; those of an 8 x 8 floor if None.
    """
    account = account or Account()
    given = {"rows": 8, "columns": 8, "cell_size": 1.0} if parameters is None else parameters
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
        "interfaces": [],
        "connections": [],
    }


def as_text(config: dict[str, Any]) -> str:
    """Write a config as the shipped files are: JSON, one line for each item of a list."""
    lines = []
    for key, value in config.items():
        if isinstance(value, list) and value:
            items = ",\n".join(f"        {json.dumps(item)}" for item in value)
            lines.append(f'    "{key}": [\n{items}\n    ]')
        else:
            lines.append(f'    "{key}": {json.dumps(value)}')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _down_to_move_base(namespace: str) -> Iterator[Wire]:
    yield Wire("goal", "move_base_msgs/MoveBaseActionGoal", f"/{namespace}/move_base/goal", "/move_base/goal")
    yield Wire("cancel", "actionlib_msgs/GoalID", f"/{namespace}/move_base/cancel", "/move_base/cancel")


def _up_from_move_base(namespace: str) -> Iterator[Wire]:
    for name, cls in (
        ("status", "actionlib_msgs/GoalStatusArray"),
        ("result", "move_base_msgs/MoveBaseActionResult"),
        ("feedback", "move_base_msgs/MoveBaseActionFeedback"),
    ):
        yield Wire(name, cls, f"/move_base/{name}", f"/{namespace}/move_base/{name}")


def _from_planner(namespace: str) -> Iterator[Wire]:
    for name, cls in (("goalNodesList", _CELLS), ("cancelGoal", "std_msgs/Bool")):
        yield Wire(name, cls, f"/{namespace}/{name}", f"/{namespace}/{name}")
    yield Wire("map", "nav_msgs/OccupancyGrid", "/map", "/map")


class _Sketch:
    """Interfaces and connections of one robot's config, each interface made once."""

    def __init__(self, number: int) -> None:
        self._number = number
        self.interfaces: list[dict[str, str]] = []
        self.connections: list[dict[str, str]] = []

    def join(self, wire: Wire, source: str, target: str) -> None:
        """Carry a topic from one endpoint to another."""
        sender = self._interface(
            source, f"{wire.name}Sender_{self._number}", "Subscriber", wire.cls, wire.source
        )
        receiver = self._interface(
            target, f"{wire.name}Receiver_{self._number}", "Publisher", wire.cls, wire.target
        )
        self.connections.append({"tagA": sender, "tagB": receiver})

    def _interface(self, endpoint: str, tag: str, role: str, cls: str, addr: str) -> str:
        form = "Interface" if endpoint.startswith("cTag_") else "Forwarder"
        made = {"eTag": endpoint, "iTag": tag, "iType": f"{role}{form}", "iCls": cls, "addr": addr}
        if made not in self.interfaces:
            self.interfaces.append(made)
        return f"{endpoint}/{tag}"
