"""``move_base`` and the safety stage as nodes on a real core drive a robot in a world without physics."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import hypot, pi
from typing import Any

import pytest
from support.robot_in_world import RobotInWorld, robot_in_world, room

from rce.ros.actions import ActionClient, GoalFailedError, GoalState
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.nodes.move_base import MoveBaseNode
from rce_fleet.nodes.move_base_parameters import read_settings
from rce_fleet.nodes.planar import pose_fields
from rce_fleet.nodes.velocity_limiter import VelocityLimiterNode

pytestmark = pytest.mark.timeout(240)

SCAN = {"data_type": "LaserScan", "topic": "scan", "marking": True, "clearing": True, "inf_is_valid": True}
COMMON = {
    "robot_radius": 0.18,
    "transform_tolerance": 1.0,
    "publish_frequency": 2.0,
    "obstacle_layer": {"observation_sources": "scan", "scan": SCAN},
    "inflation_layer": {"inflation_radius": 0.5, "cost_scaling_factor": 5.0},
}
LAYERS = [
    {"name": "obstacle_layer", "type": "costmap_2d::ObstacleLayer"},
    {"name": "inflation_layer", "type": "costmap_2d::InflationLayer"},
]
STATIC = {"name": "static_layer", "type": "costmap_2d::StaticLayer"}
PARAMETERS: dict[str, Any] = {
    "base_local_planner": "dwa_local_planner/DWAPlannerROS",
    "controller_frequency": 10.0,
    "planner_patience": 1.0,
    "recovery_behavior_enabled": False,
    "global_costmap": {**COMMON, "plugins": [STATIC, *LAYERS]},
    "local_costmap": {
        **COMMON,
        "global_frame": "odom",
        "rolling_window": True,
        "width": 4.0,
        "height": 4.0,
        "plugins": LAYERS,
    },
    "DWAPlannerROS": {"max_vel_x": 0.6, "max_vel_theta": 1.5, "acc_lim_x": 0.9, "acc_lim_theta": 4.0},
}
START = Pose(0.8, 1.0, 0.0)
WALLS = room(4.0, 2.4)


@asynccontextmanager
async def navigation(
    core: Core, *boxes: tuple[float, float, float, float], at: Pose = START
) -> AsyncIterator[tuple[Node, RobotInWorld, MoveBaseNode]]:
    """Run a robot, ``move_base`` and the safety stage; yield a node that sees them."""
    settings, problems = read_settings(PARAMETERS)
    assert problems == []
    async with (
        Node("robot", argv=[], master_uri=core.uri) as robot_node,
        Node("move_base", argv=["cmd_vel:=raw_cmd_vel"], master_uri=core.uri) as base_node,
        Node("velocity_limiter", argv=[], master_uri=core.uri) as safety_node,
        Node("judge", argv=[], master_uri=core.uri) as judge,
        robot_in_world(robot_node, WALLS, list(boxes), at) as robot,
    ):
        base = MoveBaseNode(base_node, settings)
        limits = SafetyParameters(
            robot_radius=0.177, scan_timeout=1.0, command_timeout=1.0, transform_timeout=1.0
        )
        tasks = [
            asyncio.create_task(base.run()),
            asyncio.create_task(VelocityLimiterNode(safety_node, limits).run()),
        ]
        try:
            yield judge, robot, base
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)


def goal_to(x: float, y: float, yaw: float = 0.0, frame: str = "map") -> dict[str, Any]:
    return {"target_pose": {"header": {"frame_id": frame}, "pose": pose_fields(Pose(x, y, yaw))}}


@asynccontextmanager
async def client_of(node: Node) -> AsyncIterator[ActionClient]:
    async with ActionClient(node, "move_base", "move_base_msgs/MoveBaseAction") as client:
        await client.wait_for_server(timeout=60)
        yield client


@pytest.fixture
async def core() -> AsyncIterator[Core]:
    async with Core(port=0) as running:
        yield running


async def test_a_robot_drives_around_a_box_to_its_goal(core: Core) -> None:
    """Feedback, the plan and both costmaps are published; the box is on no map."""
    heard: dict[str, list[Message]] = {}
    async with navigation(core, (1.7, 0.7, 2.1, 1.2)) as (judge, robot, _), client_of(judge) as client:
        for topic, kind in (
            ("move_base/NavfnROS/plan", "nav_msgs/Path"),
            ("move_base/DWAPlannerROS/local_plan", "nav_msgs/Path"),
            ("move_base/global_costmap/costmap", "nav_msgs/OccupancyGrid"),
            ("move_base/global_costmap/costmap_updates", "map_msgs/OccupancyGridUpdate"),
            ("move_base/local_costmap/costmap", "nav_msgs/OccupancyGrid"),
            ("move_base/local_costmap/footprint", "geometry_msgs/PolygonStamped"),
            ("move_base/current_goal", "geometry_msgs/PoseStamped"),
            ("diagnostics", "diagnostic_msgs/DiagnosticArray"),
        ):
            await judge.subscribe(topic, kind, heard.setdefault(topic, []).append)
        feedback: list[Message] = []
        goal = await client.send(goal_to(3.2, 1.0, pi / 2), on_feedback=feedback.append)
        await asyncio.wait_for(goal.result(), 120)
        pose = robot.world.pose
        assert hypot(pose.x - 3.2, pose.y - 1.0) <= 0.1 + 0.05
        assert abs(pose.yaw - pi / 2) <= 0.1 + 0.05
        assert robot.world.contacts == 0
        assert feedback[-1].base_position.header.frame_id == "map"
        assert [topic for topic, messages in heard.items() if not messages] == []
        assert heard["move_base/NavfnROS/plan"][0].header.frame_id == "map"
        assert heard["move_base/local_costmap/costmap"][0].header.frame_id == "odom"
        assert max(heard["move_base/global_costmap/costmap"][0].data) == 100
        names = {status.name for message in heard["diagnostics"] for status in message.status}
        assert names == {"/move_base: navigation", "/velocity_limiter: velocity_limiter: safety"}


async def test_an_error_stops_the_robot(core: Core, monkeypatch: pytest.MonkeyPatch) -> None:
    """The node ends by it, and wheels keep their last command."""

    def fail(*_: object) -> None:
        raise ZeroDivisionError("a test wants it")

    async with navigation(core) as (judge, robot, base), client_of(judge) as client:
        raw: list[Message] = []
        await judge.subscribe("raw_cmd_vel", "geometry_msgs/Twist", raw.append)
        await client.send(goal_to(3.2, 1.0))
        async with asyncio.timeout(60):
            while robot.world.twist.speed < 0.3:
                await asyncio.sleep(0.05)
            monkeypatch.setattr(base.stack, "control", fail)
            while raw[-1].linear.x:
                await asyncio.sleep(0.05)


async def test_cancelling_stops_the_robot_at_once(core: Core) -> None:
    async with navigation(core) as (judge, robot, base), client_of(judge) as client:
        raw: list[Message] = []
        await judge.subscribe("raw_cmd_vel", "geometry_msgs/Twist", raw.append)
        goal = await client.send(goal_to(3.2, 1.0))
        async with asyncio.timeout(60):
            while robot.world.twist.speed < 0.3:
                await asyncio.sleep(0.05)
        steps = len(raw)
        goal.cancel()
        with pytest.raises(GoalFailedError):
            await asyncio.wait_for(goal.result(), 60)
        assert goal.state is GoalState.PREEMPTED
        assert base.commanded == Twist()
        speeds = [message.linear.x for message in raw[steps:]]
        assert not any(speeds[speeds.index(0.0) :])  # the first stop is the last command
        async with asyncio.timeout(60):
            while robot.world.twist.speed > 0:
                await asyncio.sleep(0.05)


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        (goal_to(3.98, 1.0), "in an obstacle"),
        (goal_to(30.0, 1.0), "off the costmap"),
        (goal_to(float("nan"), 1.0), "not finite"),
        (goal_to(1.0, 1.0, frame=""), "frame_id is empty"),
        (goal_to(1.0, 1.0, frame="mars"), "mars"),
    ],
    ids=["wall", "off", "nan", "frame", "tf"],
)
async def test_a_bad_goal_is_aborted_with_its_reason(core: Core, goal: dict[str, Any], reason: str) -> None:
    async with navigation(core) as (judge, robot, _), client_of(judge) as client:
        sent = await client.send(goal)
        with pytest.raises(GoalFailedError, match=reason):
            await asyncio.wait_for(sent.result(), 60)
        assert sent.state is GoalState.ABORTED
        assert all(twist == Twist() for _, twist in robot.commands)


async def test_a_goal_in_the_robots_frame_and_services(core: Core) -> None:
    """A goal half a metre ahead of the robot; make_plan and clear_costmaps answer beside it."""
    async with navigation(core, at=Pose(1.0, 1.0, pi / 2)) as (judge, robot, _), client_of(judge) as client:
        goal = await client.send(goal_to(0.5, 0.0, frame="base_link"))
        await asyncio.wait_for(goal.result(), 120)
        assert hypot(robot.world.pose.x - 1.0, robot.world.pose.y - 1.5) <= 0.1 + 0.05
        plans = judge.service_client("move_base/make_plan", "nav_msgs/GetPlan")
        header = {"frame_id": "map"}
        answer = await plans(goal={"header": header, "pose": pose_fields(Pose(3.0, 1.0, 0.3))})
        assert len(answer.plan.poses) > 30
        assert answer.plan.poses[-1].pose.position.x == pytest.approx(3.0)
        clear = judge.service_client("move_base/clear_costmaps", "std_srvs/Empty")
        await clear()


async def test_without_scans_or_after_a_stop_it_stands(core: Core) -> None:
    """The safety stage stops a robot whose scans end, and one that is told to, until released."""
    async with navigation(core) as (judge, robot, _), client_of(judge) as client:
        goal = await client.send(goal_to(3.2, 1.0))
        async with asyncio.timeout(60):
            while robot.world.twist.speed < 0.2:
                await asyncio.sleep(0.02)
        stop = judge.service_client("velocity_limiter/set_emergency_stop", "std_srvs/SetBool")
        assert (await stop(data=True)).success
        async with asyncio.timeout(60):
            while robot.world.twist.speed > 0:
                await asyncio.sleep(0.02)
        at = robot.world.pose
        await asyncio.sleep(0.5)
        assert robot.world.pose == at
        robot.senses = False
        assert (await stop(data=False)).success
        released = robot.world.time
        async with asyncio.timeout(60):  # the last scan counts for a second
            while robot.world.time < released + 1.5 or robot.world.twist.speed > 0:
                await asyncio.sleep(0.02)
        still = robot.world.pose
        await asyncio.sleep(0.5)
        assert robot.world.pose == still
        robot.senses = True
        await asyncio.wait_for(goal.result(), 120)
        assert robot.world.contacts == 0


async def test_without_its_localization_it_stands_and_claims_to_be_nowhere(core: Core) -> None:
    """Feedback goes on when the robot knows again where it is, and is never of another place."""
    async with navigation(core) as (judge, robot, _), client_of(judge) as client:
        feedback: list[Message] = []
        goal = await client.send(goal_to(3.2, 1.0), on_feedback=feedback.append)
        async with asyncio.timeout(60):
            while robot.world.twist.speed < 0.2:
                await asyncio.sleep(0.02)
        robot.is_localized = False
        lost = robot.world.time
        async with asyncio.timeout(60):  # the last transform counts for a second
            while robot.world.time < lost + 2.5 or robot.world.twist.speed > 0:
                await asyncio.sleep(0.02)
        heard = len(feedback)
        robot.is_localized = True
        await asyncio.wait_for(goal.result(), 120)
        places = [message.base_position.pose.position for message in feedback]
        assert len(places) > heard
        assert all(START.x - 0.1 < place.x < 3.4 and 0.7 < place.y < 1.3 for place in places)


async def test_a_robot_whose_scans_are_refused_says_why(core: Core) -> None:
    """It stands: its place is known, but the costmaps show only the map. Sources have no expected rate."""
    async with navigation(core) as (judge, robot, base), client_of(judge) as client:
        robot.lidar_clock = 30.0
        reasons: list[str] = []

        def take(message: Message) -> None:
            reasons.extend(status.message for status in message.status if "move_base" in status.name)

        await judge.subscribe("diagnostics", "diagnostic_msgs/DiagnosticArray", take)
        async with asyncio.timeout(60):
            while "are the clocks of the machines in step" not in "".join(reasons[-1:]):
                await asyncio.sleep(0.05)
        assert "no recent message of source scan: the last one is ignored: its stamp is" in reasons[-1]
        goal = await client.send(goal_to(3.2, 1.0))
        await asyncio.sleep(1.0)
        assert base.commanded == Twist()
        robot.lidar_clock = 0.0
        await asyncio.wait_for(goal.result(), 120)
