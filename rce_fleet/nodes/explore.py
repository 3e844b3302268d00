"""``explore_lite/explore``: lets a robot explore an unknown floor. Runs beside ``move_base``.

It subscribes to a map with unknown cells, and sends ``move_base`` to the frontiers of what is known.
Parameters and topics are those of ROS 1's package explore_lite (http://wiki.ros.org/explore_lite); the work
is done by :mod:`rce_fleet.navigation.exploration`.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field, replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce.ros.actions import ActionClient, ClientGoal, GoalState
from rce.ros.node import Message, Node, NodeClosedError, Publisher, run
from rce.ros.tf import TransformError, TransformListener
from rce_fleet.compiled import compile_kernels
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.exploration.explorer import Action, Explorer, ExplorerParameters
from rce_fleet.navigation.exploration.frontiers import FrontierSearch, find_frontiers
from rce_fleet.nodes.diagnostics import Diagnostics, Level
from rce_fleet.nodes.explore_markers import FrontierMarkers
from rce_fleet.nodes.move_base_goals import ACTION, TYPE
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import pose_fields, pose_of, read_map
from rce_fleet.nodes.robot_place import full_name, named_in_message
from rce_fleet.nodes.throttled_log import ThrottledLog

if TYPE_CHECKING:
    from rce_fleet.maps.occupancy_map import OccupancyMap

UNUSED = ("orientation_scale",)
"""Without effect in explore_lite too."""
STARTED = "exploration_started"
IN_PROGRESS = "exploration_in_progress"
PAUSED = "exploration_paused"
COMPLETE = "exploration_complete"
RETURNING = "returning_to_origin"
RETURNED = "returned_to_origin"
"""Texts of ``explore/status``: those of explore_lite's ``ExploreStatus`` in ROS 2."""


@dataclass(frozen=True, slots=True)
class ExploreParameters(ExplorerParameters):
    """Private parameters of the node: those of the exploration, and these.

    Attributes:
        robot_base_frame: Frame of the robot's base.
        costmap_topic: Topic of the map: that of a mapper, or a costmap of ``move_base``.
        costmap_updates_topic: Topic of updates of its parts.
        visualize: Whether ``~frontiers`` is published.
        planner_frequency: How often the next goal is considered, Hz.
        transform_tolerance: Oldest pose of the robot that counts, seconds.
        return_to_init: Whether the robot drives back to where it started.
    """

    robot_base_frame: str = "base_link"
    costmap_topic: str = "costmap"
    costmap_updates_topic: str = "costmap_updates"
    visualize: bool = False
    planner_frequency: float = field(default=1.0, metadata={"above": 0})
    transform_tolerance: float = field(default=0.3, metadata={"minimum": 0})
    return_to_init: bool = False


