"""A planner connects the robots of a large fleet."""

from __future__ import annotations

import asyncio
import xmlrpc.client
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from support.ros_masters import serving
from support.ros_requests import count_requests

from rce.ros.core import Core
from rce.ros.errors import MasterRefusedError
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.coordination.events import Event, PoseSeen
from rce_fleet.nodes.pose_publisher import PosePublisher
from rce_fleet.nodes.registering import ROBOTS_AT_ONCE
from rce_fleet.nodes.robot_topics import POSE, RobotTopics

TOPICS_EACH = 7


@asynccontextmanager
async def planner(master_uri: str, take: list[Event]) -> AsyncIterator[tuple[Node, RobotTopics]]:
    types = TypeRegistry(PackageIndex([]))
    async with Node("planner", argv=[], master_uri=master_uri, types=types, signals=False) as node:
        poses = PosePublisher(node)
        await poses.start()
        yield (
            node,
            RobotTopics(
                *(node, take.append, poses), takes_answers=False, hear_planner=lambda _robot, _planner: None
            ),
        )


async def test_robots_are_joined_in_few_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a request for each topic, robots stood still for a minute after the planner was killed."""
    requests = count_requests(monkeypatch)
    names = [f"Robot{number}" for number in range(2 * ROBOTS_AT_ONCE)]
    async with Core(port=0) as core, planner(core.uri, []) as (node, robots), asyncio.timeout(120):
        before = len(requests)
        await robots.join(names)
        assert len(requests) - before < len(names) * TOPICS_EACH / 10
        assert all(name in robots for name in names)
        assert core.graph.subscribers("/Robot7/amcl_pose") == {node.name: node.uri}


class RefusingOnce:
    """Passes calls on to a core, and refuses the first registration of a topic."""

    def __init__(self, core_uri: str, topic: str) -> None:
        self._core_uri = core_uri
        self._topic = topic
        self._has_refused = False

    def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> Any:
        if method.startswith("register") and arguments[1] == self._topic and not self._has_refused:
            self._has_refused = True
            return -1, "refused", 0
        with xmlrpc.client.ServerProxy(self._core_uri) as core:
            return getattr(core, method)(*arguments)


@pytest.mark.parametrize("topic", ["cancelGoal", "amcl_pose", "freedCells"])
async def test_robot_that_is_not_joined_is_joined_later(topic: str) -> None:
    """It had no topic of its poses from then on: the planner took it for connected."""
    events: list[Event] = []
    async with (
        Core(port=0) as core,
        asyncio.timeout(120),
        serving(RefusingOnce(core.uri, f"/Robot2/{topic}")) as master_uri,
        planner(master_uri, events) as (_, robots),
        Node("robot", argv=[], master_uri=core.uri, signals=False) as robot,
    ):
        names = ["Robot1", "Robot2", "Robot3"]
        with pytest.raises(MasterRefusedError, match="refused"):
            await robots.join(names)
        assert [name for name in names if name in robots] == ["Robot1", "Robot3"]
        await core.wait_until(lambda graph: not graph.publishers("/Robot2/goalNodesList"))
        await robots.join(["Robot2"])
        assert "Robot2" in robots
        poses = await robot.advertise("/Robot2/amcl_pose", POSE, latch=True)
        await poses.wait_for_subscribers()
        poses.publish()
        while not events:
            await asyncio.sleep(0.01)
    assert isinstance(events[0], PoseSeen)
    assert events[0].robot == "Robot2"
