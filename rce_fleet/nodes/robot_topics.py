"""The topics of the planner's robots: what each robot and its move client publish and receive."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Any

from rce.aio.tasks import run_in_groups
from rce.ros.closing import release_all
from rce_fleet.coordination.answers import is_answer, numbered_array, read_answer
from rce_fleet.coordination.events import Event, ObstacleGone, ObstacleSeen, PoseSeen, ReportSeen, RobotHeard
from rce_fleet.nodes.grid_messages import grid_name
from rce_fleet.nodes.registering import ROBOTS_AT_ONCE, register_together
from rce_fleet.nodes.robot_messages import read_pose_seen, read_report, read_sign
from rce_fleet.nodes.throttled_log import ThrottledLog

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Iterator

    from rce.ros.node import Node, Publisher, Subscriber
    from rce.ros.types import Message
    from rce_fleet.coordination.events import SendCells
    from rce_fleet.coordination.move_client import ClientReport
    from rce_fleet.coordination.robot_signs import RobotSign
    from rce_fleet.nodes.pose_publisher import PosePublisher

POSE = "geometry_msgs/PoseWithCovarianceStamped"
OLD_CELLS_LAST = 3.0
"""Seconds after a change of the grid in which robots may report cells of the one before."""


class RobotTopics:
    """Connects robots with the planner.

    Args:
        node: Running node.
        take: Passes an event to the planner.
        poses: Publishes the poses of all robots.
        takes_answers: Move clients answer on ``goalNodesList`` instead of their own topics.
        hear_planner: Called with a robot and the planner whose grid or list its move client took last; empty:
            not told.

    Attributes:
        client_grids: The grid that each robot's move client has; empty: it has one from its parameters.
    """

    def __init__(
        self,
        node: Node,
        take: Callable[[Event], object],
        poses: PosePublisher,
        *,
        takes_answers: bool,
        hear_planner: Callable[[str, str], object],
    ) -> None:
        self._node = node
        self._take = take
        self._poses = poses
        self._takes_answers = takes_answers
        self._hear_planner = hear_planner
        self._cells: dict[str, Publisher] = {}
        self._cancels: dict[str, Publisher] = {}
        self._joined: set[str] = set()
        self._obstacles_from = 0.0
        self._throttled_log = ThrottledLog(node)
        self.client_grids: dict[str, str] = {}

    def __contains__(self, robot: str) -> bool:
        """Return whether a robot is connected."""
        return robot in self._joined

    def send_cells(self, instruction: SendCells, grid: str) -> None:
        """Send a robot its cells, which belong to a grid of this name; it is the planner's name too.

        A robot that an earlier planner knew may not be connected yet: its list is sent again.
        """
        publisher = self._cells.get(instruction.robot)
        if publisher is not None:
            # Move clients that answer have their grid from parameters: to them its name says nothing.
            named, planner = ("", grid) if self._takes_answers else (grid, "")
            cells, revision, speed = instruction.cells, instruction.revision, instruction.speed
            publisher.publish(numbered_array(cells, revision, named, speed, planner))

    def send_cancel(self, robot: str) -> None:
        """Stop a robot."""
        publisher = self._cancels.get(robot)
        if publisher is not None:
            publisher.publish(data=True)

    def fall_silent(self) -> None:
        """Send robots nothing from now on."""
        self._cells.clear()
        self._cancels.clear()

    def ignore_old_cells(self) -> None:
        """Take no cells from robots for a while, because they may be of the grid before."""
        self._obstacles_from = time.monotonic() + OLD_CELLS_LAST

    async def join(self, robots: Iterable[str]) -> None:
        """Connect robots, many at the same time: each topic has to be registered at the master.

        Raises:
            MasterError: The master did not take a topic of at least one of them. Such a robot is not
                connected at all, and can be joined again, as those whose turn had not come.
        """
        await run_in_groups([partial(self._join, robot) for robot in robots], ROBOTS_AT_ONCE)

    async def _join(self, robot: str) -> None:
        """Connect a robot, or nothing of it."""
        node = self._node
        cells, cancels, seen = publishers = await register_together(
            node.advertise(f"/{robot}/goalNodesList", "std_msgs/Int32MultiArray"),
            node.advertise(f"/{robot}/cancelGoal", "std_msgs/Bool"),
            # Clients of the planner's container do not receive what its other interfaces publish.
            node.advertise(f"/fleet/poses/{robot}", POSE, latch=True),
        )
        self._cells[robot], self._cancels[robot] = cells, cancels  # a message may come before all is joined
        try:
            await register_together(*self._subscriptions(robot, seen))
        except Exception:
            del self._cells[robot], self._cancels[robot]
            await release_all(publishers)
            raise
        self._joined.add(robot)
        node.log.info("found robot %s", robot)

    def _subscriptions(self, robot: str, seen: Publisher) -> Iterator[Coroutine[Any, Any, Subscriber]]:
        """Subscribe to the topics of a robot and its move client."""
        node = self._node

        def take(message: Message) -> None:
            pose = read_pose_seen(robot, message)
            if not pose.is_possible:
                text = f"expected finite numbers (metres, radians), found {pose.x}, {pose.y}, {pose.yaw}"
                self._throttled_log.warn(robot, f"poses of {robot} are ignored: {text}")
                return
            self._take(pose)
            self._poses.take(robot, message)
            seen.publish(message)

        yield node.subscribe(f"/{robot}/amcl_pose", POSE, take)
        if self._takes_answers:
            yield node.subscribe(
                f"/{robot}/goalNodesList",
                "std_msgs/Int32MultiArray",
                lambda message: self._take_answer(robot, message),
            )
            return
        yield node.subscribe(
            f"/{robot}/moveClient/status",
            "fleet/MoveStatus",
            lambda message: self._take_status(robot, message),
        )
        yield node.subscribe(
            f"/{robot}/blockedCells",
            "std_msgs/Int32MultiArray",
            lambda message: self._take_obstacle(ObstacleSeen(robot, tuple(message.data))),
        )
        yield node.subscribe(
            f"/{robot}/freedCells",
            "std_msgs/Int32MultiArray",
            lambda message: self._take_obstacle(ObstacleGone(robot, tuple(message.data))),
        )

    def _take_answer(self, robot: str, message: Message) -> None:
        """Handle a move client's answer; the planner's own lists arrive here too."""
        dimensions = message.layout.dim
        labels = [dimension.label for dimension in dimensions]
        if not is_answer(labels):
            return
        try:
            answer = read_answer(labels, [dimension.size for dimension in dimensions], message.data)
        except ValueError as error:
            self._warn_of_report(robot, error)
            return
        self._hear_planner(robot, answer.planner)
        self._take_report(robot, answer.report, answer.sign)
        if answer.blocked:
            self._take(ObstacleSeen(robot, answer.blocked))
        if answer.freed:
            self._take(ObstacleGone(robot, answer.freed))

    def _take_status(self, robot: str, message: Message) -> None:
        try:
            report = read_report(message)
        except ValueError as error:
            self._warn_of_report(robot, error)
            return
        self.client_grids[robot] = grid_name(message.grid)
        self._hear_planner(robot, self.client_grids[robot])
        self._take_report(robot, report, read_sign(message))

    def _warn_of_report(self, robot: str, error: ValueError) -> None:
        self._throttled_log.warn(robot, f"a report of the move client of {robot} is ignored: {error}")

    def _take_obstacle(self, event: ObstacleSeen | ObstacleGone) -> None:
        """Handle cells that a robot reports, unless they may be of the grid before."""
        if time.monotonic() >= self._obstacles_from:
            self._take(event)

    def _take_report(self, robot: str, report: ClientReport, sign: RobotSign) -> None:
        """Handle a move client's report; what it heard of the robot comes first, because it is older."""
        if sign.pose is not None:
            self._take(PoseSeen(robot, *sign.pose))
        if sign.age is not None:
            self._take(RobotHeard(robot, sign.age))
        self._take(ReportSeen(robot, report))
