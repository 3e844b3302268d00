"""Bad input for an off-loaded robot's nodes, sent from its own graph: ``rce logs`` names each fault."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.engine import Program, running_engine
from support.owner import Owner

from rce.ros.core import Core
from rce.ros.node import Node, Publisher
from rce.ros.types import Time
from rce_fleet.turtlebot_wiring import offloaded_config
from rce_fleet.wiring import FLEET_CONTAINER, FleetAccount

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(500)]

WAIT_S = 150.0
BOX = "cTag_01"
BEAMS, STEP = 90, 0.07
PARAMETERS = {
    "/amcl/min_particles": -5,
    "/amcl/laser_z_hit": "much",
    "/amcl/laser_max_baems": 30,
    "/move_base/controller_frequency": 0.0,
    "/move_base/local_costmap/width": -4.0,
    "/obstacle_cells/sight": -1.0,
}
GRID = "nav_msgs/OccupancyGrid"
MORE_TOPICS = (
    ("/initialpose", "geometry_msgs/PoseWithCovarianceStamped"),
    ("/move_base_simple/goal", "geometry_msgs/PoseStamped"),
    ("/fleet/map", GRID),
)


def config_of(url: str) -> dict[str, Any]:
    """The config of an off-loaded robot without a fleet, with parameters that its nodes cannot use."""
    made = offloaded_config(1, FleetAccount(url=url), own_map=True)
    replaced = {*PARAMETERS, "/amcl/last_pose_timeout"}
    made["parameters"] = [each for each in made["parameters"] if each["name"] not in replaced]
    made["parameters"] += [{"cTag": BOX, "name": name, "value": value} for name, value in PARAMETERS.items()]
    made["bridges"] = [each for each in made["bridges"] if FLEET_CONTAINER not in json.dumps(each)]
    made["bridges"] += [
        {"topic": topic, "type": kind, "from": "robot", "to": BOX} for topic, kind in MORE_TOPICS
    ]
    return made


class Robot:
    """The robot's own graph: publishes good messages, and bad ones as the test says."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.at = 0.0
        self._publishers: dict[str, Publisher] = {}

    async def start(self) -> None:
        for name, kind in (
            ("/scan", "sensor_msgs/LaserScan"),
            ("/odom", "nav_msgs/Odometry"),
            ("/tf", "tf2_msgs/TFMessage"),
            ("/map", GRID),
            *MORE_TOPICS,
        ):
            self._publishers[name] = await self.node.advertise(name, kind, latch=kind == GRID)

    def publish(self, topic: str, **fields: Any) -> None:
        self._publishers[topic].publish(**fields)

    def map(self, topic: str = "/map", *, size: int = 40, resolution: float = 0.1, missing: int = 0) -> None:
        """Publish free floor with a wall in the lowest row."""
        data = [100] * size + [0] * (size * (size - 1) - missing)
        origin = {"orientation": {"w": 1.0}}
        info = {"resolution": resolution, "width": size, "height": size, "origin": origin}
        self.publish(topic, header={"frame_id": "map"}, info=info, data=data)

    def goal(self, x: float, y: float) -> None:
        header = {"frame_id": "map", "stamp": self.node.now()}
        pose = {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}
        self.publish("/move_base_simple/goal", header=header, pose=pose)

    def pose(self, frame: str) -> None:
        pose = {"position": {"x": 1.0, "y": 2.0}, "orientation": {"w": 1.0}}
        covariance = [0.01 if index % 7 == 0 else 0.0 for index in range(36)]
        self.publish(
            "/initialpose", header={"frame_id": frame}, pose={"pose": pose, "covariance": covariance}
        )

    def beat(self, *, x: float | None = None, late: float = 0.0, **scan: Any) -> None:
        """Publish odometry, frames and a scan; the arguments make them bad."""
        now = self.node.now()
        place = self.at if x is None else x
        self.publish(
            "/odom",
            header={"stamp": now, "frame_id": "odom"},
            child_frame_id="base_link",
            pose={"pose": {"position": {"x": place}, "orientation": {"w": 1.0}}},
        )
        edges = [
            {
                "header": {"stamp": now, "frame_id": parent},
                "child_frame_id": child,
                "transform": {"translation": {"x": shift}, "rotation": {"w": 1.0}},
            }
            for parent, child, shift in (("odom", "base_link", place), ("base_link", "laser", 0.0))
        ]
        self.publish("/tf", transforms=edges)
        whole = {
            "header": {"stamp": Time.from_sec(now.to_sec() - late), "frame_id": "laser"},
            "angle_min": -3.1,
            "angle_increment": STEP,
            "angle_max": -3.1 + STEP * (BEAMS - 1),
            "range_min": 0.1,
            "range_max": 8.0,
            "ranges": [2.0] * BEAMS,
        }
        self.publish("/scan", **{**whole, **scan})