class ExploreNode:
    """Explores in a ROS graph.

    Args:
        node: Running node.
        parameters: Its parameters.

    Attributes:
        status: The text that was published last on ``explore/status``.
        explorer: Decides where to drive.
    """

    def __init__(self, node: Node, parameters: ExploreParameters) -> None:
        self._node = node
        self._parameters = parameters
        self.explorer = Explorer(parameters)
        self.status = ""
        self._throttled_log = ThrottledLog(node)
        self._map: OccupancyMap | None = None
        self._frame = ""
        self._map_at = -inf
        self._search = FrontierSearch()
        self._goal: ClientGoal | None = None
        self._home: Pose | None = None
        self._problem = ""
        self._wake = asyncio.Event()
        self._tf: TransformListener
        self._client: ActionClient
        self._statuses: Publisher
        self._markers: FrontierMarkers | None = None

    async def run(self) -> None:
        """Explore until the node is stopped."""
        node, parameters = self._node, self._parameters
        await asyncio.to_thread(compile_kernels)
        self._statuses = await node.advertise("explore/status", "std_msgs/String", latch=True)
        if parameters.visualize:
            self._markers = await FrontierMarkers.start(node)
        diagnostics = await Diagnostics.start(node, "exploration")
        async with AsyncExitStack() as stack:
            self._tf = await stack.enter_async_context(TransformListener(node, prefix=""))
            self._client = await stack.enter_async_context(ActionClient(node, ACTION, TYPE))
            await node.subscribe(parameters.costmap_topic, "nav_msgs/OccupancyGrid", self._take_map)
            await node.subscribe(
                parameters.costmap_updates_topic, "map_msgs/OccupancyGridUpdate", self._take_update
            )
            await node.subscribe("explore/resume", "std_msgs/Bool", self._resume)
            self._tell(STARTED)
            with suppress(NodeClosedError):  # told to stop while it waited for move_base
                while not node.is_shutdown:
                    await self._step()
                    diagnostics.publish(*self._state())
                    await self._pause(1 / parameters.planner_frequency)

    async def _pause(self, seconds: float) -> None:
        """Wait for the next decision; one is due at once when a goal ends or the exploration is resumed."""
        sleeping, waking = (
            asyncio.ensure_future(one) for one in (self._node.sleep(seconds), self._wake.wait())
        )
        try:
            await asyncio.wait((sleeping, waking), return_when=asyncio.FIRST_COMPLETED)
        finally:
            sleeping.cancel()
            waking.cancel()
        self._wake.clear()

    # What comes in

    def _take_map(self, message: Message) -> None:
        try:
            self._map = read_map(message)
        except (MapError, ValueError) as error:
            self._throttled_log.warn("map", f"a map is ignored: {error}")
            return
        self._frame, self._map_at = named_in_message(message.header.frame_id), self._node.time()

    def _take_update(self, message: Message) -> None:
        known = self._map
        if known is None:
            return
        rows, columns = (
            slice(start, start + size)
            for start, size in ((message.y, message.height), (message.x, message.width))
        )
        if message.x < 0 or message.y < 0 or rows.stop > known.rows or columns.stop > known.columns:
            self._throttled_log.warn("update", "an update of the map is ignored: it lies outside of the map")
            return
        data = known.data.copy()
        try:
            data[rows, columns] = np.asarray(message.data, np.int8).reshape(message.height, message.width)
        except ValueError as error:
            self._throttled_log.warn("update", f"an update of the map is ignored: {error}")
            return
        self._map, self._map_at = replace(known, data=data), self._node.time()

    def _resume(self, message: Message) -> None:
        if message.data:
            if self.status in (PAUSED, COMPLETE, RETURNED):
                self._node.log.info("exploration is resumed")
                self._tell(STARTED)
            self._wake.set()
        elif self.status != PAUSED:
            self._stop_robot()
            self._tell(PAUSED)

    # Decisions

    async def _step(self) -> None:
        """Look at the map, and send the robot somewhere if need be."""
        if self.status not in (STARTED, IN_PROGRESS):
            return
        known, robot = self._map, self._robot()
        if known is None or robot is None:
            return
        if self._home is None:
            self._home = robot
        map_at = self._map_at
        self._search = await asyncio.to_thread(find_frontiers, known, robot, self._parameters)
        self._problem = self._search.reason
        if self._problem:
            self._throttled_log.warn("search", self._problem)
        if self.status not in (STARTED, IN_PROGRESS):
            return  # paused meanwhile
        action = self.explorer.update(self._search, map_at, self._node.time())
        if self._markers is not None:
            self._markers.publish(self._search, self.explorer, self._frame)
        target = self.explorer.target
        if action is Action.DRIVE and target is not None:
            self._tell(IN_PROGRESS)
            self._node.log.info(
                "goal %d: a frontier of %.1f m at (%.2f, %.2f), %.1f m away",
                self.explorer.goals, target.size, *target.middle, target.way,
            )  # fmt: skip
            await self._send(target.goal)
        elif action is Action.DONE:
            await self._finish()

    def _robot(self) -> Pose | None:
        """Return the robot's pose on the map; None if it is not known."""
        if self._map is None:
            self._problem = f"waiting for the map on {self._node.resolve(self._parameters.costmap_topic)}"
            return None
        try:
            found = self._tf.lookup(self._frame, full_name(self._tf, self._parameters.robot_base_frame))
        except TransformError as error:
            self._problem = f"waiting for the robot's pose: {error}"
            return None
        age = self._node.time() - found.stamp.to_sec()
        if found.stamp and age > self._parameters.transform_tolerance:
            limit = self._parameters.transform_tolerance
            self._problem = f"the robot's pose is {age:.2f} s old (transform_tolerance {limit:g} s)"
            return None
        return pose_of(found.transform)

    async def _finish(self) -> None:
        given_up = [reason for _, reason in self.explorer.over if reason != "was visited"]
        self._node.log.info(
            "the floor is explored: %d goals, %d of them given up, %d frontiers out of reach",
            self.explorer.goals, len(given_up), len(self._search.unreachable),
        )  # fmt: skip
        self._stop_robot()
        if self._parameters.return_to_init and self._home is not None:
            self._tell(RETURNING)
            await self._send(self._home)
        else:
            self._tell(COMPLETE)

    # Goals

    async def _send(self, goal: Pose) -> None:
        """Send a goal to ``move_base`` in place of the one before."""
        header = {"frame_id": self._frame.lstrip("/"), "stamp": self._node.now()}
        target = {"target_pose": {"header": header, "pose": pose_fields(goal)}}
        status, self._problem, self._goal = self.status, "", None
        sent = await self._client.send(target, on_change=self._goal_changed)
        if self.status == status:
            self._goal = sent
        else:
            sent.cancel()  # paused while the action server was waited for

    def _goal_changed(self, goal: ClientGoal) -> None:
        if goal is not self._goal or not goal.is_done:
            return
        now, status = self._node.time(), self.status
        self._wake.set()
        if status == RETURNING:
            if goal.state is not GoalState.SUCCEEDED:
                self._node.log.warning("the robot is not back at its start: %s", goal.text)
            self._tell(RETURNED if goal.state is GoalState.SUCCEEDED else COMPLETE)
        elif status == IN_PROGRESS:
            self._goal_ended(goal, now)

    def _goal_ended(self, goal: ClientGoal, now: float) -> None:
        """Note how the goal of a frontier ended."""
        if goal.state is GoalState.SUCCEEDED:
            self.explorer.reached(now)
        elif goal.state in (GoalState.ABORTED, GoalState.REJECTED):
            self._node.log.warning("a frontier is given up: %s", goal.text)
            self.explorer.failed(goal.text or goal.state.name.lower(), now)
        elif goal.state is GoalState.LOST:
            self._throttled_log.warn("lost", f"move_base does not answer: {goal.text}")
            self.explorer.forget()
        else:
            self._node.log.warning(
                "another program cancelled the goal: exploration pauses; publish true on %s to resume",
                self._node.resolve("explore/resume"),
            )
            self.explorer.forget()
            self._tell(PAUSED)

    def _stop_robot(self) -> None:
        goal, self._goal = self._goal, None
        if goal is not None:
            goal.cancel()
        self.explorer.forget()

    # State

    def _tell(self, status: str) -> None:
        if status != self.status:
            self.status = status
            self._statuses.publish(data=status)

    def _state(self) -> tuple[Level, str, dict[str, str]]:
        """Return level, text and values of the node's state."""
        waits = bool(self._problem) and self.status in (STARTED, IN_PROGRESS)
        values = {
            "status": self.status,
            "goals": str(self.explorer.goals),
            "frontiers": str(len(self._search.frontiers)),
            "given up or visited": str(len(self.explorer.over)),
            "out of reach": str(len(self._search.unreachable)),
        }
        return (Level.WARN if waits else Level.OK), self._problem if waits else self.status, values


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("explore") as node:
        await ExploreNode(node, await read_parameters(node, ExploreParameters, unused=UNUSED)).run()


if __name__ == "__main__":
    run(main())
