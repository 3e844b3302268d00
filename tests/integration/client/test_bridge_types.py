"""Types of bridges that the robot's ROS graph tells."""

from __future__ import annotations

import asyncio

import pytest

from rce.config.bridges import Bridge
from rce.config.exceptions import ConfigError
from rce.ros.core import Core
from rce.ros.node import Node
from rce_client.ros_bridge.type_lookup import find_types


def bridge(**keys: object) -> Bridge:
    return Bridge.model_validate(keys)


def node(name: str, core: Core) -> Node:
    return Node(name, argv=[], master_uri=core.uri, signals=False)


TOPIC = bridge(topic="pose", **{"from": "robot"}, to="c1")
DOWN = bridge(topic="/inside", **{"from": "c1"}, to="robot:/outside")
SERVICE = bridge(service="/ask", server="robot", clients="c1")
ACTION = bridge(action="dock", server="robot", clients="c1")
INNER = bridge(topic="/a", **{"from": "c1"}, to="c2")


async def test_types_are_read_as_nodes_appear() -> None:
    said: list[str] = []
    tasks: list[asyncio.Task[None]] = []
    async with (
        Core(port=0) as core,
        node("asker", core) as asker,
        node("robot", core) as robot,
    ):
        await robot.advertise("/pose", "geometry_msgs/PoseStamped")

        async def start_the_rest() -> None:
            await robot.subscribe("/outside", "std_msgs/String", lambda _: None)
            await robot.advertise_service("/ask", "std_srvs/Empty", lambda _: {})
            await robot.subscribe("/dock/goal", "move_base_msgs/MoveBaseActionGoal", lambda _: None)

        def say(text: str) -> None:
            said.append(text)
            tasks.append(asyncio.create_task(start_the_rest()))

        found = await find_types(dict(enumerate((TOPIC, DOWN, SERVICE, ACTION))), asker, "file", say)
        assert found == {
            0: "geometry_msgs/PoseStamped",
            1: "std_msgs/String",
            2: "std_srvs/Empty",
            3: "move_base_msgs/MoveBase",
        }
        assert said == ["waiting for the types of topic /inside, service /ask, action dock"]
        await asyncio.gather(*tasks)


async def test_what_the_graph_does_not_tell_is_named() -> None:
    async with Core(port=0) as core, node("asker", core) as asker:
        with pytest.raises(ConfigError) as caught:
            await find_types({4: TOPIC}, asker, "file", lambda _: None, timeout=0.1)
        assert str(caught.value) == (
            "file: bridges[4].type: is missing, and no node of the robot's graph had the type of topic pose "
            "within 0.1 s; start the node first, or give the type"
        )
        with pytest.raises(ConfigError, match="topic /a has no end at the robot"):
            await find_types({0: INNER}, asker, "file", lambda _: None)
