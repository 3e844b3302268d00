"""Gives a simulated robot tasks, and judges when each is done: ``task_judge --orders FILE``.

The file of orders has one JSON object per line, with a ``number`` and a ``task``; the experiment appends to
it. After each order the program tells a report with the same number. It runs beside the robot's hardware: it
measures what arrives at the robot, and only it reads the robot's true pose.
"""

from __future__ import annotations

import argparse
import json
from bisect import bisect_right
from itertools import pairwise
from math import dist, pi
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rce.ros.node import Message, Node, Publisher, ServiceClient, ServiceError, run
from rce_fleet.experiments.workloads.telling import tell, tell_ready
from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.nodes.planar import pose_fields, read_pose, twist_fields
from rce_fleet.nodes.pose_messages import pose_with_covariance_fields

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

POLL_S = 0.01
"""How often it looks for orders, and whether a task is done."""
NEAR_M = 0.2
"""A robot that stands so near its goal has arrived: the goal's tolerance, and localization's error."""
STANDS = 0.02
"""A slower robot stands, m/s and rad/s."""
COMMAND_S = 0.1
"""Between two commands of a drive that is made without looking."""
STILL_S = 0.3
"""A scan that is taken so long after the last command is of a standing robot."""
OFF_M, OFF_RAD = 0.15, 0.15
"""A map is good if by it the robot moved as it did, but for this."""
SETTLED_S = 0.5
"""After so long scans that were taken before the robot was moved, and commands made of them, are there."""
CALL_S = 2.0
"""A call of a service that may not be there yet is made again after so long."""
FRAME = "map"
ROBOT_NAME = "Robot1"
"""Of the robot, in the simulation."""
WORLD_PORT = 11310
"""Port of the simulation's own core, which has its services."""
START_COVARIANCE = np.diag((0.25, 0.25, (pi / 12) ** 2))
"""Of x, y and yaw, as ``amcl`` has it at its start by default."""


class Answer(NamedTuple):
    """What was made of a scan: the scan's stamp, and when it was at the robot, seconds."""

    stamp: float
    arrival: float


