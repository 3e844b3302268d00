"""Nodes of the package ``fleet`` as processes, and a robot that stands and publishes one pose only."""

from __future__ import annotations

import asyncio
import os
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from rce.ros.packages import PackageIndex
from rce_fleet.geometry.angles import quaternion_z

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rce.ros.core import Core
    from rce.ros.node import Node, Publisher
    from rce.ros.types import Message

PACKAGES = PackageIndex.from_environ()
STATUS = "move_base/status"
SUCCEEDED = 3
TYPES = {STATUS: "actionlib_msgs/GoalStatusArray", "odom": "nav_msgs/Odometry"}


@asynccontextmanager
async def fleet_program(core: Core, exe: str, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a node of the package ``fleet``."""
    command = [*PACKAGES.find("fleet").executable(exe), *arguments]
    environ = {**os.environ, "ROS_MASTER_URI": core.uri}
    process = await asyncio.create_subprocess_exec(*command, env=environ)
    try:
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()


class RestingRobot:
    """A robot that stands: one latched pose, and messages at 5 Hz on some topics. Its goals succeed at once.

    Args:
        node: Running node in the robot's namespace.
        drives: Whether it is at a goal's place as soon as it has the goal, and says so.

    Attributes:
        newest: The planner's newest state.
        places: Where it was, ``(x, y)`` in metres, in order.
    """

    def __init__(self, node: Node, *, drives: bool = False) -> None:
        self._node = node
        self._drives = drives
        self._poses: Publisher
        self.places: list[tuple[float, float]] = []
        self._beating: dict[str, Publisher] = {}
        self._changed = asyncio.Event()
        self._reached: list[dict[str, Any]] = []
        self.newest: Message | None = None

    async def start(self, place: tuple[float, float]) -> None:
        """Publish the pose, and follow the planner's state."""
        pose_type = "geometry_msgs/PoseWithCovarianceStamped"
        self._poses = await self._node.advertise("amcl_pose", pose_type, latch=True)
        self._be_at(place)
        await self._node.subscribe("/fleet/state", "fleet/FleetState", self._take_state)
        await self._node.subscribe("move_base/goal", "move_base_msgs/MoveBaseActionGoal", self._take_goal)

    async def beat(self, topic: str) -> None:
        """Publish on a topic from now on."""
        self._beating[topic] = await self._node.advertise(topic, TYPES[topic])

    def rest(self, topic: str) -> None:
        """Publish no more on a topic."""
        del self._beating[topic]

    async def keep_beating(self) -> None:
        """Publish until the node is stopped."""
        while await self._node.sleep(0.2):
            for topic, publisher in self._beating.items():
                publisher.publish(**({"status_list": self._reached} if topic == STATUS else {}))

    async def until(self, state: str, cell: int | None = None, limit: float = 50.0) -> str:
        """Wait until the planner gives the robot this state, in this cell; return its reason."""
        async with asyncio.timeout(limit):
            while True:
                for robot in self.newest.robots if self.newest is not None else ():
                    if robot.state == state and cell in (None, robot.cell):
                        return str(robot.reason)
                self._changed.clear()
                await self._changed.wait()

    def _be_at(self, place: tuple[float, float]) -> None:
        self.places.append(place)
        z, w = quaternion_z(0.5)
        position = {"x": place[0], "y": place[1]}
        pose = {"position": position, "orientation": {"z": z, "w": w}}
        self._poses.publish(header={"frame_id": "map"}, pose={"pose": pose})

    def _take_goal(self, message: Message) -> None:
        if self._drives:
            position = message.goal.target_pose.pose.position
            self._be_at((position.x, position.y))
        goal_id = {"stamp": message.goal_id.stamp, "id": message.goal_id.id}
        self._reached.append({"goal_id": goal_id, "status": SUCCEEDED})

    def _take_state(self, message: Message) -> None:
        self.newest = message
        self._changed.set()
