"""The nodes of a robot's task on the robot, or in its container in the cloud: one launch file, wired twice.

The simulated hardware of the robot with its ROS core runs on the client too, but does not count as a program
of it: the client's share of a core and its meter are those of the robot's netbook.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import yaml

from rce.config.folders import configs_dir
from rce_fleet.compiled import COMPILED
from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, POLL_S
from rce_fleet.experiments.systems.base import core_uri
from rce_fleet.experiments.task_judge import ROBOT_NAME, WORLD_PORT
from rce_fleet.experiments.workloads.telling import reports
from rce_fleet.turtlebot_wiring import moved_nodes

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from rce_fleet.experiments.bench import Bench, Program
    from rce_fleet.experiments.systems.cloud import Cloud

ROBOT, CLOUD = "robot", "cloud"
NAVIGATION, MAPPING = "navigation", "mapping"
RETURN = "return"
"""The robot is put where it began, and ``amcl`` is told so."""
LAUNCH_FILE = "turtlebot/tasks.launch"
CONTAINER = "box"
NUMPY = {COMPILED: "no"}
"""Environment of the nodes on the robot: loops that can be compiled run in numpy, as they do in the cloud."""
PACKAGE = "numpy_nodes"
"""Package of a container's nodes: the same ones, with that environment, which a container cannot be given."""
NODES = ("map_server", "amcl", "move_base", "slam_gmapping")
_SCRIPT = """\
import os
import runpy

os.environ.update({environ})
runpy.run_module("rce_fleet.nodes.{name}", run_name="__main__", alter_sys=True)
"""
LOCAL = "127.0.0.1"
_POSE = "geometry_msgs/PoseWithCovarianceStamped"
UP = (
    ("/scan", "sensor_msgs/LaserScan"),
    ("/odom", "nav_msgs/Odometry"),
    ("/tf", "tf2_msgs/TFMessage"),
    ("/tf_static", "tf2_msgs/TFMessage"),
)
"""What the robot sends to its container for each task; those of navigation get goals and initial poses."""
UP_FOR = {
    NAVIGATION: (
        ("/move_base_simple/goal", "geometry_msgs/PoseStamped"),
        ("/move_base/cancel", "actionlib_msgs/GoalID"),
        ("/initialpose", _POSE),
    ),
    MAPPING: (),
}
DOWN_FOR = {
    NAVIGATION: (
        ("/raw_cmd_vel", "geometry_msgs/Twist"),
        ("/move_base/stamped_cmd_vel", "geometry_msgs/TwistStamped"),
        ("/amcl_pose", _POSE),
    ),
    MAPPING: (("/pose", _POSE),),
}
"""What it gets. The stamped velocities say of which scan they were made."""


