"""``move_base``: drives a robot to goals. Runs in the robot's namespace, on the robot or in a container.

The action ``move_base``, the topics and the parameters are those of ROS 1's node. The work is done by
:mod:`rce_fleet.navigation`; :mod:`rce_fleet.nodes.move_base_goals` takes the goals.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Mapping

import numpy as np

from rce.ros.node import Message, Node, Publisher, run
from rce.ros.tf import TransformListener
from rce_fleet.compiled import compile_kernels
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.costmap.layered import LayeredCostmap
from rce_fleet.navigation.move_base.core import Decision, State
from rce_fleet.navigation.move_base.situation import Situation
from rce_fleet.navigation.move_base.stack import NavigationSettings, NavigationStack
from rce_fleet.nodes.costmap_publisher import CostmapPublisher
from rce_fleet.nodes.diagnostics import Diagnostics, Level
from rce_fleet.nodes.move_base_goals import MoveBaseGoals
from rce_fleet.nodes.move_base_parameters import read_settings, space_of
from rce_fleet.nodes.observation_sources import ObservationSources
from rce_fleet.nodes.planar import fault_of_map_frame, path_fields, read_map, twist_fields
from rce_fleet.nodes.robot_place import RobotPlace, full_name
from rce_fleet.nodes.throttled_log import ThrottledLog

DIAGNOSTICS_EVERY = 1.0
"""Seconds between two messages on ``/diagnostics``."""
STANDING = Twist()


class MoveBaseNode:
    """``move_base`` in a ROS graph.

    Args:
        node: Running node.
        settings: All parameters.

    Attributes:
        stack: Costmaps, planners and decisions.
    """

    def __init__(self, node: Node, settings: NavigationSettings) -> None:
        self._node = node
        self._settings = settings
        self.stack = NavigationStack(settings)
        self._throttled_log = ThrottledLog(node)
        self._commanded = STANDING
        self._global_at = float("-inf")
        self._steps: deque[tuple[float, float]] = deque(maxlen=500)
        self._problem = ""
        self._map_fault = ""
        self._plan_seconds = 0.0
        self._frames: tuple[str, ...] = ()
        self._place: RobotPlace
        self._goals: MoveBaseGoals
        self._sources: list[ObservationSources]
        self._velocity: Publisher
        self._stamped_velocity: Publisher
        self._plans: Publisher
        self._global_plan: Publisher
        self._local_plan: Publisher

    async def run(self) -> None:
        """Drive until the node is stopped."""
        node, stack, parameters = self._node, self.stack, self._settings.move_base
        planner, controller = (
            space_of(one) for one in (parameters.base_global_planner, parameters.base_local_planner)
        )
        self._velocity = await node.advertise("cmd_vel", "geometry_msgs/Twist", queue_size=1)
        self._stamped_velocity = await node.advertise("~stamped_cmd_vel", "geometry_msgs/TwistStamped")
        self._plans = await node.advertise(f"~{planner}/plan", "nav_msgs/Path", latch=True)
        self._global_plan = await node.advertise(f"~{controller}/global_plan", "nav_msgs/Path")
        self._local_plan = await node.advertise(f"~{controller}/local_plan", "nav_msgs/Path")
        diagnostics = await Diagnostics.start(node, "navigation")
        publishers = [
            CostmapPublisher(node, name, costmap)
            for name, costmap in (
                ("global_costmap", stack.global_costmap),
                ("local_costmap", stack.local_costmap),
            )
        ]
        for publisher in publishers:
            await publisher.start()
        try:
            await self._drive(publishers, diagnostics)
        finally:  # Also after an error: wheels keep their last command.
            self._velocity.publish(twist_fields(STANDING))

    async def _drive(self, publishers: list[CostmapPublisher], diagnostics: Diagnostics) -> None:
        node, stack = self._node, self.stack
        async with TransformListener(node, prefix="") as transforms:
            costmaps = (stack.global_costmap, stack.local_costmap)
            world, local = (one.parameters for one in costmaps)
            self._frames = tuple(full_name(transforms, one.global_frame)[1:] for one in (world, local))
            self._place = RobotPlace(
                node,
                transforms,
                (world.global_frame, local.global_frame, local.robot_base_frame),
                max(world.transform_tolerance, local.transform_tolerance),
                self._throttled_log,
            )
            self._sources = [
                ObservationSources(node, transforms, one, self._throttled_log) for one in costmaps
            ]
            for costmap in costmaps:
                await self._hear_map(costmap)
            for source in self._sources:
                await source.start()
            await node.subscribe("odom", "nav_msgs/Odometry", self._place.take_odometry)
            self._goals = MoveBaseGoals(node, self, transforms, self._throttled_log)
            async with self._goals, asyncio.TaskGroup() as tasks:
                told = float("-inf")
                async for _ in node.rate(self._settings.move_base.controller_frequency):
                    self._step(tasks, publishers)
                    now = node.time()
                    if not 0 <= now - told < DIAGNOSTICS_EVERY:
                        told = now
                        self._report(diagnostics)

    # For the goals

    @property
    def settings(self) -> NavigationSettings:
        """All parameters."""
        return self._settings

    @property
    def commanded(self) -> Twist:
        """The last command."""
        return self._commanded

    def global_pose(self) -> Pose | None:
        """Return the robot's pose in the global frame; None if it is not known."""
        place = self._place.look()
        return None if place.problem else place.pose.relative_to(place.local_from_global)

    def start(self) -> None:
        """Begin to drive to the goal that the goals hold now."""
        self.stack.core.start(self._node.time())

    def stop(self) -> None:
        """Drop the goal and stop the robot at once."""
        self.stack.core.cancel()
        self._command(STANDING)

    # Maps

    async def _hear_map(self, costmap: LayeredCostmap) -> None:
        layer = costmap.static
        if layer is None:
            return
        topic = layer.parameters.map_topic

        def take(message: Message) -> None:
            if layer.has_map and layer.parameters.first_map_only:
                return
            name = self._node.resolve(topic)
            try:
                costmap.set_map(read_map(message))
            except ValueError as error:
                self._map_fault = f"a map on {name} is ignored: {error}"
                self._throttled_log.warn("map", self._map_fault)
                return
            self._map_fault = ""
            fault = fault_of_map_frame(message, self._frames[0])
            if fault:
                self._throttled_log.warn("map frame", f"the map on {name}: {fault}")

        def update(message: Message) -> None:
            try:
                values = np.asarray(message.data, np.int8).reshape(message.height, message.width)
                layer.update_map(values, message.y, message.x)
            except ValueError as error:
                self._throttled_log.warn("map", f"an update of a map is ignored: {error}")

        await self._node.subscribe(topic, "nav_msgs/OccupancyGrid", take)
        if layer.parameters.subscribe_to_updates:
            await self._node.subscribe(f"{topic}_updates", "map_msgs/OccupancyGridUpdate", update)

    # A control step

    def _step(self, tasks: asyncio.TaskGroup, publishers: list[CostmapPublisher]) -> None:
        began, worked = time.perf_counter(), time.thread_time()
        node, stack = self._node, self.stack
        for source in self._sources:
            source.flush()
        place = self._place.look()
        now = node.time()
        if place.jumped:
            node.log.warning("odometry jumped: the local costmap is cleared")
            stack.local_costmap.clear()
        at = place.pose.relative_to(place.local_from_global)
        if not place.problem:
            every = 1 / stack.global_costmap.parameters.update_frequency
            if stack.global_costmap.is_ready and not 0 <= now - self._global_at < every:
                self._global_at = now
                publishers[0].note(stack.update_global(at, now))
        problem = place.problem or self._problem_of_costmaps(now)
        situation = Situation(
            now=now,
            dt=1 / self._settings.move_base.controller_frequency,
            pose=place.pose,
            measured=self._place.speeds(self._commanded),
            local_from_global=place.local_from_global,
            problem=problem,
        )
        drives = stack.core.state is not State.IDLE
        decision = stack.control(situation)
        if drives or decision.ending is not None:
            self._command(decision.twist)
            self._goals.tell(None if place.problem else at, decision)
        self._note(problem, decision)
        if decision.wants_plan:
            tasks.create_task(self._plan(at))
        self._steps.append((time.perf_counter() - began, time.thread_time() - worked))
        if not place.problem:
            self._publish_local_plan(decision)
            publishers[0].publish(at, self._frames[0])
            publishers[1].note(stack.local_costmap.grid.whole)
            publishers[1].publish(place.pose, self._frames[1])

    def _command(self, twist: Twist) -> None:
        self._commanded = twist
        self._velocity.publish(twist_fields(twist))
        seen = self._sources[1].newest
        if seen is not None and self._stamped_velocity.connections:
            header = {"stamp": seen, "frame_id": self._settings.local_costmap.robot_base_frame}
            self._stamped_velocity.publish(header=header, twist=twist_fields(twist))

    def _problem_of_costmaps(self, now: float) -> str:
        """Return why the robot must stand; empty if it may drive."""
        costmaps = (self.stack.global_costmap, self.stack.local_costmap)
        for costmap, sources in zip(costmaps, self._sources, strict=True):
            if not costmap.is_ready:
                assert costmap.static is not None
                topic = self._node.resolve(costmap.static.parameters.map_topic)
                return self._map_fault or f"waiting for the map on {topic}"
            late = costmap.obstacles.late_sources(now) if costmap.obstacles is not None else []
            late += [name for name in sources.refused(now) if name not in late]
            if late:
                faults = [text for one in self._sources for text in one.faults_of(late)]
                why = f": {faults[0]}" if faults else ""
                return f"no recent message of source {', '.join(late)}{why}"
        return ""

    def _note(self, problem: str, decision: Decision) -> None:
        if problem and self.stack.core.state is not State.IDLE:
            self._throttled_log.warn("problem", f"the robot stands: {problem}")
        elif decision.text and decision.ending is None and not problem:
            self._node.log.warning("%s", decision.text)
        self._problem = problem

    # Plans

    async def _plan(self, start: Pose) -> None:
        """Make the plan that is wanted, in a thread."""
        goal, stack = self._goals.target, self.stack
        if goal is None:
            return
        began = time.perf_counter()
        plan = await asyncio.to_thread(stack.plan, stack.snapshot(), start, goal)
        self._plan_seconds = time.perf_counter() - began
        if goal is not self._goals.target:
            return
        stack.core.take_plan(plan, self._node.time())
        if not plan.found:
            self._throttled_log.warn("plan", f"no plan: {plan.reason}")
            return
        header = {"stamp": self._node.now(), "frame_id": self._frames[0]}
        self._plans.publish(path_fields(plan.path, header))

    def _publish_local_plan(self, decision: Decision) -> None:
        header = {"stamp": self._node.now(), "frame_id": self._frames[1]}
        if decision.trajectory is not None and self._local_plan.connections:
            self._local_plan.publish(path_fields(decision.trajectory, header))
        path = self.stack.local_planner.path
        if path is not None and self._global_plan.connections:
            rest = path.poses[path.at >= path.progress]
            self._global_plan.publish(path_fields(rest, header))

    # State

    def _report(self, diagnostics: Diagnostics) -> None:
        core = self.stack.core
        slowest, busiest = (_p99([step[clock] for step in self._steps]) for clock in (0, 1))
        level = Level.OK
        if self._problem:
            level = Level.WARN if core.state is State.IDLE else Level.ERROR
        diagnostics.publish(
            level,
            self._problem or core.state.value,
            {
                "state": core.state.value,
                "recoveries": str(core.recovered),
                "control step p99 (ms)": f"{1e3 * slowest:.2f}",
                "control step p99, CPU (ms)": f"{1e3 * busiest:.2f}",
                "last plan (ms)": f"{1e3 * self._plan_seconds:.2f}",
                "warnings": str(self._throttled_log.count),
                "speed": f"{self._commanded.speed:.3f}",
            },
        )


def _p99(values: list[float]) -> float:
    return sorted(values)[int(0.99 * (len(values) - 1))] if values else 0.0


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("move_base") as node:
        found = await node.get_param("~", {})
        values = found if isinstance(found, Mapping) else {}
        settings, problems = read_settings(values, node.resolve("~").rstrip("/") + "/")
        for problem in problems:
            (node.log.warning if problem.is_unknown else node.log.error)("%s", problem.text)
        await asyncio.to_thread(compile_kernels)  # the master calls the node meanwhile
        await MoveBaseNode(node, settings).run()


if __name__ == "__main__":
    run(main())
