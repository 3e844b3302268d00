"""Bad input from a real ROS: each node of a robot says what is wrong, lives on, and sends no speeds."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path
from typing import Any

import pytest
from support.processes import finish
from support.ros_real import Graph

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex

pytestmark = [pytest.mark.needs("ros_msgs"), pytest.mark.timeout(300)]

PROGRAM = Path(__file__).parent / "programs" / "bad_input.py"
SCAN = {
    "data_type": "LaserScan",
    "topic": "scan",
    "marking": True,
    "clearing": True,
    "expected_update_rate": 1.0,
}
COSTMAP = {"robot_radius": 0.2, "observation_sources": "scan", "scan": SCAN}
NODES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "amcl": ("amcl", "amcl", {"use_map_topic": True, "max_particles": 200, "first_map_only": False}),
    "move_base": (
        "move_base",
        "move_base",
        {
            "global_costmap": COSTMAP,
            "local_costmap": {**COSTMAP, "global_frame": "odom", "rolling_window": True},
        },
    ),
    "velocity_limiter": ("rce_safety", "velocity_limiter", {}),
    "obstacle_cells": ("fleet", "obstacle_cells.py", {}),
    "slam_gmapping": ("gmapping", "slam_gmapping", {"particles": 2}),
    "slam_graph": ("slam_graph", "slam_graph", {}),
}


@pytest.mark.parametrize("name", NODES)
async def test_bad_input_is_told_from_outside(name: str, tmp_path: Path) -> None:
    package, exe, parameters = NODES[name]
    async with Core(port=0) as core, Node("judge", argv=[], master_uri=core.uri) as judge:
        values = {**parameters, "no_such_parameter": 1}
        for parameter, value in values.items():
            await judge.set_param(f"/{name}/{parameter}", value)
        command = PackageIndex.from_environ().find(package).executable(exe)
        environ = {**os.environ, "ROS_MASTER_URI": core.uri, "RCE_COMPILED": "no"}
        process = await asyncio.create_subprocess_exec(
            *command, f"__name:={name}", env=environ, start_new_session=True
        )
        try:
            graph = Graph(core.uri, tmp_path, "ours")
            output = await graph.tool("/usr/bin/python3", str(PROGRAM), name)
            assert process.returncode is None, "the node lives on"
        finally:
            await finish(process)
        assert json.loads(output.splitlines()[-1])["states"] > 0
