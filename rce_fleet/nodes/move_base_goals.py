"""The goals of ``move_base``: its action, the simple topic, and its services."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np

from rce.ros.actions import ServerGoal, SimpleActionServer
from rce.ros.tf import TransformError, TransformListener
from rce_fleet.geometry.poses import Pose
from rce_fleet.navigation.move_base.core import Decision, Ending
from rce_fleet.nodes.planar import path_fields, pose_fields, pose_of, read_pose
from rce_fleet.nodes.robot_place import full_name, named_in_message

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher
    from rce.ros.types import Message
    from rce_fleet.navigation.move_base.stack import NavigationSettings, NavigationStack
    from rce_fleet.nodes.throttled_log import ThrottledLog

ACTION = "move_base"
TYPE = "move_base_msgs/MoveBaseAction"
TRANSFORM_TIMEOUT = 1.0
"""How long a goal in another frame waits for a transform, seconds."""


class GoalDriver(Protocol):
    """Drives the robot to the goal."""

    @property
    def stack(self) -> NavigationStack:
        """Costmaps, planners and decisions."""

    @property
    def settings(self) -> NavigationSettings:
        """All parameters."""

    def global_pose(self) -> Pose | None:
        """Return the robot's pose in the global frame; None if it is not known."""

    def start(self) -> None:
        """Begin to drive."""

    def stop(self) -> None:
        """Drop the goal and stop the robot at once."""


