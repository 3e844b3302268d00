"""``map_server`` and ``map_saver`` on a real core, with ROS's own tools where they are installed."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from support.ros_real import our_graph

from rce.ros.core import Core
from rce.ros.errors import ServiceFaultError
from rce.ros.node import Node
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ros_map import load_map, save_map
from rce_fleet.nodes.map_saver import parse, save
from rce_fleet.nodes.map_server import MapServer, MapServerParameters

PATIENCE = 60.0


def hall(folder: Path, name: str = "hall") -> Path:
    data = np.random.default_rng(1).choice(np.array([-1, 0, 100], np.int8), (30, 20))
    return save_map(OccupancyMap(data, 0.05, Pose(-1.0, 2.0, 0.5)), folder / name)


@asynccontextmanager
async def serving(uri: str, file: Path | str, frame: str = "map") -> AsyncIterator[Node]:
    async with Node("map_server", argv=[], master_uri=uri) as node:
        task = asyncio.create_task(MapServer(node, MapServerParameters(frame_id=frame)).run(str(file)))
        yield node
        node.shutdown("the test is over")
        await task


async def test_a_map_is_saved_as_it_was_served(tmp_path: Path) -> None:
    file = hall(tmp_path)
    async with (
        Core(port=0) as core,
        serving(core.uri, file, "hall"),
        Node("map_saver", argv=[], master_uri=core.uri) as node,
    ):
        written = await asyncio.wait_for(save(node, parse(["-f", str(tmp_path / "again")])), PATIENCE)
        client = node.service_client("static_map", "nav_msgs/GetMap")
        answer = (await client.call({}, timeout=PATIENCE)).map
    assert written == tmp_path / "again.yaml"
    first, again = load_map(file), load_map(written)
    assert np.array_equal(first.data, again.data)
    assert again.origin.yaw == pytest.approx(0.5)
    assert (answer.header.frame_id, answer.info.width, answer.info.height) == ("hall", 20, 30)
    assert list(answer.data) == first.data.reshape(-1).tolist()


async def test_a_faulty_map_is_reported_and_replaced(tmp_path: Path) -> None:
    good, bad = hall(tmp_path), tmp_path / "bad.yaml"
    bad.write_text(good.read_text().replace("resolution: 0.05", "resolution: -1"))
    async with Core(port=0) as core, Node("judge", argv=[], master_uri=core.uri) as judge:
        logs = await judge.subscribe("/rosout", "rosgraph_msgs/Log")
        states = await judge.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray")
        async with serving(core.uri, bad):
            async with asyncio.timeout(PATIENCE):
                async for log in logs:
                    if "resolution" in log.msg:
                        break
                async for state in states:
                    if "resolution" in state.status[0].message:
                        break
            assert state.status[0].level == 2
            client = judge.service_client("static_map", "nav_msgs/GetMap")
            with pytest.raises(ServiceFaultError, match="'resolution' must be a positive number"):
                await client.call({}, timeout=PATIENCE)
            change = judge.service_client("change_map", "nav_msgs/LoadMap")
            assert (await change.call({"map_url": "/gone.yaml"}, timeout=PATIENCE)).result == 1
            assert (await change.call({"map_url": str(bad)}, timeout=PATIENCE)).result == 2
            changed = await change.call({"map_url": str(good)}, timeout=PATIENCE)
            assert (changed.result, changed.map.info.width) == (0, 20)
            assert (await client.call({}, timeout=PATIENCE)).map.info.height == 30


async def test_a_faulty_message_is_not_saved(tmp_path: Path) -> None:
    async with Core(port=0) as core, Node("source", argv=[], master_uri=core.uri) as source:
        maps = await source.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        maps.publish(info={"width": 3, "height": 3, "resolution": 0.05, "origin": {"orientation": {"w": 1}}})
        async with Node("map_saver", argv=[], master_uri=core.uri) as node:
            saved = save(node, parse(["-f", str(tmp_path / "x")]))
            assert await asyncio.wait_for(saved, PATIENCE) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.needs("rospy")
async def test_ros_tools_read_a_served_map(tmp_path: Path) -> None:
    file = hall(tmp_path)
    async with our_graph(tmp_path) as graph:
        command = [sys.executable, "-m", "rce_fleet.nodes.map_server", str(file)]
        environ = {**os.environ, "ROS_MASTER_URI": graph.uri}
        program = await asyncio.create_subprocess_exec(*command, env=environ)
        try:
            said = await graph.says("rostopic", "echo", "-n1", "/map_metadata", text="height: 30")
            assert "width: 20" in said
        finally:
            program.terminate()
            await program.wait()
