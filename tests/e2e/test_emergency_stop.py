"""An emergency stop reaches a robot through a real engine, without any planner."""

from __future__ import annotations

import asyncio
import json
import sys
from collections import deque
from pathlib import Path
from typing import Any

import pytest
from support.engine import Program, running_engine, until

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_client.connection import Connection
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.sources import EngineCommandSource
from rce_fleet.station.engine_watch import EngineWatch
from rce_fleet.wiring import FleetAccount, robot_config

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(300)]

TYPES = TypeRegistry(PackageIndex([]))


async def test_an_emergency_stop_needs_no_planner() -> None:
    """The robot stands; it also does after its bridge was restarted, until it is released."""
    async with (
        running_engine() as engine,
        Core(port=0) as core,
        Node("safety", argv=[], master_uri=core.uri, types=TYPES) as node,
    ):
        got: deque[bool] = deque()
        await node.subscribe("emergency_stop", "std_msgs/Bool", lambda message: got.append(message.data))
        whole = robot_config(1, FleetAccount(url=engine.url))
        kept: dict[str, Any] = {key: whole[key] for key in ("url", "userID", "password", "robotID")}
        kept["interfaces"] = [item for item in whole["interfaces"] if item["iTag"].startswith("command_")]
        file = engine.folder / "robot1.config"
        file.write_text(json.dumps(kept))
        env = {**engine.env, "ROS_MASTER_URI": core.uri}
        program = Path(sys.executable).parent / "rce-ros"
        bridge = Program("rce-ros", [str(program), str(file)], env, engine.folder)
        watch = EngineWatch(engine.url, "testUser", "testUser", on_state=lambda _: None)
        watching = asyncio.create_task(watch.run())
        await bridge.start()
        try:
            async with Connection(engine.url, "testUser", "testUser", "fleetOperator") as connection:
                source = EngineCommandSource(lambda: connection, watch.read_items)
                control = RobotControl(source, lambda: ["Robot1"])

                async def stopped() -> bool:
                    result = await control.emergency_stop(None, "op", stopped=True)
                    return result.reached == ("Robot1",)

                async def gets(expected: bool) -> bool:
                    return expected in got

                keeping = asyncio.create_task(control.run())
                await until(stopped, what="the station reaches the robot")
                await until(lambda: gets(True), what="the robot is stopped")
                await bridge.stop()
                got.clear()
                await bridge.start()
                await until(lambda: gets(True), what="the robot is stopped again")
                await control.emergency_stop(["Robot1"], "op", stopped=False)
                await until(lambda: gets(False), what="the robot is released")
                other = await control.emergency_stop(["Robot7"], "op", stopped=True)
                assert "command_Robot7_emergency_stop" in other.missed["Robot7"]
                keeping.cancel()
                await asyncio.gather(keeping, return_exceptions=True)
                await control.close()
                await connection.remove_all()
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            await bridge.stop()