class TaskRobot:
    """A robot on the client of a bench, with the judge of its tasks.

    Args:
        bench: The machines.
        start: Where it begins on the demo's floor, looking along x; metres.
    """

    def __init__(self, bench: Bench, start: tuple[float, float]) -> None:
        self._bench = bench
        self._start = start
        self._orders = bench.folder / "orders.jsonl"
        self._given = 0
        self._judge: Program
        self._nodes: list[Program] = []

    async def start(self) -> None:
        """Start its hardware, and the judge.

        Raises:
            ExperimentError: A program does not start.
        """
        bench = self._bench
        scene = bench.folder / "scene.json"
        scene.write_text(json.dumps(scene_of_one_robot(self._start)))
        ports = ("--core-port", core_uri(LOCAL).rsplit(":", 1)[1].strip("/"), "--world-port", str(WORLD_PORT))
        simulation = ("rce", "sim", str(scene), "--no-stand-ins", *ports)
        await bench.start(CLIENT, "hardware", simulation, ready="simulation ready", is_metered=False)
        judge = (sys.executable, "-m", "rce_fleet.experiments.task_judge", "--orders", str(self._orders))
        self._judge = await bench.start(
            CLIENT, "judge", judge, environ=self._environ, ready="ready", is_metered=False
        )

    async def start_nodes(self, task: str, cloud: Cloud | None) -> None:
        """Start the nodes for a task; those of another one must have ended.

        Args:
            task: ``navigation`` or ``mapping``.
            cloud: Where they run, but for safety; None: on the robot.

        Raises:
            ExperimentError: A program does not start.
        """
        words = {**arguments_of(task, self._start), **({} if cloud is None else {"offload": "true"})}
        argv = ("rce", "launch", str(configs_dir() / LAUNCH_FILE), *(f"{k}:={v}" for k, v in words.items()))
        environ = {**self._environ, **NUMPY}
        self._nodes.append(await self._bench.start(CLIENT, f"nodes-{task}", argv, environ=environ))
        if cloud is not None:
            config = config_of(task, cloud.account(f"robot_{task}"), self._start)
            self._nodes.append(await cloud.start_agent(CLIENT, f"robot_{task}", config, core=LOCAL))

    async def end_nodes(self) -> None:
        """End the nodes of a task; its container ends with its agent."""
        while self._nodes:
            await self._bench.end(self._nodes.pop())

    async def do(self, task: str, patience: float, **order: float) -> dict[str, Any]:
        """Have a task done, and return what the judge tells of it.

        Args:
            task: See :meth:`rce_fleet.experiments.task_judge.Judge.do`.
            patience: How long it may take, seconds.
            order: What belongs to the task.

        Raises:
            ExperimentError: A program ended, or the judge told nothing.
        """
        self._given += 1
        number = self._given
        with self._orders.open("a") as file:
            file.write(json.dumps({"number": number, "task": task, "patience": patience, **order}) + "\n")
        found: list[dict[str, Any]] = []

        def is_told() -> bool:
            found[:] = (one for one in reports(self._judge.lines()) if one.get("number") == number)
            return bool(found)

        await self._bench.wait_until(
            is_told,
            lambda: f"the judge told nothing of {task}:{self._judge.tail()}",
            timeout=3 * patience + 10 * POLL_S,
        )
        return found[0]

    async def wait_ready(self, task: str, patience: float, **order: float) -> None:
        """Wait until the nodes for a task do what they are for.

        Raises:
            ExperimentError: They do not in time.
        """
        if not (await self.do(f"await_{task}", patience, **order))["success"]:
            logs = "".join(program.tail() for program in self._nodes)
            raise ExperimentError(f"the nodes for {task} were not ready within {patience:g} s:{logs}")

    @property
    def _environ(self) -> dict[str, str]:
        return {"ROS_MASTER_URI": core_uri(LOCAL)}


def scene_of_one_robot(start: tuple[float, float]) -> dict[str, Any]:
    """Return the demo's floor with one robot, which begins somewhere."""
    scene: dict[str, Any] = yaml.safe_load((configs_dir() / "scene.yaml").read_text(encoding="utf-8"))
    scene["robots"] = [{"id": ROBOT_NAME, "at": list(start), "sensor": "lidar"}]
    return scene


def arguments_of(task: str, start: tuple[float, float]) -> dict[str, str]:
    """Return the arguments of the launch file for a task of a robot that begins somewhere."""
    return {"task": task, "initial_pose_x": str(start[0]), "initial_pose_y": str(start[1])}


def config_of(task: str, account: Mapping[str, Any], start: tuple[float, float]) -> dict[str, Any]:
    """Return the config of a robot whose nodes for a task run in its container, but for safety.

    Args:
        task: ``navigation`` or ``mapping``.
        account: Where and as whom it logs in.
        start: Where the robot begins, metres.
    """
    nodes, parameters = moved_nodes(CONTAINER, arguments_of(task, start), file=LAUNCH_FILE)
    nodes = [{**node, "pkg": PACKAGE, "exe": f"{node['exe']}.py"} for node in nodes]
    bridges: list[dict[str, str]] = [
        *(_topic(name, kind, "robot", CONTAINER) for name, kind in (*UP, *UP_FOR[task])),
        *(_topic(name, kind, CONTAINER, "robot") for name, kind in DOWN_FOR[task]),
    ]
    if task == NAVIGATION:
        plan = {"service": "/move_base/make_plan", "type": "nav_msgs/GetPlan"}
        bridges.append({**plan, "server": CONTAINER, "clients": "robot"})
    return {
        **account,
        "containers": [{"cTag": CONTAINER}],
        "nodes": nodes,
        "bridges": bridges,
        "parameters": parameters,
    }


def write_packages(folder: Path) -> Path:
    """Write the package of the nodes that run in a container.

    Args:
        folder: Gets a folder with packages.

    Returns:
        The folder with packages.
    """
    packages = folder / "packages"
    package = packages / PACKAGE
    package.mkdir(parents=True)
    (package / "package.yaml").write_text(f"name: {PACKAGE}\n")
    for name in NODES:
        script = package / f"{name}.py"
        script.write_text(_SCRIPT.format(environ=NUMPY, name=name))
        script.chmod(0o755)
    return packages


def _topic(name: str, kind: str, source: str, target: str) -> dict[str, str]:
    return {"topic": name, "type": kind, "from": source, "to": target}
