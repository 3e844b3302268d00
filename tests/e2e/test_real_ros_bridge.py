"""``rce-ros`` joins a robot's graph, a real roscore's with rospy nodes or one of ours, to a container."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from support.engine import Program, running_engine
from support.ros_real import GRAPHS, Graph

from rce.config.folders import examples_dir
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry

pytestmark = [pytest.mark.e2e, pytest.mark.needs("rospy", "roslaunch")]

STRING = "std_msgs/String"
ECHO = "Test/StringEcho"
PEER = Path(__file__).parents[1] / "integration" / "ros_real" / "programs" / "rospy_peer.py"


def config(url: str) -> dict[str, Any]:
    """A robot whose topics and service are those of the echo node in its container."""
    box = [
        ("toNode", "PublisherInterface", STRING, "/stringEchoReq"),
        ("fromNode", "SubscriberInterface", STRING, "/stringEchoResp"),
        ("service", "ServiceClientInterface", ECHO, "/stringEchoService"),
    ]
    robot = [
        ("toNode", "SubscriberForwarder", STRING, "/peer_out"),
        ("fromNode", "PublisherForwarder", STRING, "/from_cloud"),
        ("service", "ServiceProviderForwarder", ECHO, "/of_the_cloud"),
    ]
    return {
        "url": url,
        "userID": "testUser",
        "password": "testUser",
        "robotID": "testRobot",
        "containers": [{"cTag": "box"}],
        "nodes": [
            {"cTag": "box", "nTag": "echo", "pkg": "Test", "exe": "stringEcho.py"},
        ],
        "interfaces": [
            {"eTag": endpoint, "iTag": tag, "iType": kind, "iCls": cls, "addr": addr}
            for endpoint, parts in (("box", box), ("testRobot", robot))
            for tag, kind, cls, addr in parts
        ],
        "connections": [{"tagA": f"testRobot/{tag}", "tagB": f"box/{tag}"} for tag, *_ in box],
    }


@pytest.mark.parametrize("kind", ["roscore", "ours"])
async def test_a_robots_graph_reaches_its_container(kind: str, tmp_path: Path) -> None:
    """What the rospy node says goes to the container's echo node and comes back to the robot's graph."""
    async with running_engine() as engine, GRAPHS[kind](tmp_path) as graph:
        file = tmp_path / "robot.config"
        file.write_text(json.dumps(config(engine.url)))
        bridge = Program(
            "rce-ros",
            [str(Path(sys.executable).parent / "rce-ros"), str(file)],
            {**engine.env, "ROS_MASTER_URI": graph.uri},
            engine.folder,
        )
        async with graph.program("/usr/bin/python3", str(PEER), node="/rospy_peer"):
            await bridge.start()
            try:
                await comes_back(graph)
                uri = await graph.tool("rosservice", "uri", "/of_the_cloud")
                assert uri.startswith("rosrpc://")
            finally:
                assert bridge.process is not None
                bridge.process.send_signal(signal.SIGINT)
                await bridge.process.wait()
        assert bridge.process.returncode == 0, bridge.output()
        assert await graph.publishers("/from_cloud") == []


async def comes_back(graph: Graph) -> None:
    types = TypeRegistry(PackageIndex([examples_dir()]))
    async with Node("asker", argv=[], master_uri=graph.uri, signals=False, types=types) as node:
        heard = await node.subscribe("/from_cloud", STRING)
        say = await node.advertise("/peer_in", STRING)
        await say.wait_for_subscribers(timeout=30)
        await heard.wait_for_publishers(timeout=30)
        first = asyncio.ensure_future(anext(aiter(heard)))
        async with asyncio.timeout(60):
            while not first.done():
                say.publish(data="to the cloud and back")
                await asyncio.sleep(0.1)
        assert first.result().data == "to the cloud and back"
        answer = await node.service_client("/of_the_cloud", ECHO).call({"data": "called"}, timeout=30)
        assert answer.data == "called"
