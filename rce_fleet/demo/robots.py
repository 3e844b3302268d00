"""The robots of a demo: where each one's ROS graph is, and what runs on it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

from rce.config import configs_dir
from rce.ros.tf import frames
from rce_fleet.demo.programs import Program, ProgramGroup, rce_command
from rce_fleet.demo.resources import LOOPBACK
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
        await start_robot(group, config, graph, arguments)


async def start_robot(
    group: ProgramGroup, config: DemoConfig, graph: RobotGraph, arguments: Mapping[str, object]
) -> Program:
    """Start the nodes of a robot: its launch file, in one process.

    A robot that is started again localizes from the pose that it stored last.

    Args:
        group: Gets the program.
        config: What the demo runs.
        graph: Where the robot's nodes are.
        arguments: More arguments of the launch file.
    """
    argv = [*graph.host, *launch_argv(config, graph.robot, arguments)]
    return await group.start(
        f"nodes-{graph.robot}",
        argv,
        env=environment(config, graph.uri),
        restartable=True,
        again=[*argv, "stored_pose:=true"],
        again_after=": started",  # before that, the launch has set no parameters
    )


def launch_argv(config: DemoConfig, robot: str, arguments: Mapping[str, object]) -> list[str]:
    """Return the command that starts the nodes of a robot.

    Args:
        config: What the demo runs.
        robot: Name of the robot.
        arguments: More arguments of the launch file.
    """
    given = {"map": config.map_file, **dict(_initial_pose(config, robot)), **arguments}
    words = (f"{name}:={value}" for name, value in given.items())
    options = ("--one-process", "--wait", "--no-log", "--screen")
    return [*rce_command("launch"), *options, str(configs_dir() / LAUNCH_FILE), *words]


def client_config(config: DemoConfig, number: int) -> Mapping[str, Any]:
    """Return the config with which ``rce-ros`` connects a robot to the engine; robots count from 1."""
    if not config.offload:
        return onboard_config(number, config.account)
    robot = config.scenario.robots[number - 1]
    made = offloaded_config(
        number, config.account, launch_arguments=dict(_initial_pose(config, robot)), own_map=True
    )
    (container,) = made["containers"]
    # The judge hears of recoveries here.
    diagnostics = {"topic": "/diagnostics", "type": "diagnostic_msgs/DiagnosticArray"}
    made["bridges"].append({**diagnostics, "from": container["cTag"], "to": "robot"})
    return made


def cloud_arguments(config: DemoConfig, robot: str) -> dict[str, object]:
    """Return the launch file's arguments for a robot of the mode ``cloud``."""
    return {"offload": True, "own_map": True} if config.offload else {"robot": robot, "relay": False}


def _initial_pose(config: DemoConfig, robot: str) -> Iterator[tuple[str, float]]:
    """Return where the robot stands at the start: its dock, which is known."""
    scenario = config.scenario
    index = scenario.robots.index(robot)
    x, y = scenario.grid.centre(scenario.starts[index])
    yield "initial_pose_x", x
    yield "initial_pose_y", y
    yield "initial_pose_a", scenario.headings[index]
    yield "initial_cov_xx", DOCK_VARIANCE
    yield "initial_cov_yy", DOCK_VARIANCE
    yield "initial_cov_aa", DOCK_VARIANCE
