"""Latched topics of real ROS nodes stay latched across the engine, in both directions, whatever restarts."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import pytest_asyncio
from support.engine import Engine, Program, command_line, running_engine, until
from support.ros_real import Graph, real_graph
from support.stranger import Stranger, stranger

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.timeout(400),
    pytest.mark.needs("rospy", "roslaunch"),
    pytest.mark.asyncio(loop_scope="module"),
]

STRING = "std_msgs/String"
LATCHER = """#!/usr/bin/python3
import sys
import rospy
from std_msgs.msg import String

name, topic, text = sys.argv[1:4]
rospy.init_node(name)
publisher = rospy.Publisher(topic, String, queue_size=1, latch=True)
publisher.publish(text)
rospy.spin()
"""
LISTENER = """#!/usr/bin/python3
import sys
import rospy
from std_msgs.msg import String

topic, count = sys.argv[1], int(sys.argv[2])
heard = set()
rospy.init_node("late", anonymous=True)
answers = rospy.Publisher("/heard", String, queue_size=1, latch=True)
rospy.Subscriber(topic, String, lambda message: heard.add(message.data))
while len(heard) < count:
    rospy.sleep(0.05)
rospy.sleep(0.5)  # what else is latched has come with it
text = "heard " + ",".join(sorted(heard))
print(text, flush=True)
answers.publish(text)
rospy.spin()
"""


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package of rospy nodes that latch, for containers; the same programs are run in robots' graphs."""
    package = tmp_path_factory.mktemp("packages") / "latches"
    scripts = package / "scripts"
    scripts.mkdir(parents=True)
    package.joinpath("package.xml").write_text("<package><name>latches</name></package>")
    for name, text in (("latcher.py", LATCHER), ("listener.py", LISTENER)):
        node = scripts / name
        node.write_text(text)
        node.chmod(0o755)
    return package.parent


def latching(name: str) -> dict[str, Any]:
    """A node of the container that latches a text on ``/map``."""
    return {
        "containerTag": "box",
        "nodeTag": name,
        "pkg": "latches",
        "exe": "latcher.py",
        "restart": "always",
        "args": f"{name} /map {name}_says",
    }


def config(engine: Engine, robot: str) -> dict[str, Any]:
    """A container with two latching nodes on one topic, and a robot that bridges both directions."""
    down = [("map", "SubscriberInterface", "PublisherForwarder")]
    up = [("pose", "PublisherInterface", "SubscriberForwarder")]
    interfaces = [
        {"eTag": endpoint, "iTag": tag, "iType": kind, "iCls": STRING, "addr": f"/{tag}"}
        for tag, box, own in (*down, *up)
        for endpoint, kind in (("box", box), (robot, own))
    ]
    nodes = [
        {"cTag": node.pop("containerTag"), "nTag": node.pop("nodeTag"), **node}
        for node in (latching("one"), latching("two"))
    ]
    return {
        "url": engine.url,
        "userID": "testUser",
        "password": "testUser",
        "robotID": robot,
        "containers": [{"cTag": "box"}],
        "nodes": nodes,
        "interfaces": interfaces,
        "connections": [{"tagA": f"{robot}/{tag}", "tagB": f"box/{tag}"} for tag in ("map", "pose")],
    }


def bridge_of(engine: Engine, graph: Graph, file: Path) -> Program:
    program = str(Path(sys.executable).parent / "rce-ros")
    return Program(
        f"rce-ros-{file.stem}",
        [program, str(file)],
        {**engine.env, "ROS_MASTER_URI": graph.uri},
        engine.folder,
    )


