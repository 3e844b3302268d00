"""The robots of a demo: where each one's ROS graph is, and what runs on it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

from rce.config import configs_dir
from rce.ros.tf import frames
from rce_fleet.demo.programs import Program, ProgramGroup, rce_command
from rce_fleet.demo.resources import LOOPBACK
from rce_fleet.geometry.poses import Pose
from rce_fleet.turtlebot_wiring import LAUNCH_FILE, offloaded_config, onboard_config

if TYPE_CHECKING:
    from rce_fleet.demo.config import DemoConfig

DOCK_VARIANCE = 0.05**2
"""How well a robot stands at its dock: square metres, square radians."""


@dataclass(frozen=True, slots=True)
class RobotGraph:
    """Where a robot's nodes are.

    Attributes:
        robot: The robot's name.
        uri: URI of the ROS master.
        prefix: Namespace of its nodes and prefix of its frames; empty if no other robot uses the master.
        host: Words before each program's command that run it on the robot's machine.
        offloaded: Whether localization and navigation run in its container: its graph has no frame ``map``.
    """

    robot: str
    uri: str
    prefix: str = ""
    host: tuple[str, ...] = ()
    offloaded: bool = False

    def topic(self, name: str) -> str:
        """Return the global name of a topic of the robot."""
        return f"/{self.prefix}/{name}" if self.prefix else f"/{name}"

    def frame(self, name: str) -> str:
        """Return the name of a frame of the robot."""
        return frames.resolve(self.prefix, name)


def environment(config: DemoConfig, uri: str) -> dict[str, str]:
    """Return the variables of nodes on the machine of a ROS master.

    Inner loops run in numpy: to load the compiled ones takes a robot longer than they save in a demo.
    """
    return {
        "ROS_MASTER_URI": uri,
        "ROS_NAMESPACE": "",
        "ROS_IP": urlsplit(uri).hostname or LOOPBACK,
        "ROS_HOME": str(config.folder / "ros"),
        "RCE_COMPILED": os.environ.get("RCE_COMPILED", "no"),
    }


class RobotGraphs(Protocol):
    """Knows the robots' graphs, and how their launch files are started there."""

    def graphs(self) -> Sequence[RobotGraph]:
        """Return where the nodes of each robot are."""

    def launch_arguments(self, graph: RobotGraph) -> Mapping[str, object]:
        """Return the arguments of the launch file of a robot's nodes."""


async def start_robots(
    group: ProgramGroup,
    config: DemoConfig,
    robots: RobotGraphs,
    more: Mapping[str, Mapping[str, object]] | None = None,
) -> None:
    """Start the nodes of all robots.

    Args:
        group: Gets the programs.
        config: What the demo runs.
        robots: Where they are.
        more: More arguments of the launch files, by robot.
    """
    for graph in robots.graphs():
        arguments = {**robots.launch_arguments(graph), **(more or {}).get(graph.robot, {})}
        await start_robot(group, config, graph, dock_of(config, graph.robot), arguments)


async def start_robot(
    group: ProgramGroup, config: DemoConfig, graph: RobotGraph, at: Pose, arguments: Mapping[str, object]
) -> Program:
    """Start the nodes of a robot: its launch file, in one process.

    A robot that is started again localizes from the pose that it stored last.

    Args:
        group: Gets the program.
        config: What the demo runs.
        graph: Where the robot's nodes are.
        at: Where the robot stands.
        arguments: More arguments of the launch file.
    """
    argv = [*graph.host, *launch_argv(config, at, arguments)]
    return await group.start(
        f"nodes-{graph.robot}",
        argv,
        env=environment(config, graph.uri),
        restartable=True,
        again=[*argv, "stored_pose:=true"],
        again_after=": started",  # before that, the launch has set no parameters
    )


def launch_argv(config: DemoConfig, at: Pose, arguments: Mapping[str, object]) -> list[str]:
    """Return the command that starts the nodes of a robot.

    Args:
        config: What the demo runs.
        at: Where the robot stands.
        arguments: More arguments of the launch file.
    """
    given = {"map": config.map_file, **initial_pose(at), **arguments}
    words = (f"{name}:={value}" for name, value in given.items())
    options = ("--one-process", "--wait", "--no-log", "--screen")
    return [*rce_command("launch"), *options, str(configs_dir() / LAUNCH_FILE), *words]


def client_config(config: DemoConfig, number: int, at: Pose) -> Mapping[str, Any]:
    """Return the config with which ``rce-ros`` connects a robot to the engine.

    Args:
        config: What the demo runs.
        number: Of the robot, counted from 1.
        at: Where the robot stands.
    """
    if not config.offload:
        return onboard_config(number, config.account)
    made = offloaded_config(number, config.account, launch_arguments=initial_pose(at), own_map=True)
    (container,) = made["containers"]
    # The judge hears of recoveries here.
    diagnostics = {"topic": "/diagnostics", "type": "diagnostic_msgs/DiagnosticArray"}
    made["bridges"].append({**diagnostics, "from": container["cTag"], "to": "robot"})
    return made


def cloud_arguments(config: DemoConfig, robot: str) -> dict[str, object]:
    """Return the launch file's arguments for a robot of the mode ``cloud``."""
    return {"offload": True, "own_map": True} if config.offload else {"robot": robot, "relay": False}


def dock_of(config: DemoConfig, robot: str) -> Pose:
    """Return where a robot of the scenario stands at the start."""
    scenario = config.scenario
    index = scenario.robots.index(robot)
    return Pose(*scenario.grid.centre(scenario.starts[index]), scenario.headings[index])


def initial_pose(at: Pose) -> dict[str, float]:
    """Return the launch file's arguments for a robot whose place at the start is known."""
    pose = {"initial_pose_x": at.x, "initial_pose_y": at.y, "initial_pose_a": at.yaw}
    return {**pose, **dict.fromkeys(("initial_cov_xx", "initial_cov_yy", "initial_cov_aa"), DOCK_VARIANCE)}
