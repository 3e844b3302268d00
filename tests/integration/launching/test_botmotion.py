"""A simulated TurtleBot drives with the nodes of ``botmotion.launch``: all real processes, in real time."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import hypot
from pathlib import Path

import pytest
from support.engine import Program

from rce.ros.actions import ActionClient
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message

pytestmark = pytest.mark.needs("pymunk")

TURTLEBOT = Path(__file__).parents[3] / "configs" / "turtlebot"
RCE = str(Path(sys.executable).with_name("rce"))
WAIT_S = 120.0
START = (0.5, 0.5)
GOAL = (2.5, 0.5)
POSE = "geometry_msgs/PoseWithCovarianceStamped"


@asynccontextmanager
async def program(folder: Path, uri: str, ready: str, *words: str) -> AsyncIterator[Program]:
    env = {**os.environ, "ROS_MASTER_URI": uri, "ROS_HOME": str(folder), "ROS_LOG_DIR": str(folder / "log")}
    env["ROS_PACKAGE_PATH"] = ""
    made = Program(words[0], [RCE, *words], {**env, "PYTHONUNBUFFERED": "1"}, folder)
    await made.start(ready=ready)
    try:
        yield made
    finally:
        code = await made.stop()
        print(made.output())  # noqa: T201 - shown if the test fails
    assert code == 0


async def first(node: Node, topic: str, message_type: str) -> Message:
    async with asyncio.timeout(WAIT_S):
        return await anext(aiter(await node.subscribe(topic, message_type)))


async def drive(node: Node, namespace: str) -> None:
    """Send the robot to the goal, and wait until it has arrived."""
    target = {
        "header": {"frame_id": "map", "stamp": node.now()},
        "pose": {"position": {"x": GOAL[0], "y": GOAL[1]}, "orientation": {"w": 1.0}},
    }
    async with (
        asyncio.timeout(WAIT_S),
        ActionClient(node, f"{namespace}/move_base", "move_base_msgs/MoveBase") as client,
    ):
        await client.wait_for_server()
        goal = await client.send(target_pose=target)
        await goal.result()  # raises if the goal was aborted


async def check_drive(judge: Node, namespace: str = "") -> None:
    """The robot knows where it is, drives to the goal, and really is there."""
    pose = await first(judge, f"{namespace}/amcl_pose", POSE)
    found = pose.pose.pose.position
    assert hypot(found.x - START[0], found.y - START[1]) < 0.3
    await drive(judge, namespace)
    truth = await first(judge, f"{namespace}/ground_truth/pose", "nav_msgs/Odometry")
    place = truth.pose.pose.position
    assert hypot(place.x - GOAL[0], place.y - GOAL[1]) < 0.25


async def test_a_robot_with_its_own_master_drives(tmp_path: Path) -> None:
    ports = ("--core-port", "0", "--world-port", "0")
    scene = ("sim", str(TURTLEBOT.parent / "scene.yaml"), "--no-stand-ins", *ports)
    launch = ("launch", str(TURTLEBOT / "botmotion.launch"), "robot:=Robot1")
    place = (f"initial_pose_x:={START[0]}", f"initial_pose_y:={START[1]}")
    async with program(tmp_path, "", "simulation ready", *scene) as sim:
        line = next(line for line in sim.output().splitlines() if line.startswith("robot Robot1 "))
        uri = line.partition("ROS_MASTER_URI=")[2]
        async with (
            program(tmp_path, uri, "/pose_relay_Robot1: started", *launch, *place) as launched,
            Node("judge", argv=[], master_uri=uri) as judge,
        ):
            relayed = asyncio.create_task(first(judge, "/Robot1/amcl_pose", POSE))
            await check_drive(judge)
            assert (await relayed).header.frame_id == "map"
            assert "rce_fleet.nodes.amcl" in launched.output()


async def test_a_robot_at_a_shared_master_drives(tmp_path: Path) -> None:
    """Its nodes run in the launch's own process."""
    async with Core(port=0) as core:
        scene = ("sim", str(TURTLEBOT.parent / "scene.yaml"), "--no-stand-ins", "--core", core.uri)
        launch = ("launch", "--one-process", str(TURTLEBOT / "botmotion.launch"), "tf_prefix:=Robot1")
        place = (f"initial_pose_x:={START[0]}", f"initial_pose_y:={START[1]}")
        async with (
            program(tmp_path, core.uri, "simulation ready", *scene),
            program(tmp_path, core.uri, "/Robot1/move_base: started", *launch, *place),
            Node("judge", argv=[], master_uri=core.uri) as judge,
        ):
            await check_drive(judge, "/Robot1")
