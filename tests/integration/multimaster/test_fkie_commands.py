"""fkie's command lines, as the paper prints them, and its launch files start our discovery and sync."""

from __future__ import annotations

import asyncio
import os
import re
import sys
from contextlib import AbstractAsyncContextManager
from pathlib import Path

from support.multimaster import STRING, node, process
from support.ports import free_ports

from rce.ros.core import Core, Graph

BIN = Path(sys.executable).parent
RCE = str(BIN / "rce")
PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "multi-master.md"
LAUNCH = """<launch>
  <node pkg="master_discovery_fkie" type="master_discovery" name="master_discovery">
    <param name="mcast_group" value="224.0.0.1"/>
    <param name="mcast_port" value="{port}"/>
    <param name="rpc_port" value="{rpc_port}"/>
    <param name="name" value="robot"/>
    <rosparam>{{heartbeat_hz: 10, rosmaster_hz: 10}}</rosparam>
  </node>
  <node pkg="master_sync_fkie" type="master_sync" name="master_sync">
    <rosparam param="sync_topics">[/Robot1/goalNodesList, /map]</rosparam>
  </node>
</launch>
"""


def environ(core: Core, home: Path) -> dict[str, str]:
    return {**os.environ, "ROS_MASTER_URI": core.uri, "ROS_IP": "127.0.0.1", "ROS_HOME": str(home)}


def started(core: Core, home: Path, *words: str) -> AbstractAsyncContextManager[asyncio.subprocess.Process]:
    return process(RCE, *words, env=environ(core, home))


def typed(core: Core, home: Path, line: str) -> AbstractAsyncContextManager[asyncio.subprocess.Process]:
    """Run a line by a shell."""
    env = environ(core, home) | {"PATH": f"{BIN}:{os.environ['PATH']}"}
    return process("bash", "-c", f"exec {line}", env=env)


def topics(graph: Graph) -> set[str]:
    return {name for name in graph.topic_types if not name.startswith(("/master_", "/rosout"))}


async def test_command_lines_and_launch_files_of_fkie(tmp_path: Path) -> None:
    """One machine by the page's lines, one by a launch file: each gets what it wants, and nothing else."""
    port, here_rpc, there_rpc = free_ports(3)
    ports = f"_mcast_port:={port} _rpc_port:={here_rpc}"
    fast = f"{ports} _heartbeat_hz:=10 _rosmaster_hz:=10 _name:=planner _log_level:=DEBUG"
    discovery, sync = re.findall(r"^rce run master_.*$", PAGE.read_text(), re.MULTILINE)
    file = tmp_path / "robot.launch"
    file.write_text(LAUNCH.format(port=port, rpc_port=there_rpc))
    async with (
        Core(port=0) as here,
        Core(port=0) as there,
        node("planner", here.uri) as planner,
        node("robot", there.uri) as robot,
        typed(here, tmp_path, f"{discovery} {fast}"),
        typed(here, tmp_path, sync),
        started(there, tmp_path, "launch", str(file), "--wait", "--no-log"),
    ):
        for name in ("/Robot1/amcl_pose", "/scan"):
            await robot.advertise(name, STRING)
        for name in ("/Robot1/goalNodesList", "/fleet/state"):
            await planner.advertise(name, STRING)
        await here.wait_until(lambda graph: "/Robot1/amcl_pose" in graph.topic_types, timeout=120)
        await there.wait_until(lambda graph: "/Robot1/goalNodesList" in graph.topic_types, timeout=120)
        assert topics(here.graph) == {"/Robot1/amcl_pose", "/Robot1/goalNodesList", "/fleet/state"}
        assert topics(there.graph) == {"/Robot1/goalNodesList", "/Robot1/amcl_pose", "/scan"}
        wanted = ["/Robot1/amcl_pose", "/Robot1/goalNodesList"]
        assert here.graph.parameters.get("/master_sync/sync_topics") == wanted


async def test_killed_nodes_of_fkie_start_again_at_the_same_master(tmp_path: Path) -> None:
    """What a killed discovery and sync wrote to the master's parameters does not stop their successors."""
    port, here_rpc, there_rpc = free_ports(3)
    common = (f"_mcast_port:={port}", "_mcast_group:=224.0.0.1", "_heartbeat_hz:=10", "_rosmaster_hz:=10")
    find = ("run", "master_discovery_fkie", "master_discovery", *common)
    sync = ("run", "master_sync_fkie", "master_sync", "_sync_topics:=[/first, /second]")
    async with (
        Core(port=0) as here,
        Core(port=0) as there,
        node("robot", there.uri) as robot,
        started(there, tmp_path, *find, f"_rpc_port:={there_rpc}", "_name:=robot"),
    ):
        await robot.advertise("/first", STRING)
        own = (*find, f"_rpc_port:={here_rpc}", "_name:=planner")
        async with started(here, tmp_path, *own) as finding, started(here, tmp_path, *sync) as syncing:
            await here.wait_until(lambda graph: "/first" in graph.topic_types, timeout=120)
            for killed in (finding, syncing):
                killed.kill()
                await killed.wait()
        async with started(here, tmp_path, *own), started(here, tmp_path, *sync):
            await robot.advertise("/second", STRING)
            await here.wait_until(lambda graph: "/second" in graph.topic_types, timeout=120)
