"""The client configs of a fleet that is wired as in the paper, in the long form.

A. Singhal et al., "Managing a Fleet of Autonomous Mobile Robots (AMR) using Cloud Robotics Platform" (2017):
one container ``cTag_01`` has the move clients of all robots. The planner is a fourth agent: a program on a
machine of its own, with its own ROS graph and its own connection ``planner``. The connections:

* robot - container: the pose, and goals and states of its ``move_base``;
* robot - planner: the pose;
* planner - container: each robot's list of cells and its cancellations.

Two more are ours: the map of cells, and the move clients' reports. Without reports the planner drives a robot
by its pose only, with more distance to others.

This module made ``robot1.config`` to ``robot3.config`` and ``planner.config`` in ``configs/paper``.
"""

from __future__ import annotations

from typing import Any

from rce_fleet.wiring import FleetAccount

CONTAINER = "cTag_01"
PLANNER = "planner"
ROBOTS = 3

_POSE = "geometry_msgs/PoseWithCovarianceStamped"
_CELLS = "std_msgs/Int32MultiArray"
_GOAL_ID = "actionlib_msgs/GoalID"
_STATUS = "actionlib_msgs/GoalStatusArray"
_MOVE_BASE = "move_base_msgs/MoveBaseAction"
_GRID = "nav_msgs/OccupancyGrid"


class _Wiring:
    """Interfaces and connections of one agent.

    Args:
        agent: Its robotID.
    """

    def __init__(self, agent: str) -> None:
        self.agent = agent
        self.interfaces: list[dict[str, Any]] = []
        self.connections: list[dict[str, str]] = []

    def up(self, sender: str, receiver: str, kind: str, addr: str, container_addr: str) -> None:
        """Connect a topic of the agent with the container, which gets its messages."""
        self.end(self.agent, sender, "SubscriberForwarder", kind, addr)
        self.end(CONTAINER, receiver, "PublisherInterface", kind, container_addr)
        self.connect(f"{self.agent}/{sender}", f"{CONTAINER}/{receiver}")

    def down(self, sender: str, receiver: str, kind: str, addr: str, container_addr: str) -> None:
        """Connect a topic of the container with the agent, which gets its messages."""
        self.end(CONTAINER, sender, "SubscriberInterface", kind, container_addr)
        self.end(self.agent, receiver, "PublisherForwarder", kind, addr)
        self.connect(f"{CONTAINER}/{sender}", f"{self.agent}/{receiver}")

    def end(self, endpoint: str, tag: str, interface_type: str, kind: str, addr: str) -> None:
        """Add an interface."""
        self.interfaces.append(
            {"eTag": endpoint, "iTag": tag, "iType": interface_type, "iCls": kind, "addr": addr}
        )

    def connect(self, a: str, b: str) -> None:
        """Add a connection."""
        self.connections.append({"tagA": a, "tagB": b})


def paper_robot_config(number: int, account: FleetAccount | None = None) -> dict[str, Any]:
    """Return the config of robot ``number``, counted from 1; its container is the planner's.

    Args:
        number: Names robot (``testRobot_1``), its interfaces and its namespace (``Robot1``).
        account: Engine and user; None for those of a development engine.
    """
    account = account or FleetAccount()
    robot, namespace = f"{account.robot_prefix}{number}", f"/Robot{number}"
    wiring = _Wiring(robot)
    sender, receiver = f"amclPoseSender_{number}", f"amclPoseReceiver_{number}"
    wiring.up(sender, receiver, _POSE, "/amcl_pose", f"{namespace}/amcl_pose")
    wiring.connect(f"{robot}/{sender}", f"{PLANNER}/{receiver}")
    for topic, kind in (("goal", f"{_MOVE_BASE}Goal"), ("cancel", _GOAL_ID)):
        wiring.down(*_tags(topic, number), kind, f"/move_base/{topic}", f"{namespace}/move_base/{topic}")
    for topic, kind in (
        ("status", _STATUS),
        ("result", f"{_MOVE_BASE}Result"),
        ("feedback", f"{_MOVE_BASE}Feedback"),
    ):
        wiring.up(*_tags(topic, number), kind, f"/move_base/{topic}", f"{namespace}/move_base/{topic}")
    topics = ("goalNodesList", "cancelGoal", "amcl_pose", "move_base")
    node = {
        "cTag": CONTAINER,
        "nTag": f"moveClient_{number}",
        "pkg": "move_client",
        "exe": "move_client_pthread",
        "args": " ".join(f"{namespace}/{topic}" for topic in topics),
    }
    return {**_account(account, robot), "nodes": [node], **_parts(wiring)}


def paper_planner_config(robots: int = ROBOTS, account: FleetAccount | None = None) -> dict[str, Any]:
    """Return the config of the planner, which owns the container.

    Args:
        robots: How many robots there are.
        account: Engine and user; None for those of a development engine.
    """
    account = account or FleetAccount()
    wiring = _Wiring(PLANNER)
    wiring.up("mapSender", "mapReceiver", _GRID, "/fleet/map", "/fleet/map")
    for number in range(1, robots + 1):
        for name, kind in (("goalNodesList", _CELLS), ("cancelGoal", "std_msgs/Bool")):
            addr = f"/Robot{number}/{name}"
            wiring.up(*_tags(name, number), kind, addr, addr)
        addr = f"/Robot{number}/moveClient/status"
        wiring.down(*_tags("moveClientStatus", number), "fleet/MoveStatus", addr, addr)
        # The robot's own file connects it.
        wiring.end(
            PLANNER, f"amclPoseReceiver_{number}", "PublisherForwarder", _POSE, f"/Robot{number}/amcl_pose"
        )
    return {**_account(account, PLANNER), "containers": [{"cTag": CONTAINER}], **_parts(wiring)}


def _tags(name: str, number: int) -> tuple[str, str]:
    return f"{name}Sender_{number}", f"{name}Receiver_{number}"


def _account(account: FleetAccount, robot: str) -> dict[str, Any]:
    return {"url": account.url, "userID": account.user, "password": account.password, "robotID": robot}


def _parts(wiring: _Wiring) -> dict[str, Any]:
    return {"interfaces": wiring.interfaces, "connections": wiring.connections}
