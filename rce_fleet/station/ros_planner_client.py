"""The station's client of a planner in a ROS graph, without the engine."""

from __future__ import annotations

import asyncio
from array import array
from collections.abc import Awaitable, Callable
from typing import Any

from rce.aio.tasks import TaskScope
from rce.ros.closing import release
from rce.ros.errors import NodeClosedError, RosError, ServiceError
from rce.ros.node import Node, ServiceClient
from rce.ros.types import Duration, Message, Time, TypeRegistry
from rce_fleet.station.planner_client import (
    BLOCK_CELL,
    CALL_TIMEOUT_S,
    CHANGES,
    CHANGES_TOPIC,
    EVENTS,
    EVENTS_TOPIC,
    FLEET_REQUEST,
    GET_STATE,
    GRID,
    GRID_TOPIC,
    POSE,
    POSES,
    POSES_TOPIC,
    SET_GOAL,
    SET_GRID,
    SET_MODE,
    STATE,
    STATE_TOPIC,
    Call,
    PlannerClient,
    PlannerListener,
    PlannerUnavailableError,
    pose_topic,
)
from rce_fleet.station.ros_subscriptions import subscribe_when_reachable

NODE = "operator_station"


class RosPlannerClient(PlannerClient):
    """A node in the planner's graph.

    Args:
        master_uri: The ROS master of the planner's graph, which may start later.
        types: Where message types come from.
    """

    def __init__(self, master_uri: str, types: TypeRegistry) -> None:
        super().__init__("the ROS master cannot be reached yet")
        self._node = Node(
            NODE, argv=(), master_uri=master_uri, types=types, signals=False, master_timeout=None
        )
        self._heard = asyncio.Event()

    async def run(self, listener: PlannerListener, ready: Callable[[], Awaitable[None]]) -> None:
        """Join the graph and receive messages until cancelled.

        Raises:
            NodeClosedError: In a group: the graph told the node to stop. It does not know it any more then.
        """

        def take_state(message: Message) -> None:
            listener.take_state(plain(message))
            self._heard.set()

        async with self._node as node, TaskScope() as watching:
            watching.spawn(_fail_on_shutdown(node), name="until the node is told to stop")
            for service in (SET_GOAL, BLOCK_CELL, GET_STATE, SET_GRID, SET_MODE, FLEET_REQUEST):
                self._calls[service] = _caller(node.service_client(service.name, service.type_name))
            states = await subscribe_when_reachable(node, STATE_TOPIC, STATE, take_state)
            await self._heard.wait()
            await ready()
            await subscribe_when_reachable(
                node, CHANGES_TOPIC, CHANGES, lambda message: listener.take_changes(plain(message))
            )
            listener.may_have_missed()
            await subscribe_when_reachable(
                node, POSES_TOPIC, POSES, lambda message: listener.take_poses(plain(message))
            )
            await subscribe_when_reachable(
                node, EVENTS_TOPIC, EVENTS, lambda message: listener.take_fleet_event(message.data)
            )
            async with asyncio.TaskGroup() as group:
                group.create_task(self._follow_robots(listener))
                group.create_task(self._read_grid(listener))
                while True:
                    await self._changes_followed.wait()
                    await release(states)
                    await self._states_needed.wait()
                    states = await subscribe_when_reachable(node, STATE_TOPIC, STATE, take_state)

    async def _read_grid(self, listener: PlannerListener) -> None:
        """Receive the grid once for each start of the planner: each blocked cell publishes it anew."""
        came = asyncio.Event()

        def take(message: Message) -> None:
            listener.take_grid(plain(message))
            came.set()

        while True:
            await self._grid_needed.wait()
            self._grid_needed.clear()
            came.clear()
            grid = await subscribe_when_reachable(self._node, GRID_TOPIC, GRID, take)
            await came.wait()
            await release(grid)

    async def _follow_robots(self, listener: PlannerListener) -> None:
        while True:
            await self._follow(listener, await self._new_robots.get())

    async def _follow(self, listener: PlannerListener, robot: str) -> None:
        await subscribe_when_reachable(
            self._node, pose_topic(robot), POSE, lambda message: listener.take_pose(robot, plain(message))
        )


async def _fail_on_shutdown(node: Node) -> None:
    """Wait until the node is told to stop, by ``rosnode kill`` or a second node of its name.

    Raises:
        NodeClosedError: It was.
    """
    await node.until_shutdown()
    raise NodeClosedError(
        f"the ROS graph at {node.master_uri} told {node.name} to stop; a graph has room for one station"
    )


def _caller(client: ServiceClient) -> Call:
    async def call(request: dict[str, Any]) -> dict[str, Any]:
        try:
            return plain(await client.call(request, timeout=CALL_TIMEOUT_S))
        except ServiceError as error:
            raise PlannerUnavailableError(f"the planner did not answer: {error}") from error
        except RosError as error:
            raise PlannerUnavailableError(f"the planner's ROS graph cannot be reached: {error}") from error

    return call


def plain(message: Message) -> dict[str, Any]:
    """Return a message as dictionaries and lists; times become strings."""
    names: tuple[str, ...] = message.__class__.__slots__
    return {name: _plain(getattr(message, name)) for name in names}


def _plain(value: Any) -> Any:
    if isinstance(value, Message):
        return plain(value)
    if isinstance(value, array):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(element) for element in value]
    if isinstance(value, (Time, Duration)):
        return f"{value.secs}.{value.nsecs:09}"
    return value
