# ruff: noqa: ANN001, ANN003, ANN201, ANN204, T201, PLR0124 - runs with the Python of a real ROS, without types
# mypy: ignore-errors
"""Sends a node's bad input from outside, and prints what the node says: rospy of a real ROS."""

import json
import sys
import time

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

BEAMS = 90
STEP = 0.07
NAN = float("nan")


class Outside:
    """Publishes good and bad messages at 10 Hz until the node said what is expected."""

    def __init__(self, node):
        self.node = node
        self.logs, self.states, self.speeds = [], [], []
        rospy.Subscriber("/rosout", Log, self.take_log)
        rospy.Subscriber("/diagnostics", DiagnosticArray, self.take_state)
        rospy.Subscriber(
            "cmd_vel", Twist, lambda message: self.speeds.append((message.linear.x, message.angular.z))
        )
        self.scans = rospy.Publisher("scan", LaserScan, queue_size=5)
        self.odometry = rospy.Publisher("odom", Odometry, queue_size=5)
        self.frames = rospy.Publisher("/tf", TFMessage, queue_size=5)
        self.maps = rospy.Publisher("map", OccupancyGrid, queue_size=2, latch=True)
        self.cells = rospy.Publisher("/fleet/map", OccupancyGrid, queue_size=2, latch=True)
        self.starts = rospy.Publisher("initialpose", PoseWithCovarianceStamped, queue_size=2)
        self.commands = rospy.Publisher("raw_cmd_vel", Twist, queue_size=2)
        self.at = 0.0

    def take_log(self, message):
        if message.name == self.node:
            self.logs.append(message.msg)

    def take_state(self, message):
        for status in message.status:
            if status.name.startswith(self.node):
                self.states.append((status.level, status.message))

    def send(self, scan=None, moved=None, frames=True, stamp=None):
        now = rospy.Time.now()
        self.at += 0.02
        odometry = Odometry()
        odometry.header.stamp, odometry.header.frame_id = now, "odom"
        odometry.child_frame_id = "base_link"
        odometry.pose.pose.position.x = self.at if moved is None else moved
        odometry.pose.pose.orientation.w = 1.0
        self.odometry.publish(odometry)
        if frames:
            edges = []
            for parent, child, x in (
                ("map", "odom", 1.0),
                ("odom", "base_link", odometry.pose.pose.position.x),
                ("base_link", "laser", 0.0),
            ):
                if (parent == "map" and self.node in ("/amcl", "/slam_gmapping", "/slam_graph")) or x != x:
                    continue
                edge = TransformStamped()
                edge.header.stamp, edge.header.frame_id, edge.child_frame_id = now, parent, child
                edge.transform.translation.x = x
                edge.transform.rotation.w = 1.0
                edges.append(edge)
            self.frames.publish(TFMessage(edges))
        message = LaserScan()
        message.header.stamp = now if stamp is None else now + rospy.Duration(stamp)
        message.header.frame_id = "laser"
        message.angle_min, message.angle_increment = -3.1, STEP
        message.angle_max = -3.1 + STEP * (BEAMS - 1)
        message.range_min, message.range_max, message.ranges = 0.1, 8.0, [2.0] * BEAMS
        for name, value in (scan or {}).items():
            setattr(message.header if name == "frame_id" else message, name, value)
        self.scans.publish(message)

    def until(self, text, where="log", limit=100.0, **bad):
        """Send until a log line or a state contains the text."""
        end = time.time() + limit
        first = len(self.states)
        while time.time() < end:
            lines = (
                self.logs if where == "log" else [line for level, line in self.states[first:] if level > 0]
            )
            if any(text in line for line in lines):
                return
            if bad.get("command") is not None:
                self.commands.publish(bad["command"])
            self.send(**{name: value for name, value in bad.items() if name != "command"})
            time.sleep(0.1)
        raise SystemExit(f"{self.node} did not say {text!r} ({where}): {self.logs[-8:]} {self.states[-4:]}")


def grid(width=40, height=40, resolution=0.1, count=None, frame="map"):
    message = OccupancyGrid()
    message.header.frame_id = frame
    message.info.width, message.info.height, message.info.resolution = width, height, resolution
    message.info.origin.orientation.w = 1.0
    message.data = [0] * (width * height if count is None else count)
    return message


