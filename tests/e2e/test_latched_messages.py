"""What robots latch, by real nodes: maps of 4 MB, transforms of several publishers, descriptions."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from support.engine import Engine, Program, running_engine
from support.latched import MAP, STRING, TF, say_map, wanted, write_package
from support.ros_real import real_graph
from support.stranger import Stranger, stranger

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600), pytest.mark.needs("rospy", "roslaunch", "tf2")]

TIMEOUT_S = 120.0
DOWN = (("map", MAP, "/map"), ("tf_down", TF, "/tf_static"))
UP = (("local", MAP, "/local_map"), ("tf_up", TF, "/tf_static"), ("robot", STRING, "/robot_description"))
CLOUD = ("server map /map cloud", "shelves tf /tf_static shelf", "docks tf /tf_static dock")
ROBOT = (
    "local map /local_map local",
    "arm tf /tf_static arm",
    "base tf /tf_static base",
    "description string /robot_description <robot/>",
)


def frames(*names: str) -> list[str]:
    """The frames of these broadcasters."""
    return [f"{name}{number}" for name in names for number in range(2)]


ALL_FRAMES = frames("arm", "base", "dock", "shelf")
AT_ROBOT = wanted(map=[say_map("cloud")], tf_static=ALL_FRAMES)
IN_CLOUD = wanted(local_map=[say_map("local")], robot_description=["<robot/>"], tf_static=ALL_FRAMES)


def node(box: str, words: str) -> dict[str, Any]:
    return {
        "containerTag": box,
        "nodeTag": words.split(maxsplit=1)[0],
        "pkg": "latches",
        "exe": "latcher.py",
        "args": words,
        "restart": "always",
    }


def interface(endpoint: str, tag: str, kind: str, cls: str, addr: str = "") -> dict[str, str]:
    made = {"endpointTag": endpoint, "interfaceTag": tag, "interfaceType": kind, "className": cls}
    return made | ({"addr": addr} if addr else {})


def short(made: dict[str, Any]) -> dict[str, Any]:
    """Name keys as a robot's file does."""
    names = {
        "endpointTag": "eTag",
        "interfaceTag": "iTag",
        "interfaceType": "iType",
        "className": "iCls",
        "containerTag": "cTag",
        "nodeTag": "nTag",
    }
    return {names.get(key, key): value for key, value in made.items()}


def robot_file(engine: Engine) -> str:
    """A robot that sends and takes latched topics, transforms in both directions on one topic."""
    made = []
    for tag, cls, addr in DOWN:
        made.append(interface("box", tag, "SubscriberInterface", cls, addr))
        made.append(interface("R1", tag, "PublisherForwarder", cls, addr))
    for tag, cls, addr in UP:
        made.append(interface("box", tag, "PublisherInterface", cls, addr))
        made.append(interface("R1", tag, "SubscriberForwarder", cls, addr))
    return json.dumps(
        {
            "url": engine.url,
            "userID": "testUser",
            "password": "testUser",
            "robotID": "R1",
            "containers": [{"cTag": "box"}],
            "nodes": [short(node("box", words)) for words in CLOUD],
            "interfaces": [short(one) for one in made],
            "connections": [{"tagA": f"R1/{tag}", "tagB": f"box/{tag}"} for tag, _, _ in (*DOWN, *UP)],
        }
    )


class Visitor:
    """A robot that starts nodes in a container and learns what they hear."""

    def __init__(self, robot: Stranger, box: str) -> None:
        self.robot = robot
        self.box = box

    async def late(self, said: str, *subjects: str) -> None:
        """Have a node subscribe now in the container, and wait until it says what it is to hear."""
        name = {"containerTag": self.box, "nodeTag": "late"}
        start = {"pkg": "latches", "exe": "listener.py", "args": " ".join((said.rstrip("."), *subjects))}
        await self.robot.send("CN", {"removeNodes": [name]})
        await self.robot.send("CN", {"addNodes": [{**name, **start}]})
        async with asyncio.timeout(TIMEOUT_S):
            while not (text := (await self.robot.receive("heard", timeout=TIMEOUT_S))["data"]).startswith(
                said
            ):
                print(text)  # noqa: T201 - what was heard in its place


