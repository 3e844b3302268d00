"""The planner's services for zones and modes, on a real core, and what its state says of them."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import Any

from support.resting_robot import PACKAGES, STATUS, RestingRobot, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Message, TypeRegistry


async def call(node: Node, service: str, **fields: Any) -> Message:
    """Call a service of the planner."""
    name = "".join(word.capitalize() for word in service.split("_"))
    async with asyncio.timeout(50):
        await node.wait_for_service(f"/fleet/{service}")
        client = node.service_client(f"/fleet/{service}", f"fleet/{name}")
        return await client(**fields)


async def test_zones_and_modes_are_set_by_services() -> None:
    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py"))
        await stack.enter_async_context(fleet_program(core, "move_client.py", "__ns:=Robot1"))
        types = TypeRegistry(PACKAGES)
        node = Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=types)
        robot = RestingRobot(await stack.enter_async_context(node))
        await robot.start((2.5, 3.5))
        await robot.beat(STATUS)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        beating = tasks.create_task(robot.keep_beating())
        stack.callback(beating.cancel)
        await robot.until("idle")

        spill = {"id": "spill", "kind": "blocked", "cells": [6, 5], "reason": "oil", "by": "anna"}
        answer = await call(node, "set_zones", zones=[{**spill, "lifetime": 600.0}], revision=0)
        assert (answer.ok, answer.revision) == (True, 1), answer.message
        answer = await call(node, "set_zones", zones=[spill], revision=0)
        assert not answer.ok
        answer = await call(node, "set_zones", zones=[{"id": "a", "kind": "icy"}], revision=-1)
        assert "kind must be one of blocked, slow, one_way, limited, cost, not 'icy'" in answer.message
        state = (await call(node, "get_state")).state
        assert [(zone.id, list(zone.cells), zone.reason, zone.by) for zone in state.zones] == [
            ("spill", [5, 6], "oil", "anna")
        ]
        assert 590.0 < state.zones[0].lifetime <= 600.0
        assert set(state.blocked) == {5, 6}
        assert not (await call(node, "set_goal", robot="Robot1", cell=5)).ok

        assert (await call(node, "set_mode", robot="Robot1", mode="paused", reason="tea")).ok
        assert await robot.until("paused") == "paused (tea)"
        assert (await call(node, "set_mode", mode="stopped")).ok
        assert "emergency stop" in await robot.until("stopped")
        assert not (await call(node, "set_mode", robot="Robot1", mode="asleep")).ok
        assert (await call(node, "set_mode", mode="automatic")).ok
        assert (await call(node, "set_mode", robot="Robot1", mode="automatic")).ok
        await robot.until("idle")
