"""Judges how well robots localize, and how often they need a recovery behavior.

The only program of a demo that reads the true poses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from functools import partial
from math import hypot, sqrt
from typing import TYPE_CHECKING

from rce.ros.node import Message, Node
from rce.ros.tf import TransformError, TransformListener

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from rce_fleet.demo.robots import RobotGraph

NODE = "rce_demo_judge"
WAIT = 3
"""True poses that wait for the estimate of their time."""
DRIVEN = 600
"""True poses that are kept for estimates that come late."""
SAME_TIME = 0.1
"""Estimated and true pose of times that differ by less are compared, seconds."""
MAP = "map"
RECOVERIES = "recoveries"
"""Key in the diagnosis of ``move_base``."""


@dataclass(slots=True)
class RobotScore:
    """What is known of one robot.

    Attributes:
        samples: Number of poses that were compared.
        max_error: Greatest distance between estimated and true position, metres.
        recoveries: How often a recovery behavior was started.
    """

    samples: int = 0
    max_error: float = 0.0
    recoveries: int = 0
    _squares: float = 0.0
    _reported: int = 0

    @property
    def rmse(self) -> float | None:
        """Root mean square of the distances, metres; None before the first."""
        return sqrt(self._squares / self.samples) if self.samples else None

    def compare(self, error: float) -> None:
        """Add a distance between estimated and true position, metres."""
        self.samples += 1
        self._squares += error * error
        self.max_error = max(self.max_error, error)

    def count_recoveries(self, reported: int) -> None:
        """Take the number that ``move_base`` reports; it begins at 0 again if the node is restarted."""
        self.recoveries += reported - self._reported if reported >= self._reported else reported
        self._reported = reported


@dataclass(slots=True)
class _Watched:
    """A robot that is judged, with the true poses that wait."""

    graph: RobotGraph
    score: RobotScore
    waiting: deque[Message] = field(default_factory=deque)
    driven: deque[Message] = field(default_factory=lambda: deque(maxlen=DRIVEN))


class Judge:
    """Compares the robots' estimated poses with the true ones. An async context manager.

    The estimate is what a robot's nodes use: the transform from ``map`` to its base, ten times a second.
    That of an off-loaded robot is in its container, from where poses come after each update.

    Args:
        graphs: The robots.

    Attributes:
        scores: What was found so far, by robot.
    """

    def __init__(self, graphs: Iterable[RobotGraph]) -> None:
        self._robots = [_Watched(graph, RobotScore()) for graph in graphs]
        self.scores = {robot.graph.robot: robot.score for robot in self._robots}
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            for uri in sorted({robot.graph.uri for robot in self._robots}):
                node = Node(NODE, argv=(), master_uri=uri, signals=False, rosout=False)
                await stack.enter_async_context(node)
                transforms = await stack.enter_async_context(TransformListener(node, prefix=""))
                await self._watch(node, transforms)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def _watch(self, node: Node, transforms: TransformListener) -> None:
        """Subscribe to the topics of the robots at a node's master."""
        for robot in self._robots:
            if robot.graph.uri != node.master_uri:
                continue
            truth = robot.graph.topic("ground_truth/pose")
            if robot.graph.offloaded:
                await node.subscribe(truth, "nav_msgs/Odometry", robot.driven.append)
                poses, kind = robot.graph.topic("amcl_pose"), "geometry_msgs/PoseWithCovarianceStamped"
                await node.subscribe(poses, kind, partial(self._compare_pose, robot))
            else:
                await node.subscribe(truth, "nav_msgs/Odometry", partial(self._compare, robot, transforms))
            diagnose = partial(self._diagnose, robot)
            await node.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray", diagnose)

    def _compare(self, robot: _Watched, transforms: TransformListener, message: Message) -> None:
        robot.waiting.append(message)
        while robot.waiting:
            truth = robot.waiting[0]
            try:
                found = transforms.lookup(MAP, robot.graph.frame("base_link"), truth.header.stamp)
            except TransformError:
                if len(robot.waiting) < WAIT:
                    return
            else:
                at, place = found.transform.translation, truth.pose.pose.position
                robot.score.compare(hypot(at.x - place.x, at.y - place.y))
            robot.waiting.popleft()

    def _compare_pose(self, robot: _Watched, message: Message) -> None:
        """Compare a pose of a localization that runs in the robot's container with the truth of its time."""
        stamp = message.header.stamp.to_sec()
        late = {abs(truth.header.stamp.to_sec() - stamp): truth for truth in robot.driven}
        if late and min(late) <= SAME_TIME:
            at, place = message.pose.pose.position, late[min(late)].pose.pose.position
            robot.score.compare(hypot(at.x - place.x, at.y - place.y))

    def _diagnose(self, robot: _Watched, message: Message) -> None:
        for status in message.status:
            if status.name.partition(":")[0] != robot.graph.topic("move_base"):
                continue
            for value in status.values:
                if value.key == RECOVERIES:
                    robot.score.count_recoveries(int(value.value))
