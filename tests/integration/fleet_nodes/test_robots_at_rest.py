"""Planner and move client as processes, with a robot whose localization publishes one pose and then rests."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack

import pytest
from support.resting_robot import PACKAGES, STATUS, RestingRobot, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import TypeRegistry
from rce_fleet.coordination.settings import FleetSettings


@pytest.mark.parametrize(("alive_topic", "answers"), [(STATUS, False), (STATUS, True), ("odom", False)])
async def test_a_robot_at_rest_lives_and_a_dead_one_is_silent(alive_topic: str, answers: bool) -> None:
    """The planner takes a standing robot for there by the states of its goals, or by another topic."""
    options = ["_answers:=true"] if answers else []
    client = [*options, "__ns:=Robot1"] + ([f"_alive_topic:={alive_topic}"] if alive_topic != STATUS else [])
    async with Core(port=0) as core, AsyncExitStack() as stack:
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", *options))
        await stack.enter_async_context(fleet_program(core, "move_client.py", *client))
        types = TypeRegistry(PACKAGES)
        node = Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=types)
        robot = RestingRobot(await stack.enter_async_context(node))
        await robot.start((2.5, 3.5))
        for topic in {STATUS, alive_topic}:
            await robot.beat(topic)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        beating = tasks.create_task(robot.keep_beating())
        stack.callback(beating.cancel)
        await robot.until("idle")
        await asyncio.sleep(FleetSettings().silence_timeout + 1.5)
        await robot.until("idle")  # No pose has come since, so this would not be again.
        robot.rest(alive_topic)
        assert "neither poses nor states" in await robot.until("silent")
        await robot.beat(alive_topic)
        await robot.until("idle")
