"""``rce sim``: its ROS graphs, services, clock and errors, from outside."""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from xmlrpc.client import ServerProxy

import pytest
from support.engine import Program, until
from support.ports import free_port

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import TransformListener
from rce.ros.types import Message, TypeRegistry
from rce_fleet.drivers.program import Cores, RunOptions, Simulation
from rce_fleet.drivers.scene import RobotStart, Scene
from rce_fleet.exceptions import FleetError

pytestmark = pytest.mark.needs("pymunk")

SCENE = """
doors: [{id: door, at: [6, 6]}]
robots:
  - {id: Robot1, at: [1, 1], model: turtlebot2, sensor: lidar}
"""
RCE = (sys.executable, "-c", "from rce.cli import main; main()")
FREE_PORTS = ("--core-port", "0", "--world-port", "0")


class RunningSim:
    """A program ``rce sim``."""

    def __init__(self, program: Program) -> None:
        self._program = program

    def uri(self, whose: str) -> str:
        """The ROS master of a robot, or of the world."""
        found = [line for line in self._program.output().splitlines() if line.startswith(f"{whose} ")]
        return found[-1].split("ROS_MASTER_URI=")[1]

    def node(self, whose: str) -> Node:
        """A node in one of its graphs."""
        return Node("t", argv=(), master_uri=self.uri(whose), signals=False)


@asynccontextmanager
async def sim(folder: Path, *options: str, scene: str = SCENE) -> AsyncIterator[RunningSim]:
    (folder / "scene.yaml").write_text(scene)
    argv = [*RCE, "sim", str(folder / "scene.yaml"), *FREE_PORTS, *options]
    program = Program("sim", argv, dict(os.environ), folder)
    await program.start(ready="simulation ready:")
    try:
        yield RunningSim(program)
    finally:
        assert await program.stop() == 0


async def one(node: Node, topic: str, message_type: str) -> Message:
    messages = await node.subscribe(topic, message_type)
    async with asyncio.timeout(30):
        async for message in messages:
            return message
    raise AssertionError(topic)


async def test_a_robot_of_sensors_and_wheels_only(tmp_path: Path) -> None:
    """The topics of a TurtleBot; commands move it and end by themselves."""
    async with sim(tmp_path, "--no-stand-ins") as running, running.node("robot Robot1") as node:
        scan = await one(node, "/scan", "sensor_msgs/LaserScan")
        assert (len(scan.ranges), scan.header.frame_id) == (360, "base_scan")
        battery = await one(node, "/battery_state", "sensor_msgs/BatteryState")
        assert 0.9 < battery.percentage <= 1.0
        assert (await one(node, "/diagnostics", "diagnostic_msgs/DiagnosticArray")).status
        async with TransformListener(node) as tf:
            place = await tf.wait_for("odom", "base_scan", timeout=30)
            assert place.transform.translation.z == pytest.approx(0.18)
        commands = await node.advertise("/cmd_vel", "geometry_msgs/Twist")
        await commands.wait_for_subscribers(1, timeout=30)
        truths = await node.subscribe("/ground_truth/pose", "nav_msgs/Odometry")
        commands.publish(linear={"x": float("nan")})
        commands.publish(linear={"x": 0.5})
        moved = False
        async with asyncio.timeout(60):
            async for truth in truths:
                moved = moved or truth.twist.twist.linear.x > 0.1
                if moved and truth.twist.twist.linear.x == 0.0:
                    break
        assert 1.1 < truth.pose.pose.position.x < 1.6, "it stops without new commands"
        with ServerProxy(running.uri("robot Robot1")) as core:
            topics = await asyncio.to_thread(core.getPublishedTopics, "/t", "")
        assert "/amcl_pose" not in str(topics)


async def test_simulated_time_stands_still_and_steps(tmp_path: Path) -> None:
    """A paused world steps by requests; nodes' time is that of /clock."""
    async with (
        sim(tmp_path, "--factor", "5") as running,
        running.node("world") as world,
        running.node("robot Robot1") as robot,
    ):
        assert robot.is_time_simulated
        assert world.is_time_simulated
        await robot.sleep(1.0)
        assert robot.time() >= 1.0
        await world.service_client("/gazebo/pause_physics", "std_srvs/Empty")()
        step = world.service_client("/simulation/step", "fleet/StepWorld")
        before = (await step(seconds=0.0)).time
        answer = await step(seconds=2.0)
        assert (answer.ok, answer.time) == (True, pytest.approx(before + 2.0))
        await until(lambda: robot.time() == pytest.approx(answer.time), timeout=30, what="the clock")
        assert not (await step(seconds=-1.0)).ok
        await world.service_client("/gazebo/reset_simulation", "std_srvs/Empty")()
        await world.service_client("/gazebo/unpause_physics", "std_srvs/Empty")()
        assert "pause the world" in (await step(seconds=1.0)).message
        await until(lambda: 0 < robot.time() < before + 1.0, timeout=30, what="time begins anew")


