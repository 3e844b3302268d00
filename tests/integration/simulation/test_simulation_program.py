"""The simulation program: a ROS graph for each robot, and a report of what truly happens."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest
from support.engine import Program, until

from rce.ros.node import Node
from rce_client.simulation.report import read_report
from rce_client.simulation.scene import RobotStart, Scene

pytestmark = pytest.mark.needs("pymunk")

SCENE = Scene(robots=(RobotStart(id="Robot1", cell=0), RobotStart(id="Robot2", cell=63)), boxes=(9,))


def uri_of(program: Program, robot: str) -> str:
    (line,) = [line for line in program.output().splitlines() if line.startswith(f"robot {robot} ")]
    return line.split("ROS_MASTER_URI=")[1]


async def test_each_robot_is_a_graph_of_its_own_and_drives_to_goals(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(SCENE.model_dump_json())
    report = tmp_path / "world.json"
    argv = [sys.executable, "-m", "rce_client.simulation", str(tmp_path / "scene.json")]
    program = Program("simulation", [*argv, "--report", str(report)], dict(os.environ), tmp_path)
    await program.start(ready="simulation ready:")
    try:
        assert uri_of(program, "Robot1") != uri_of(program, "Robot2")
        async with Node("t", argv=(), master_uri=uri_of(program, "Robot1"), signals=False) as node:
            poses = await node.subscribe("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped")
            goals = await node.advertise("/move_base/goal", "move_base_msgs/MoveBaseActionGoal")
            async with asyncio.timeout(20):
                async for message in poses:
                    assert abs(message.pose.pose.position.x - 0.5) < 0.1
                    break
                await goals.wait_for_subscribers(1)
            place = {"position": {"x": 0.5, "y": 1.5}, "orientation": {"w": 1.0}}
            goals.publish(
                goal_id={"id": "g1"}, goal={"target_pose": {"header": {"frame_id": "map"}, "pose": place}}
            )

            def arrived() -> bool:
                seen = read_report(report)
                return seen is not None and seen.robot("Robot1").cell == 8

            await until(arrived, timeout=20, what="the robot is in cell 8")
    finally:
        assert await program.stop() == 0
    last = read_report(report)
    assert last is not None
    assert last.collisions.total == 0
    assert last.boxes == [9]
    assert last.robot("Robot1").distance_m > 0.5
    assert last.robot("Robot2").distance_m == 0


async def test_a_bad_scene_ends_the_program(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text('{"rows": 0}')
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rce_client.simulation", str(tmp_path / "scene.json")),
        stderr=asyncio.subprocess.PIPE,
    )
    _, said = await process.communicate()
    assert process.returncode == 2
    assert b"rows" in said
