"""The simulation program: a ROS graph for each robot, and a report of what truly happens."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest
from support.engine import Program, until

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import TransformListener
from rce_fleet.drivers.report import read_report
from rce_fleet.drivers.scene import RobotStart, Scene

pytestmark = pytest.mark.needs("pymunk")

SCENE = Scene(robots=(RobotStart(id="Robot1", cell=0), RobotStart(id="Robot2", cell=63)), boxes=(9,))


def uri_of(program: Program, robot: str) -> str:
    (line,) = [line for line in program.output().splitlines() if line.startswith(f"robot {robot} ")]
    return line.split("ROS_MASTER_URI=")[1]


async def test_each_robot_is_a_graph_of_its_own_and_drives_to_goals(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(SCENE.model_dump_json())
    report = tmp_path / "world.json"
    argv = [sys.executable, "-m", "rce_fleet.drivers", str(tmp_path / "scene.json")]
    program = Program("simulation", [*argv, "--report", str(report)], dict(os.environ), tmp_path)
    await program.start(ready="simulation ready:")
    try:
        assert uri_of(program, "Robot1") != uri_of(program, "Robot2")
        async with Node("t", argv=(), master_uri=uri_of(program, "Robot1"), signals=False) as node:
            poses = await node.subscribe("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped")
            goals = await node.advertise("/move_base/goal", "move_base_msgs/MoveBaseActionGoal")
            async with asyncio.timeout(60):
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


async def test_robots_in_one_graph_have_own_namespaces(tmp_path: Path) -> None:
    """Robots that share a graph have namespaces and frames of their own."""
    (tmp_path / "scene.json").write_text(SCENE.model_dump_json())
    argv = [sys.executable, "-m", "rce_fleet.drivers", str(tmp_path / "scene.json")]
    async with Core(port=0) as core:
        program = Program("simulation", [*argv, "--core", core.uri], dict(os.environ), tmp_path)
        await program.start(ready="simulation ready:")
        try:
            assert uri_of(program, "Robot1") == uri_of(program, "Robot2") == core.uri
            node = Node("t", argv=(), master_uri=core.uri, signals=False)
            async with node, TransformListener(node) as tf, asyncio.timeout(60):
                assert await node.get_param("/Robot2/tf_prefix") == "Robot2"
                for robot, middle in (("Robot1", 0.5), ("Robot2", 7.5)):
                    place = (await tf.wait_for("map", f"{robot}/base_scan")).transform.translation
                    assert (place.x, place.y) == pytest.approx((middle, middle), abs=0.1)
                odometry = await node.subscribe("/Robot2/odom", "nav_msgs/Odometry")
                async for message in odometry:
                    assert message.header.frame_id == "Robot2/odom"
                    assert message.child_frame_id == "Robot2/base_link"
                    break
        finally:
            assert await program.stop() == 0


async def test_the_planners_cells_get_boxes_from_its_graph(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(SCENE.model_dump_json())
    report = tmp_path / "world.json"
    argv = [sys.executable, "-m", "rce_fleet.drivers", str(tmp_path / "scene.json")]
    async with Core(port=0) as core, Node("p", argv=(), master_uri=core.uri, signals=False) as node:
        cells = await node.advertise("/fleet/requestedCells", "std_msgs/Int32MultiArray", latch=True)
        cells.publish(data=[20])
        options = ["--planner-core", core.uri, "--report", str(report)]
        program = Program("simulation", [*argv, *options], dict(os.environ), tmp_path)
        await program.start(ready="simulation ready:")
        try:

            def has_box() -> bool:
                seen = read_report(report)
                return seen is not None and 20 in seen.boxes

            await until(has_box, timeout=20, what="cell 20 has a box")
        finally:
            assert await program.stop() == 0


async def test_a_bad_scene_ends_the_program(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text('{"rows": 0}')
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rce_fleet.drivers", str(tmp_path / "scene.json")),
        stderr=asyncio.subprocess.PIPE,
    )
    _, said = await process.communicate()
    assert process.returncode == 2
    assert b"rows" in said
