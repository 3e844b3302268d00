"""A real actionlib client of rospy drives a robot by ``move_base``, which runs as a process."""

from __future__ import annotations

import asyncio
import json
import os
from math import hypot
from pathlib import Path

import pytest
from support.processes import finish
from support.robot_in_world import robot_in_world, room
from support.ros_real import Graph

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce_fleet.geometry.poses import Pose

pytestmark = [pytest.mark.needs("actionlib"), pytest.mark.needs("ros_msgs"), pytest.mark.timeout(300)]

CLIENT = """
import json
import actionlib, rospy
from move_base_msgs.msg import MoveBaseAction, MoveBaseGoal
from actionlib_msgs.msg import GoalStatus
from nav_msgs.srv import GetPlan, GetPlanRequest

rospy.init_node("client")
client = actionlib.SimpleActionClient("move_base", MoveBaseAction)
assert client.wait_for_server(rospy.Duration(200))
report = {"feedback": 0}

def feedback(message):
    report["feedback"] += 1
    report["frame"] = message.base_position.header.frame_id

def send(x, y):
    goal = MoveBaseGoal()
    goal.target_pose.header.frame_id = "map"
    goal.target_pose.header.stamp = rospy.Time.now()
    goal.target_pose.pose.position.x = x
    goal.target_pose.pose.position.y = y
    goal.target_pose.pose.orientation.w = 1.0
    client.send_goal(goal, feedback_cb=feedback)

send(2.6, 1.0)
assert client.wait_for_result(rospy.Duration(200))
report["first"] = [GoalStatus.to_string(client.get_state()), client.get_goal_status_text()]
send(30.0, 1.0)
assert client.wait_for_result(rospy.Duration(200))
report["second"] = [GoalStatus.to_string(client.get_state()), client.get_goal_status_text()]
request = GetPlanRequest()
request.goal.header.frame_id = "map"
request.goal.pose.position.x = 1.0
request.goal.pose.position.y = 1.0
request.goal.pose.orientation.w = 1.0
report["plan"] = len(rospy.ServiceProxy("move_base/make_plan", GetPlan)(request).plan.poses)
print(json.dumps(report))
"""

SCAN = {"data_type": "LaserScan", "topic": "scan", "marking": True, "clearing": True, "inf_is_valid": True}
COMMON = {"robot_radius": 0.18, "transform_tolerance": 1.0, "observation_sources": "scan", "scan": SCAN}
PARAMETERS = {
    "controller_frequency": 10.0,
    "planner_patience": 1.0,
    "recovery_behavior_enabled": False,
    "global_costmap": COMMON,
    "local_costmap": {**COMMON, "global_frame": "odom", "rolling_window": True, "width": 4.0, "height": 4.0},
    "TrajectoryPlannerROS": {"max_vel_x": 0.6, "max_vel_theta": 1.5, "acc_lim_x": 0.9, "acc_lim_theta": 4.0},
}


async def test_a_real_client_drives_a_robot(tmp_path: Path) -> None:
    script = tmp_path / "client.py"
    script.write_text(CLIENT)
    async with (
        Core(port=0) as core,
        Node("robot", argv=[], master_uri=core.uri) as node,
        robot_in_world(node, room(4.0, 2.4), [], Pose(0.8, 1.0, 0.0)) as robot,
    ):
        await node.set_param("/move_base", PARAMETERS)
        command = PackageIndex.from_environ().find("move_base").executable("move_base")
        process = await asyncio.create_subprocess_exec(
            *command, env={**os.environ, "ROS_MASTER_URI": core.uri}, start_new_session=True
        )
        try:
            output = await Graph(core.uri, tmp_path, "ours").tool("/usr/bin/python3", str(script))
        finally:
            await finish(process)
        report = json.loads(output.splitlines()[-1])
        assert report["first"] == ["SUCCEEDED", "Goal reached."]
        assert report["second"][0] == "ABORTED"
        assert "off the costmap" in report["second"][1]
        assert report["feedback"] > 3
        assert report["frame"] == "map"
        assert report["plan"] > 20
        assert hypot(robot.world.pose.x - 2.6, robot.world.pose.y - 1.0) <= 0.1 + 0.05
        assert robot.world.contacts == 0