class World:
    """An engine, a robot with a real ROS graph, and a bridge."""

    def __init__(self, engine: Engine, graph: Graph, bridge: Program, packages: Path) -> None:
        self.engine = engine
        self.graph = graph
        self.bridge = bridge
        self.packages = packages

    async def late(self, topic: str, *texts: str) -> None:
        """A node that subscribes now in the robot's graph hears all of this."""
        listener = str(self.packages / "latches" / "scripts" / "listener.py")
        expected = f"heard {','.join(sorted(texts))}\n"
        await self.graph.says(listener, topic, str(len(texts)), text=expected)

    def nodes(self, name: str) -> list[Any]:
        return [p for p in self.engine.processes_of("latcher.py") if name in command_line(p)]


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_engine(packages: Path, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[World]:
    """All of it, for all tests: each leaves it as it found it."""
    folder = tmp_path_factory.mktemp("robot")
    async with running_engine(packages=packages) as engine, real_graph(folder) as graph:
        file = folder / "robot.config"
        file.write_text(json.dumps(config(engine, "R1")))
        bridge = bridge_of(engine, graph, file)
        await bridge.start(timeout=90)
        try:
            yield World(engine, graph, bridge, packages)
        except BaseException:
            print(bridge.output())  # noqa: T201
            raise
        finally:
            await bridge.stop()


@pytest.fixture
def it(shared_engine: World) -> World:
    return shared_engine


async def test_latched_in_the_cloud_is_latched_at_the_robot(it: World) -> None:
    """One message per publisher, over the restart of each part between them."""
    everything = ("one_says", "two_says")
    await it.late("/map", *everything)

    for process in it.nodes("one"):
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    await it.late("/map", *everything)

    for part in (*it.engine.robots, it.engine.container, it.engine.master):
        await part.kill()
        await part.start()
        await it.late("/map", *everything)

    it.engine.kill_processes("rce_container.environment")
    await it.late("/map", *everything)

    await it.bridge.kill()
    await it.bridge.start(timeout=90)
    await it.late("/map", *everything)


async def test_a_publisher_that_ends_takes_its_message_back(it: World, packages: Path) -> None:
    """In both directions: only what the other one latched is left."""
    latcher = str(packages / "latches" / "scripts" / "latcher.py")
    async with visitor(it.engine) as pending_login:
        await it.late("/map", "one_says", "two_says")
        await pending_login.robot.send("CN", {"removeNodes": [{"containerTag": "box", "nodeTag": "two"}]})
        await until(lambda: not it.nodes("two"), what="the node ended")
        await it.late("/map", "one_says")
        async with it.graph.program(latcher, "here", "/pose", "here_says", node="/here"):
            async with it.graph.program(latcher, "there", "/pose", "there_says", node="/there"):
                await pending_login.late("here_says", "there_says")
            await pending_login.late("here_says")
        await pending_login.robot.send("CN", {"addNodes": [latching("two")]})
        await it.late("/map", "one_says", "two_says")


async def test_latched_at_the_robot_is_latched_in_the_cloud(it: World, packages: Path) -> None:
    """Over the restart of each part between them; the robot's nodes say nothing again."""
    latcher = str(packages / "latches" / "scripts" / "latcher.py")
    async with (
        it.graph.program(latcher, "here", "/pose", "here_says", node="/here"),
        it.graph.program(latcher, "there", "/pose", "there_says", node="/there"),
    ):
        for part in (None, *it.engine.robots, it.engine.container, it.bridge):
            if part is not None:
                await part.kill()
                await part.start(timeout=90)
            async with visitor(it.engine) as pending_login:
                await pending_login.late("here_says", "there_says")
        it.engine.kill_processes("rce_container.environment")
        async with visitor(it.engine) as pending_login:
            await pending_login.late("here_says", "there_says")


async def test_latched_from_robot_to_robot(it: World, packages: Path) -> None:
    """A robot that connects later gets what the first one's nodes latched."""
    latcher = str(packages / "latches" / "scripts" / "latcher.py")
    async with (
        it.graph.program(latcher, "here", "/pose", "here_says", node="/here"),
        it.graph.program(latcher, "there", "/pose", "there_says", node="/there"),
        stranger(it.engine.url, robot="R2") as second,
    ):
        await second.send("CN", {"addInterfaces": [interface("R2", "poses", "PublisherConverter")]})
        await second.send("CX", {"connect": [{"tagA": "R2/poses", "tagB": "R1/pose"}]})
        heard = {(await second.receive("poses"))["data"] for _ in range(2)}
        assert heard == {"here_says", "there_says"}


def interface(endpoint: str, tag: str, kind: str, addr: str = "") -> dict[str, str]:
    made = {"endpointTag": endpoint, "interfaceTag": tag, "interfaceType": kind, "className": STRING}
    return made | ({"addr": addr} if addr else {})


class Visitor:
    """A robot that starts nodes in the container and learns what they hear."""

    def __init__(self, robot: Stranger) -> None:
        self.robot = robot

    async def late(self, *texts: str) -> None:
        """A node that subscribes now in the container hears all of this, and nothing else."""
        node = {"containerTag": "box", "nodeTag": "late"}
        start = {"pkg": "latches", "exe": "listener.py", "args": f"/pose {len(texts)}"}
        await self.robot.send("CN", {"removeNodes": [node]})
        await self.robot.send("CN", {"addNodes": [{**node, **start}]})
        while (await self.robot.receive("heard", timeout=60))["data"] != f"heard {','.join(sorted(texts))}":
            pass


@contextlib.asynccontextmanager
async def visitor(engine: Engine) -> AsyncIterator[Visitor]:
    async with stranger(engine.url, robot="visitor") as robot:
        made = [
            interface("visitor", "heard", "PublisherConverter"),
            interface("box", "heard", "SubscriberInterface", "/heard"),
        ]
        await robot.send("CN", {"addInterfaces": made})
        await robot.send("CX", {"connect": [{"tagA": "visitor/heard", "tagB": "box/heard"}]})
        await robot.wait_status({"heard": True}, timeout=60)
        yield Visitor(robot)