SCANS = (
    ({"ranges": [1.0] * 7}, "7"),
    ({"ranges": []}, "ranges"),
    ({"angle_min": NAN}, "finite"),
    ({"angle_increment": 0.0}, "angle_increment must not be 0"),
    ({"frame_id": "nowhere"}, "nowhere"),
)


def bad_scans(outside, says):
    for scan, text in SCANS:
        outside.logs.clear()
        outside.until(text, scan=scan, **says)
    outside.logs.clear()
    outside.until("in the future", stamp=500.0, **says)
    outside.logs.clear()
    outside.until("old", stamp=-500.0, **says)
    for value in (NAN, float("inf"), -1.0):
        for _ in range(5):
            outside.send(scan={"ranges": [value] * BEAMS})
            time.sleep(0.1)


def main():
    kind = sys.argv[1]
    rospy.init_node("outside")
    outside = Outside("/" + kind)
    CASES[kind](outside)
    print(json.dumps({"logs": len(outside.logs), "states": len(outside.states)}))


def drive_amcl(outside):
    outside.maps.publish(grid(count=7))
    outside.until("7 values")
    outside.until("7 values", "state")
    outside.maps.publish(grid(resolution=0.0))
    outside.until("resolution must be")
    outside.maps.publish(grid(frame="mars"))
    outside.until("'mars'")
    bad_scans(outside, {})
    outside.until("the odometry jumped", moved=400.0)
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id = "odom"
    pose.pose.pose.orientation.w = 1.0
    outside.starts.publish(pose)
    outside.until("initialpose is in frame 'odom', expected 'map'")
    outside.until("cannot be used", "state", frames=False)


def drive_move_base(outside):
    outside.maps.publish(grid(count=7))
    outside.until("7 values")
    outside.until("7 values", "state")
    outside.maps.publish(grid(resolution=-1.0))
    outside.until("resolution must be")
    outside.maps.publish(grid(frame="mars"))
    outside.until("it is in frame 'mars', expected 'map'")
    bad_scans(outside, {})
    outside.until(
        "no recent message of source scan: the last one is ignored", "state", scan={"ranges": [1.0] * 7}
    )
    outside.until("odometry jumped", moved=400.0)
    outside.until("old", "state", frames=False)
    assert not any(speed != (0.0, 0.0) for speed in outside.speeds), outside.speeds[-5:]


def drive_velocity_limiter(outside):
    command = Twist()
    command.linear.x = 0.3
    bad_scans(outside, {"command": command})
    outside.until("a scan of /scan is ignored", "state", scan={"ranges": [1.0] * 7}, command=command)
    outside.speeds.clear()
    for _ in range(10):
        outside.commands.publish(command)
        outside.send(scan={"ranges": [1.0] * 7})
        time.sleep(0.1)
    assert not any(speed != (0.0, 0.0) for speed in outside.speeds), outside.speeds[-5:]
    outside.until("the odometry jumped", moved=400.0, command=command)
    outside.until("odometry is ignored", moved=NAN, command=command)
    command.linear.x = NAN
    outside.until("is taken for a stop", command=command)
    assert all(speed[0] == speed[0] for speed in outside.speeds)


def drive_obstacle_cells(outside):
    outside.cells.publish(grid(4, 4, 1.0, count=3))
    outside.until("3 values")
    outside.until("3 values", "state")
    outside.cells.publish(grid(4, 4, 1.0, frame="mars"))
    outside.until("it is in frame 'mars', expected 'map'")
    outside.maps.publish(grid())
    bad_scans(outside, {})
    outside.until("a scan is ignored", "state", scan={"ranges": [1.0] * 7})


def drive_mapper(outside):
    bad_scans(outside, {})
    outside.until("cannot be used", "state", scan={"ranges": [1.0] * 7})
    outside.until("the odometry jumped", moved=400.0)


CASES = {
    "amcl": drive_amcl,
    "move_base": drive_move_base,
    "velocity_limiter": drive_velocity_limiter,
    "obstacle_cells": drive_obstacle_cells,
    "slam_gmapping": drive_mapper,
    "slam_graph": drive_mapper,
}
main()