@contextlib.asynccontextmanager
async def visitor(engine: Engine, box: str) -> AsyncIterator[Visitor]:
    async with stranger(engine.url, robot=f"visitor_{box}") as robot:
        made = [
            interface(f"visitor_{box}", "heard", "PublisherConverter", STRING),
            interface(box, "heard", "SubscriberInterface", STRING, "/heard"),
        ]
        await robot.send("CN", {"addInterfaces": made})
        await robot.send("CX", {"connect": [{"tagA": f"visitor_{box}/heard", "tagB": f"{box}/heard"}]})
        await robot.wait_status({"heard": True}, timeout=TIMEOUT_S)
        yield Visitor(robot, box)


async def restart(*programs: Program) -> None:
    """Kill -9 programs, all of them before the first one is started again."""
    for program in programs:
        await program.kill()
    for program in programs:
        await program.start(timeout=TIMEOUT_S)


async def test_robot_and_container_hear_what_the_other_latched(tmp_path: Path) -> None:
    """Each message once, though transforms go both ways on one topic; again after a restart of all parts."""
    packages = tmp_path / "packages"
    scripts = write_package(packages)
    async with contextlib.AsyncExitStack() as stack:
        engine = await stack.enter_async_context(running_engine(packages=packages))
        graph = await stack.enter_async_context(real_graph(tmp_path))
        for words in ROBOT:
            name, *rest = words.split()
            latcher = str(scripts / "latcher.py")
            await stack.enter_async_context(graph.program(latcher, name, *rest, node=f"/{name}"))
        file = tmp_path / "robot.config"
        file.write_text(robot_file(engine))
        program = str(Path(sys.executable).parent / "rce-ros")
        env = {**engine.env, "ROS_MASTER_URI": graph.uri}
        bridge = Program("rce-ros", [program, str(file)], env, engine.folder)
        stack.push_async_callback(bridge.stop)
        await bridge.start(timeout=TIMEOUT_S)
        listener = str(scripts / "listener.py"), AT_ROBOT, "map:/map", "tf:/tf_static"
        subjects = "map:/local_map", "string:/robot_description", "tf:/tf_static"

        await graph.says(*listener, text=f"{AT_ROBOT}.")
        async with visitor(engine, "box") as pending_login:
            await pending_login.late(f"{IN_CLOUD}.", *subjects)

        await restart(*engine.robots, engine.container, bridge)
        engine.kill_processes("rce_container.environment")
        await graph.says(*listener, text=AT_ROBOT)
        async with visitor(engine, "box") as pending_login:
            await pending_login.late(IN_CLOUD, *subjects)


async def test_container_hears_what_another_one_latched(tmp_path: Path) -> None:
    """Again after restarts of the nodes, of either environment and of the task set."""
    packages = tmp_path / "packages"
    write_package(packages)
    said = wanted(map=[say_map("cloud")], tf_static=frames("dock", "shelf"))
    subjects = "map:/map", "tf:/tf_static"
    async with running_engine(packages=packages) as engine, stranger(engine.url) as owner:
        made = []
        for tag, cls, addr in DOWN:
            made.append(interface("source", tag, "SubscriberInterface", cls, addr))
            made.append(interface("target", tag, "PublisherInterface", cls, addr))
        for box in ("source", "target"):
            await owner.send("CC", {"containerTag": box})
        await owner.send(
            "CN", {"addNodes": [node("source", words) for words in CLOUD], "addInterfaces": made}
        )
        await owner.send(
            "CX", {"connect": [{"tagA": f"source/{tag}", "tagB": f"target/{tag}"} for tag, _, _ in DOWN]}
        )
        async with visitor(engine, "target") as pending_login:
            await pending_login.late(f"{said}.", *subjects)
            engine.kill_processes("latcher.py")
            await pending_login.late(said, *subjects)
            await restart(engine.container)
            engine.kill_processes("rce_container.environment")
            await pending_login.late(said, *subjects)
