"""Simulated time and services of a container go on after a restart of each part between it and the robot."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from support.engine import Engine, Program, running_engine
from support.ros_real import our_graph

from rce.config.folders import examples_dir
from rce.ros.errors import ServiceError
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, Time, TypeRegistry

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600), pytest.mark.needs("rospy", "roslaunch")]

TIMEOUT_S = 120.0
STRING, CLOCK, ECHO = "std_msgs/String", "rosgraph_msgs/Clock", "Test/StringEcho"
TIMES = """#!/usr/bin/python3
import os
import time
import rospy
from std_msgs.msg import String

rospy.init_node("times")
publisher = rospy.Publisher("/times", String, queue_size=1)
while not rospy.is_shutdown():
    publisher.publish("%d %d" % (os.getpid(), rospy.get_rostime().secs))
    time.sleep(0.05)
"""
"""Says what time it is for a node in simulated time; it sleeps in real time."""
PARTS = (
    ("clock", CLOCK, "PublisherInterface", "SubscriberForwarder", "/clock", "/clock"),
    ("times", STRING, "SubscriberInterface", "PublisherForwarder", "/times", "/times"),
    (
        "echo",
        ECHO,
        "ServiceClientInterface",
        "ServiceProviderForwarder",
        "/stringEchoService",
        "/of_the_cloud",
    ),
)


def config(engine: Engine) -> dict[str, Any]:
    """A robot that gives its container the time, hears what time it is there, and calls its service."""
    interfaces = []
    for tag, cls, box, robot, there, here in PARTS:
        interfaces.append({"eTag": "box", "iTag": tag, "iType": box, "iCls": cls, "addr": there})
        interfaces.append({"eTag": "R1", "iTag": tag, "iType": robot, "iCls": cls, "addr": here})
    node = {"cTag": "box", "restart": "always"}
    return {
        "url": engine.url,
        "userID": "testUser",
        "password": "testUser",
        "robotID": "R1",
        "containers": [{"cTag": "box"}],
        "parameters": [{"cTag": "box", "name": "/use_sim_time", "value": True}],
        "nodes": [
            {**node, "nTag": "times", "pkg": "times", "exe": "times.py"},
            {**node, "nTag": "echo", "pkg": "Test", "exe": "stringEcho.py"},
        ],
        "interfaces": interfaces,
        "connections": [{"tagA": f"R1/{tag}", "tagB": f"box/{tag}"} for tag, *_ in PARTS],
    }


class Driver:
    """A node of the robot that makes its time, asks what time it is in the container, and calls a service."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._now = 1000
        self._heard: asyncio.Queue[tuple[int, int]] = asyncio.Queue()

    async def run(self) -> None:
        """Tell the time, which goes by quickly."""
        clock = await self.node.advertise("/clock", CLOCK)
        await self.node.subscribe("/times", STRING, self._hear)
        while True:
            self._now += 1
            clock.publish(clock=Time(self._now, 0))
            await asyncio.sleep(0.1)

    def _hear(self, message: Message) -> None:
        pid, secs = map(int, message.data.split())
        self._heard.put_nowait((pid, secs))

    async def all_goes_on(self, not_pid: int = 0) -> int:
        """Wait until the node in the container knows a time from now on, and the service answers.

        Args:
            not_pid: Of a node that was killed; only another one counts.

        Returns:
            The pid of the node.
        """
        begin = self._now
        async with asyncio.timeout(TIMEOUT_S):
            while True:
                pid, secs = await self._heard.get()
                if secs > begin and pid != not_pid:
                    break
        client = self.node.service_client("/of_the_cloud", ECHO)
        async with asyncio.timeout(TIMEOUT_S):
            while True:
                try:
                    answer = await client.call({"data": f"at {begin}"}, timeout=10)
                except ServiceError as error:
                    print(f"call at {begin}: {error}")  # noqa: T201 - how often it failed
                    await asyncio.sleep(0.1)
                    continue
                assert answer.data == f"at {begin}"
                return pid


@asynccontextmanager
async def driver(uri: str) -> AsyncIterator[Driver]:
    types = TypeRegistry(PackageIndex([examples_dir()]))
    async with Node("driver", argv=[], master_uri=uri, signals=False, types=types) as node:
        found = Driver(node)
        task = asyncio.create_task(found.run())
        yield found
        task.cancel()
        await asyncio.wait([task])


async def test_time_and_services_go_on_after_each_restart(tmp_path: Path) -> None:
    package = tmp_path / "packages" / "times"
    package.mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>times</name></package>")
    (package / "times.py").write_text(TIMES)
    (package / "times.py").chmod(0o755)
    async with running_engine(packages=package.parent) as engine, our_graph(tmp_path) as graph:
        file = tmp_path / "robot.config"
        file.write_text(json.dumps(config(engine)))
        program = str(Path(sys.executable).parent / "rce-ros")
        env = {**engine.env, "ROS_MASTER_URI": graph.uri}
        bridge = Program("rce-ros", [program, str(file)], env, engine.folder)
        await bridge.start(timeout=TIMEOUT_S)
        try:
            async with driver(graph.uri) as drive:
                pid = await drive.all_goes_on()
                for needles in (("times.py", "stringEcho.py"), ("rce_container.environment",)):
                    engine.kill_processes(*needles)
                    pid = await drive.all_goes_on(not_pid=pid)
                for part in (*engine.robots, engine.container, engine.master, bridge):
                    await part.kill()
                    await part.start(timeout=TIMEOUT_S)
                    await drive.all_goes_on()
        finally:
            await bridge.stop()
