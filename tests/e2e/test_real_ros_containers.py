"""Unmodified nodes of a real ROS in containers: one of Debian's, a rospy script, a compiled roscpp node."""

from __future__ import annotations

import asyncio
import json
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.engine import Engine, running_engine
from support.roscpp_programs import compiled
from support.stranger import Stranger, stranger

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.timeout(300),
    pytest.mark.needs("rospy", "roscpp", "topic_tools"),
]

STRING = "std_msgs/String"
SET_BOOL = "std_srvs/SetBool"
PROGRAMS = Path(__file__).parents[1] / "integration" / "ros_real" / "programs"

SURROUNDINGS = """#!/usr/bin/env python3
import json, os, sys
import rospy
from std_msgs.msg import String
rospy.init_node("surroundings")
publisher = rospy.Publisher("surroundings", String, queue_size=1, latch=True)
publisher.publish(json.dumps({"python": sys.executable, "path": sys.path, "env": dict(os.environ)}))
rospy.spin()
"""


@pytest.fixture(scope="module")
def packages() -> Iterator[Path]:
    """A folder with a package as ROS's build tools leave it."""
    folder = Path(tempfile.mkdtemp(prefix="rce-pkg-", dir="/tmp"))
    folder.chmod(0o755)
    package = folder / "real_nodes"
    (package / "scripts").mkdir(parents=True)
    (package / "lib").mkdir()
    (package / "package.xml").write_text("<package><name>real_nodes</name></package>")
    shutil.copy(PROGRAMS / "rospy_peer.py", package / "scripts")
    (package / "scripts" / "surroundings.py").write_text(SURROUNDINGS)
    (package / "scripts" / "surroundings.py").chmod(0o755)
    shutil.copy(compiled(PROGRAMS / "roscpp_peer.cpp", "roscpp"), package / "lib")
    yield folder
    shutil.rmtree(folder)


def node(tag: str, pkg: str, exe: str, **more: str) -> dict[str, str]:
    return {"containerTag": "box", "nodeTag": tag, "pkg": pkg, "exe": exe, **more}


def interface(endpoint: str, tag: str, kind: str, cls: str = STRING, addr: str = "") -> dict[str, str]:
    made = {"endpointTag": endpoint, "interfaceTag": tag, "interfaceType": kind, "className": cls}
    return made | ({"addr": addr} if addr else {})


def through(tag: str, addr_in: str, addr_out: str) -> list[dict[str, str]]:
    """Interfaces that take a robot's messages to a topic of the container, and those of another one back."""
    return [
        interface("testRobot", f"{tag}In", "SubscriberConverter"),
        interface("box", f"{tag}In", "PublisherInterface", addr=addr_in),
        interface("testRobot", f"{tag}Out", "PublisherConverter"),
        interface("box", f"{tag}Out", "SubscriberInterface", addr=addr_out),
    ]


async def comes_back(robot: Stranger, tag: str, text: str) -> None:
    """Say something until it comes back: some nodes begin to listen or talk a little late."""
    async with asyncio.timeout(60):
        while True:
            await robot.publish(f"{tag}In", STRING, {"data": text})
            try:
                async with asyncio.timeout(0.5):
                    while (await robot.receive(f"{tag}Out"))["data"] != text:
                        pass
            except TimeoutError:
                continue
            return


async def wire(robot: Stranger) -> None:
    services = [
        part
        for tag, addr in (("pySet", "/py/peer_set"), ("cppSet", "/cpp/peer_set"))
        for part in (
            interface("testRobot", tag, "ServiceProviderConverter", SET_BOOL),
            interface("box", tag, "ServiceClientInterface", SET_BOOL, addr),
        )
    ]
    await robot.send("CC", {"containerTag": "box"})
    await robot.send(
        "CN",
        {
            "addNodes": [
                node("relay", "topic_tools", "relay", args="/relay_in /relay_out", name="relay"),
                node("py", "real_nodes", "rospy_peer.py", namespace="py"),
                node("cpp", "real_nodes", "roscpp_peer", namespace="cpp"),
                node("around", "real_nodes", "surroundings.py"),
            ],
            "addInterfaces": [
                *through("relay", "/relay_in", "/relay_out"),
                *through("py", "/py/peer_in", "/py/peer_out"),
                *through("cpp", "/cpp/peer_in", "/cpp/peer_out"),
                interface("testRobot", "around", "PublisherConverter"),
                interface("box", "around", "SubscriberInterface", addr="/surroundings"),
                *services,
            ],
        },
    )
    tags = ["relayIn", "relayOut", "pyIn", "pyOut", "cppIn", "cppOut", "around", "pySet", "cppSet"]
    await robot.send("CX", {"connect": [{"tagA": f"testRobot/{t}", "tagB": f"box/{t}"} for t in tags]})
    await robot.wait_status(dict.fromkeys(tags, True), timeout=60)


@pytest.mark.parametrize("runtime", ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))])
async def test_real_nodes_reach_the_robot(runtime: str, packages: Path) -> None:
    async with running_engine(runtime=runtime, packages=packages) as engine, stranger(engine.url) as robot:
        await wire(robot)
        check_surroundings(json.loads((await robot.receive("around", timeout=60))["data"]), engine)
        for tag in ("relay", "py", "cpp"):
            await comes_back(robot, tag, f"through {tag}")
        for tag in ("pySet", "cppSet"):
            answer = await robot.call(tag, SET_BOOL, {"data": True}, timeout=30)
            assert answer == {"success": True, "message": "done"}
        assert robot.errors == []


def check_surroundings(found: dict[str, Any], engine: Engine) -> None:
    """A node of a ROS package sees the machine's Python and nothing of the engine's."""
    assert found["python"] == "/usr/bin/python3"
    root = str(Path(__file__).parents[2])
    assert not any(folder.startswith(root) for folder in found["path"])
    assert not any(root in value for name, value in found["env"].items() if name in ("PATH", "PYTHONPATH"))
    assert "VIRTUAL_ENV" not in found["env"]
    assert "RCE_SECRET" not in found["env"]
    assert str(engine.control_port) not in found["env"].values()