async def test_things_come_move_and_go_by_services(tmp_path: Path) -> None:
    async with sim(tmp_path) as running, running.node("world") as node:
        spawn = node.service_client("/gazebo/spawn_sdf_model", "gazebo_msgs/SpawnModel")
        move = node.service_client("/gazebo/set_model_state", "gazebo_msgs/SetModelState")
        state = node.service_client("/gazebo/get_model_state", "gazebo_msgs/GetModelState")
        remove = node.service_client("/gazebo/delete_model", "gazebo_msgs/DeleteModel")
        place = {"position": {"x": 3.0, "y": 3.0}, "orientation": {"w": 1.0}}
        assert (await spawn(model_name="b", model_xml="{box: [0.5, 0.5]}", initial_pose=place)).success
        taken = await spawn(model_name="R", model_xml="{robot: turtlebot2}", initial_pose=place)
        assert not taken.success
        assert "nearer to a wall or box" in taken.status_message
        place["position"] = {"x": 5.0, "y": 2.0}
        made = await spawn(model_name="R", model_xml="{robot: turtlebot2}", initial_pose=place)
        assert made.success, made.status_message
        assert running.uri("robot R") in made.status_message
        async with running.node("robot R") as robot:
            assert len((await one(robot, "/scan", "sensor_msgs/LaserScan")).ranges) == 640
        for name, xml, words in (
            ("R", "{robot: disc}", "exists already"),
            ("S", "<sdf/>", "not XML"),
            ("S", "{robot: boat}", "no robot model 'boat'"),
            ("S", "{boxes: 3}", "boxes"),
            ("S", "{}", "either a robot's model, a box or a walker"),
            ("cell_7", "{box: [0.5, 0.5]}", "boxes in cells are"),
        ):
            answer = await spawn(model_name=name, model_xml=xml, initial_pose=place)
            assert not answer.success
            assert words in answer.status_message
        place["position"] = {"x": 6.0, "y": 4.0}
        assert (await move(model_state={"model_name": "R", "pose": place})).success
        assert (await state(model_name="R")).pose.position.x == pytest.approx(6.0)
        assert "there is no 'nothing'" in (await remove(model_name="nothing")).status_message
        fast = {"linear": {"x": float("nan")}}
        answer = await move(model_state={"model_name": "R", "pose": place, "twist": fast})
        assert "the speeds must be finite" in answer.status_message
        place["position"] = {"x": 3.0, "y": 3.0}
        answer = await move(model_state={"model_name": "R", "pose": place})
        assert (answer.success, "a wall, box or door" in answer.status_message) == (False, True)
        for name in ("R", "b"):
            assert (await remove(model_name=name)).success
        world = await node.service_client("/gazebo/get_world_properties", "gazebo_msgs/GetWorldProperties")()
        assert list(world.model_names) == ["Robot1", "door"]
        assert (await node.service_client("/simulation/doors/door", "std_srvs/SetBool")(data=True)).success


@pytest.mark.needs("rospy")
async def test_real_rosservice_pauses_the_world(tmp_path: Path) -> None:
    rosservice = shutil.which("rosservice")
    assert rosservice is not None
    async with sim(tmp_path, "--clock") as running, running.node("world") as node:
        environ = {**os.environ, "ROS_MASTER_URI": running.uri("world")}
        call = [rosservice, "call", "/gazebo/pause_physics"]
        process = await asyncio.create_subprocess_exec(*call, env=environ)
        assert await asyncio.wait_for(process.wait(), 60) == 0
        step = node.service_client("/simulation/step", "fleet/StepWorld")
        first = (await step(seconds=0.5)).time
        assert (await step(seconds=0.5)).time == pytest.approx(first + 0.5), "it stands between the two"