class Logs:
    """Sends bad input until ``rce logs`` says what was wrong with it."""

    def __init__(self, owner: Owner) -> None:
        self._owner = owner

    async def say(self, node: str, *texts: str, send: Callable[[], None] = lambda: None) -> None:
        said, missing = "", list(texts)
        try:
            async with asyncio.timeout(WAIT_S):
                while missing:
                    for _ in range(10):
                        send()
                        await asyncio.sleep(0.1)
                    said = await self._owner.rce("logs", f"{BOX}/{node}")
                    missing = [text for text in missing if text not in said]
        except TimeoutError:
            pytest.fail(f"rce logs {BOX}/{node} does not say {missing}:\n{said}")


async def test_bad_input_from_a_robot_is_in_rce_logs(tmp_path: Path) -> None:
    """Each fault is named with what was expected, and the nodes live on: good input is used afterwards."""
    async with (
        running_engine() as engine,
        Core(port=0) as core,
        Node("hardware", argv=[], master_uri=core.uri, signals=False) as node,
    ):
        robot, owner = Robot(node), Owner(engine, "testUser")
        await robot.start()
        await owner.login()
        file = tmp_path / "robot.config"
        file.write_text(json.dumps(config_of(engine.url)))
        env = {**engine.env, "ROS_MASTER_URI": core.uri, "ROS_HOME": str(tmp_path)}
        bridge = Program("bridge", [str(Path(sys.executable).parent / "rce-ros"), str(file)], env, tmp_path)
        await bridge.start()
        try:
            await send_all(robot, Logs(owner))
        finally:
            await bridge.stop()


async def send_all(robot: Robot, logs: Logs) -> None:
    await logs.say("amcl", "min_particles", "laser_z_hit", "laser_max_beams")
    await logs.say("move_base", "controller_frequency", "local_costmap/width")
    await logs.say("obstacle_cells", "sight")

    robot.map(missing=7)
    robot.map("/fleet/map", size=4, resolution=1.0, missing=7)
    for name in ("amcl", "move_base"):
        await logs.say(name, "1593 values", send=robot.beat)
    await logs.say("obstacle_cells", "9 values", send=robot.beat)
    robot.map()
    robot.map("/fleet/map", size=4, resolution=1.0)
    await logs.say("amcl", "map of 40 x 40 cells", send=robot.beat)

    await logs.say("amcl", "initialpose is in frame 'odom', expected 'map'", send=lambda: robot.pose("odom"))
    await logs.say("amcl", "initial pose (1.000, 2.000, 0.000)", send=lambda: robot.pose("map"))
    faults: list[tuple[str, Callable[[], None]]] = [
        ("ranges", lambda: robot.beat(ranges=[1.0] * 7)),
        ("finite", lambda: robot.beat(angle_min=float("nan"))),
        ("in the future", lambda: robot.beat(late=-300.0)),
        ("old", lambda: robot.beat(late=300.0)),
    ]
    for text, send in faults:
        for name in ("amcl", "move_base", "obstacle_cells"):
            await logs.say(name, text, send=send)

    def beat() -> None:
        robot.at += 0.03
        robot.beat()

    await logs.say("amcl", "the odometry jumped", send=lambda: robot.beat(x=robot.at + 400.0))
    await logs.say("amcl", "the odometry jumped", send=beat)
    for x, y, text in ((2.0, 0.05, "is in an obstacle"), (50.0, 50.0, "is off the costmap")):
        robot.goal(x, y)
        await logs.say("move_base", text, send=beat)