class Judge:
    """Does orders one after another.

    Args:
        node: A running node in the robot's graph.
        world: One in that of the simulation.
    """

    def __init__(self, node: Node, world: Node) -> None:
        self._node = node
        self._world = world
        self._truth: list[Pose] = []
        """Where the robot was since the task began."""
        self._speed = Twist()
        self._scans: list[float] = []
        """Stamps of the scans since the task began."""
        self._mapped: list[tuple[float, Pose]] = []
        """Stamps and poses of the mapper, of scans since the task began."""
        self._answers: dict[str, list[Answer]] = {}
        """What was made of scans since the task began, by what that is."""
        self._began = 0.0
        self._goals: Publisher
        self._cancels: Publisher
        self._commands: Publisher
        self._starts: Publisher
        self._plans: ServiceClient
        self._moves: ServiceClient

    async def start(self) -> None:
        """Join the graph."""
        node = self._node
        self._goals = await node.advertise("/move_base_simple/goal", "geometry_msgs/PoseStamped")
        self._cancels = await node.advertise("/move_base/cancel", "actionlib_msgs/GoalID")
        self._commands = await node.advertise("/raw_cmd_vel", "geometry_msgs/Twist")
        self._plans = node.service_client("/move_base/make_plan", "nav_msgs/GetPlan", persistent=False)
        self._moves = self._world.service_client("/simulation/move", "gazebo_msgs/SetModelState")
        pose = "geometry_msgs/PoseWithCovarianceStamped"
        self._starts = await node.advertise("/initialpose", pose)
        await node.subscribe("/ground_truth/pose", "nav_msgs/Odometry", self._take_truth)
        await node.subscribe("/scan", "sensor_msgs/LaserScan", self._take_scan)
        await node.subscribe("/pose", pose, self._take_mapped)
        await node.subscribe("/amcl_pose", pose, lambda message: self._note("pose", message))
        await node.subscribe(
            "/move_base/stamped_cmd_vel",
            "geometry_msgs/TwistStamped",
            lambda message: self._note("command", message),
        )

    async def do(self, order: dict[str, Any]) -> dict[str, Any]:
        """Do an order, and return what was measured.

        Args:
            order: ``task`` is ``navigation``, ``mapping`` or ``planning``, which are measured, or
                ``await_navigation`` or ``await_mapping``: wait until its nodes do what they are for; or
                ``return``: the robot is put somewhere, and is localized there as at its start.
        """
        self._began = self._node.time()
        self._answers = {}
        self._scans.clear()
        self._mapped = self._mapped[-1:]
        await self._until(lambda: bool(self._truth), order["patience"])
        del self._truth[:-1]
        actions = {
            "navigation": self._navigate,
            "mapping": self._map,
            "planning": self._plan,
            "await_navigation": self._await_navigation,
            "await_mapping": self._await_mapping,
            "return": self._return,
        }
        success = await actions[order["task"]](order)
        return {
            "number": order["number"],
            "success": success,
            "seconds": self._node.time() - self._began,
            "delays": {what: delays_of(self._scans, found) for what, found in self._answers.items()},
            "answered": {what: len({one.stamp for one in found}) for what, found in self._answers.items()},
            "metres": sum(dist((a.x, a.y), (b.x, b.y)) for a, b in pairwise(self._truth)),
            "radians": sum(abs(wrap(b.yaw - a.yaw)) for a, b in pairwise(self._truth)),
            "scans": len(self._scans),
        }

    async def _navigate(self, order: dict[str, Any]) -> bool:
        """Send the robot to a goal, and wait until it stands there."""
        goal = Pose(order["x"], order["y"], order["yaw"])
        now = self._node.now()
        self._goals.publish(header={"stamp": now, "frame_id": FRAME}, pose=pose_fields(goal))

        def has_arrived() -> bool:
            at = self._truth[-1]
            return dist((at.x, at.y), (goal.x, goal.y)) <= NEAR_M and self._stands

        arrived = await self._until(has_arrived, order["patience"])
        if not arrived:
            self._cancels.publish()
        return arrived

    async def _map(self, order: dict[str, Any]) -> bool:
        """Drive without looking, and wait until the mapper has used the last scan."""
        before, at = self._mapped[-1][1], self._truth[-1]
        command = twist_fields(Twist(order["speed"], order["turn_rate"]))
        while self._node.time() - self._began < order["drive_s"]:
            self._commands.publish(command)
            await self._node.sleep(COMMAND_S)
        self._commands.publish(twist_fields(Twist()))
        last = self._node.time() + STILL_S
        done = await self._until(lambda: self._mapped[-1][0] >= last, order["patience"])
        seen, moved = self._mapped[-1][1].relative_to(before), self._truth[-1].relative_to(at)
        off = dist((seen.x, seen.y), (moved.x, moved.y))
        return done and off < OFF_M and abs(wrap(seen.yaw - moved.yaw)) < OFF_RAD

    async def _plan(self, order: dict[str, Any]) -> bool:
        """Ask for plans to a goal, one after another, again where there is none."""
        deadline = self._began + order["patience"]
        found = 0
        while found < order["plans"]:
            left = deadline - self._node.time()
            if left <= 0:
                return False
            if await self._is_planned(order, left):
                found += 1
            else:
                await self._node.sleep(POLL_S)
        return True

    async def _return(self, order: dict[str, Any]) -> bool:
        """Put the robot somewhere, and wait until ``amcl``, which is told so, has used a scan from there."""
        at = Pose(order["x"], order["y"], order["yaw"])
        if not await self._until(lambda: self._stands, order["patience"]):
            return False
        await self._node.sleep(SETTLED_S)
        state = {"model_name": ROBOT_NAME, "pose": pose_fields(at)}
        if not (await self._moves.call({"model_state": state}, timeout=order["patience"])).success:
            return False
        await self._node.sleep(SETTLED_S)
        told = self._node.now()
        self._starts.publish(
            header={"stamp": told, "frame_id": FRAME}, pose=pose_with_covariance_fields(at, START_COVARIANCE)
        )
        return await self._until(
            lambda: any(one.stamp > told.to_sec() for one in self._answers.get("pose", ())), order["patience"]
        )

    async def _await_navigation(self, order: dict[str, Any]) -> bool:
        """Wait until plans are answered and a pose has been found."""
        deadline = self._node.time() + order["patience"]
        while not await self._is_planned(order, CALL_S):
            if self._node.time() > deadline:
                return False
            await self._node.sleep(POLL_S)
        return True

    async def _await_mapping(self, order: dict[str, Any]) -> bool:
        """Wait until the mapper has told a pose of a new scan."""
        return await self._until(
            lambda: bool(self._mapped) and self._mapped[-1][0] >= self._began, order["patience"]
        )

    async def _is_planned(self, order: dict[str, Any], timeout: float) -> bool:
        """Ask for a plan from where ``amcl`` believes the robot to be; return whether there is one."""
        goal = Pose(order["x"], order["y"], order["yaw"])
        header = {"stamp": self._node.now(), "frame_id": FRAME}
        request = {"goal": {"header": header, "pose": pose_fields(goal)}}
        try:
            answer = await self._plans.call(request, timeout=timeout)
        except ServiceError:  # it is not there yet, or too late: both mean that there is no plan
            return False
        return len(answer.plan.poses) > 1

    @property
    def _stands(self) -> bool:
        return abs(self._speed.speed) <= STANDS and abs(self._speed.turn_rate) <= STANDS

    async def _until(self, condition: Callable[[], bool], patience: float) -> bool:
        """Wait until something holds; return whether it did in time."""
        deadline = self._node.time() + patience
        while not condition():
            if self._node.time() > deadline:
                return False
            await self._node.sleep(POLL_S)
        return True

    def _note(self, what: str, message: Message) -> None:
        stamp = message.header.stamp.to_sec()
        if stamp >= self._began:
            self._answers.setdefault(what, []).append(Answer(stamp, self._node.time()))

    def _take_truth(self, message: Message) -> None:
        self._truth.append(read_pose(message.pose.pose))
        moved = message.twist.twist
        self._speed = Twist(moved.linear.x, moved.angular.z)

    def _take_scan(self, message: Message) -> None:
        self._scans.append(message.header.stamp.to_sec())

    def _take_mapped(self, message: Message) -> None:
        self._note("pose", message)
        self._mapped.append((message.header.stamp.to_sec(), read_pose(message.pose.pose)))