async def test_a_killed_world_comes_back_for_its_listeners(tmp_path: Path) -> None:
    """A world that was killed starts again on its ports; nodes of the robot's graph find it again."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    ports = ("--core-port", str(free_port()), "--world-port", "0")
    argv = [*RCE, "sim", str(tmp_path / "scene.yaml"), *ports]
    first = Program("first", argv, dict(os.environ), tmp_path)
    await first.start(ready="simulation ready:")
    second = Program("second", argv, dict(os.environ), tmp_path)
    try:
        async with RunningSim(first).node("robot Robot1") as node:
            scans = await node.subscribe("/scan", "sensor_msgs/LaserScan")
            async with asyncio.timeout(60):
                await anext(aiter(scans))
            await first.kill()
            await second.start(ready="simulation ready:")
            begun = node.now()
            async with asyncio.timeout(90):
                async for scan in scans:
                    if scan.header.stamp > begun:
                        break
        assert await second.stop() == 0
    finally:
        for program in (first, second):
            if program.running:
                await program.kill()


@pytest.mark.parametrize(
    ("options", "scene", "code", "words"),
    [
        ((), "rows: 0", 2, b"scene.yaml: rows"),
        ((), "robots: [{id: R, at: [0, 0]}]", 2, b"robots[0]"),
        (("--factor", "-1"), SCENE, 2, b"0 or more"),
        (("--core", "http://127.0.0.1:1/"), SCENE, 1, b"127.0.0.1:1"),
        (("--core-port", "99999"), SCENE, 2, b"Invalid value for '--core-port'"),
    ],
    ids=["bad scene", "no room", "bad factor", "no master", "no port"],
)
async def test_wrong_input_ends_the_program(
    tmp_path: Path, options: tuple[str, ...], scene: str, code: int, words: bytes
) -> None:
    (tmp_path / "scene.yaml").write_text(scene)
    process = await asyncio.create_subprocess_exec(
        *(*RCE, "sim", str(tmp_path / "scene.yaml"), *FREE_PORTS, *options),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    output, _ = await asyncio.wait_for(process.communicate(), 120)
    assert process.returncode == code, output.decode()
    assert words in output
    assert b"Traceback" not in output


async def test_a_port_in_use_is_named(tmp_path: Path) -> None:
    async with sim(tmp_path) as running:
        port = running.uri("robot Robot1").rstrip("/").rpartition(":")[2]
        argv = [*RCE, "sim", str(tmp_path / "scene.yaml"), "--core-port", port, "--world-port", "0"]
        process = await asyncio.create_subprocess_exec(*argv, stderr=asyncio.subprocess.PIPE)
        _, said = await asyncio.wait_for(process.communicate(), 120)
        assert process.returncode == 1
        assert f"port {port}".encode() in said


@asynccontextmanager
async def empty_world() -> AsyncIterator[Simulation]:
    """A simulation in this process, without robots until some are put in."""
    said: list[str] = []
    simulation = Simulation(Scene(), TypeRegistry(), said.append)
    stop = asyncio.Event()
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(simulation.run(stop))
        await until(lambda: "simulation ready: 0 robots, 0 boxes" in said, timeout=60, what="the world runs")
        yield simulation
        stop.set()


async def test_a_robot_whose_port_is_taken_is_not_left_in_the_world(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It stood there without a node, and the request had no answer."""
    start = RobotStart(id="R", at=(3.0, 3.0))
    async with empty_world() as simulation:
        with socket.create_server(("", 0)) as taken, monkeypatch.context() as patch:
            port = taken.getsockname()[1]
            patch.setattr(simulation, "_next_port", lambda: port)
            with pytest.raises(FleetError, match=f"R was not put in: .* port {port}"):
                await simulation.add_robot(start)
        assert dict(simulation.world.robots) == {}
        await simulation.add_robot(start)
        await asyncio.gather(simulation.remove_robot("R"), simulation.remove_robot("R"))
        assert dict(simulation.world.robots) == {}


async def test_a_robot_whose_request_is_cancelled_is_not_left_in_the_world() -> None:
    start = RobotStart(id="R", at=(3.0, 3.0))
    async with empty_world() as simulation:
        request = asyncio.create_task(simulation.add_robot(start))
        while "R" not in simulation.world.robots:  # its node starts then
            await asyncio.sleep(0)
        request.cancel()
        with pytest.raises(asyncio.CancelledError):
            await request
        assert dict(simulation.world.robots) == {}
        await simulation.add_robot(start)


async def test_light_robots_bring_the_clock_to_a_core_that_runs() -> None:
    scene = Scene.model_validate({"light_robots": [{"id": "Robot1", "cell": 9}]})
    stop, said = asyncio.Event(), list[str]()
    async with Core(port=0) as core, asyncio.TaskGroup() as tasks:
        options = RunOptions(clock=True)
        simulation = Simulation(scene, TypeRegistry(), said.append, cores=Cores(core.uri), options=options)
        tasks.create_task(simulation.run(stop))
        await until(lambda: "simulation ready: 1 robots, 0 boxes" in said, timeout=60, what="it runs")
        async with Node("t", argv=(), master_uri=core.uri, signals=False) as node:
            assert await node.get_param("/use_sim_time") is True
            await until(lambda: node.now().to_sec() > 0, timeout=60, what="the world's clock is heard")
        stop.set()


async def test_a_report_that_cannot_be_written_does_not_end_the_world(tmp_path: Path) -> None:
    """A full disk did; the user is told once."""
    report = tmp_path / "report" / "world.json"
    said: list[str] = []
    simulation = Simulation(Scene(), TypeRegistry(), said.append, report=report)
    stop = asyncio.Event()
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(simulation.run(stop))
        await until(lambda: bool(said) and simulation.world.time > 1.2, timeout=60, what="two reports")
        report.parent.mkdir()
        await until(report.exists, timeout=60, what="a report")
        stop.set()
    assert [line for line in said if "cannot be written" in line] == [
        f"simulation: the report {report} cannot be written: No such file or directory"
    ]