class MoveBaseGoals:
    """Takes goals and hands them to the driver, one at a time. An async context manager.

    Args:
        node: Running node.
        driver: Drives the robot.
        transforms: What is known of frames.
        throttled_log: Where warnings go.

    Attributes:
        target: The present goal in the global frame; None without one.
    """

    def __init__(
        self, node: Node, driver: GoalDriver, transforms: TransformListener, throttled_log: ThrottledLog
    ) -> None:
        self._node = node
        self._driver = driver
        self._transforms = transforms
        self._throttled_log = throttled_log
        self.target: Pose | None = None
        self._goal: ServerGoal | None = None
        self._ended: asyncio.Future[Decision] | None = None
        self._stack = AsyncExitStack()
        self._server = SimpleActionServer(node, ACTION, TYPE, self._drive)
        self._current: Publisher
        self._forward: Publisher

    async def __aenter__(self) -> Self:
        node = self._node
        planner = self._driver.settings.move_base.base_global_planner.replace("::", "/").rpartition("/")[2]
        async with AsyncExitStack() as stack:
            self._current = await node.advertise("~current_goal", "geometry_msgs/PoseStamped", latch=True)
            self._forward = await node.advertise(f"{ACTION}/goal", "move_base_msgs/MoveBaseActionGoal")
            await stack.enter_async_context(self._server)
            await node.subscribe("move_base_simple/goal", "geometry_msgs/PoseStamped", self._take_simple)
            for name in ("~make_plan", f"~{planner}/make_plan"):
                await node.advertise_service(name, "nav_msgs/GetPlan", self._make_plan)
            await node.advertise_service("~clear_costmaps", "std_srvs/Empty", self._clear)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    def tell(self, at: Pose | None, decision: Decision) -> None:
        """Publish feedback after a control step, and end the goal if it has ended.

        Args:
            at: The robot's pose in the global frame; None, without feedback, if it is not known.
            decision: What was decided.
        """
        goal, ended = self._goal, self._ended
        if goal is None or ended is None:
            return
        if at is not None:
            header = {"stamp": self._node.now(), "frame_id": self._frame}
            goal.publish_feedback(base_position={"header": header, "pose": pose_fields(at)})
        if decision.ending is not None and not ended.done():
            ended.set_result(decision)

    # The action

    async def _drive(self, goal: ServerGoal) -> dict[str, Any] | None:
        stamped = goal.request.target_pose
        try:
            target = await self._in_global_frame(stamped)
        except (ValueError, TransformError) as error:
            self._driver.stop()
            self._node.log.error("a goal is refused: %s", error)  # noqa: TRY400 - the reason says it all
            goal.abort(f"the goal is refused: {error}")
            return None
        header = {"stamp": self._node.now(), "frame_id": self._frame}
        self._current.publish(header=header, pose=pose_fields(target))
        self._goal, self.target = goal, target
        self._ended = asyncio.get_running_loop().create_future()
        self._driver.start()
        cancelled = asyncio.create_task(goal.wait_for_cancel())
        try:
            await asyncio.wait((cancelled, self._ended), return_when=asyncio.FIRST_COMPLETED)
            if not self._ended.done():
                others = [one for one in self._server.goals if one is not goal]
                if not others:  # A newer goal takes over without a stop.
                    self._driver.stop()
                return None
            decision = self._ended.result()
        finally:
            cancelled.cancel()
            self._goal = self.target = self._ended = None
        if decision.ending is Ending.SUCCEEDED:
            goal.succeed({}, decision.text)
        else:
            self._node.log.error("the goal is given up: %s", decision.text)
            goal.abort(decision.text)
        return None

    async def _in_global_frame(self, stamped: Message) -> Pose:
        """Return a ``geometry_msgs/PoseStamped`` in the global frame.

        Raises:
            ValueError: It is not a pose in the plane, or has no frame.
            TransformError: No transform leads from its frame.
        """
        pose, frame = read_pose(stamped.pose), stamped.header.frame_id
        if not frame:
            raise ValueError(f"its frame_id is empty; expected {self._frame} or another frame of tf")
        if frame.lstrip("/") in (self._driver.settings.global_costmap.global_frame.lstrip("/"), self._frame):
            return pose
        # As in ROS's move_base the latest transform counts, whatever the stamp says.
        found = await self._transforms.wait_for(
            f"/{self._frame}", named_in_message(frame), timeout=TRANSFORM_TIMEOUT
        )
        return pose_of(found.transform).compose(pose)

    def _take_simple(self, message: Message) -> None:
        now = self._node.now()
        self._forward.publish(header={"stamp": now}, goal_id={"stamp": now}, goal={"target_pose": message})

    # Services

    async def _make_plan(self, request: Message) -> dict[str, Any]:
        driver, header = self._driver, {"stamp": self._node.now(), "frame_id": self._frame}
        nothing = {"plan": path_fields(np.empty((0, 3)), header)}
        try:
            goal = await self._in_global_frame(request.goal)
            if request.start.header.frame_id:
                start: Pose | None = await self._in_global_frame(request.start)
            else:
                start = driver.global_pose()
        except (ValueError, TransformError) as error:
            self._node.log.error("make_plan: %s", error)  # noqa: TRY400 - the reason says it all
            return nothing
        if start is None or not driver.stack.global_costmap.is_ready:
            self._node.log.error("make_plan: the robot's pose or the map is not known yet")
            return nothing
        stack = driver.stack
        settings = driver.settings
        tolerance = max(float(request.tolerance), settings.global_planner.default_tolerance)
        plan = await asyncio.to_thread(stack.plan, stack.snapshot(), start, goal, tolerance=tolerance)
        if not plan.found:
            self._node.log.warning("make_plan: %s", plan.reason)
            return nothing
        path = plan.path
        if settings.move_base.make_plan_add_unreachable_goal and not np.allclose(
            path[-1, :2], (goal.x, goal.y)
        ):
            path = np.concatenate((path, goal.as_array()[None]))
        return {"plan": path_fields(path, header)}

    def _clear(self, _request: Message) -> dict[str, Any]:
        self._driver.stack.clear_costmaps()
        self._node.log.info("the costmaps were cleared")
        return {}

    @property
    def _frame(self) -> str:
        """Full name of the global frame."""
        return full_name(self._transforms, self._driver.settings.global_costmap.global_frame)[1:]