def delays_of(scans: Iterable[float], answers: Iterable[Answer]) -> list[float]:
    """Return the time from each scan's stamp to the first answer that was made of it or of a newer scan.

    So a scan that was left out counts with the time for which nothing newer was known. Scans after the last
    answered one do not count.

    Args:
        scans: Their stamps.
        answers: In the order of their arrival.
    """
    found: list[float] = []
    waiting = sorted(scans)
    for answer in answers:
        due = bisect_right(waiting, answer.stamp)
        found += [answer.arrival - stamp for stamp in waiting[:due]]
        del waiting[:due]
    return found


def read_orders(path: Path, done: int) -> Sequence[dict[str, Any]]:
    """Return the orders of a file after the first ``done``; a line that is being written is not one yet."""
    text = path.read_text() if path.exists() else ""
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()[done:]]


async def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="task_judge", description=__doc__)
    parser.add_argument("--orders", type=Path, required=True)
    options = parser.parse_args()
    world = Node("task_judge", argv=[], master_uri=f"http://127.0.0.1:{WORLD_PORT}/")
    async with Node("task_judge", argv=[]) as node, world:
        judge = Judge(node, world)
        await judge.start()
        tell_ready()
        done = 0
        while await node.sleep(POLL_S):
            for order in read_orders(options.orders, done):
                tell(await judge.do(order))
                done += 1


if __name__ == "__main__":
    run(main())
