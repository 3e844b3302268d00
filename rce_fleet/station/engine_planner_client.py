"""The station's client of a planner that runs in the engine."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any

from rce.config.client import ClientConfig
from rce.model import Request
from rce.tls.identity import Context
from rce_client.connection import Connection, State
from rce_client.exceptions import CallError, ClientError
from rce_client.reminder import Reminder
from rce_client.services import ServiceClient
from rce_client.session import is_failure
from rce_client.topics import Subscriber
from rce_fleet.station.desired import node_requests
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

_log = logging.getLogger(__name__)

MANAGER_EXECUTABLE = "fleet_manager.py"
_SERVICES = (("setGoal", SET_GOAL), ("blockCell", BLOCK_CELL))
_NEWER_SERVICES = (
    *(("getState", GET_STATE), ("setGrid", SET_GRID), ("setMode", SET_MODE)),
    ("fleetRequest", FLEET_REQUEST),
)
"""Services that planners of earlier releases do not have; the station does not wait for them."""


class EnginePlannerClient(PlannerClient):
    """Connects to the planner's container, and restarts its nodes when they end.

    Args:
        config: The operator's config; its first container is the planner's.
        tls: Gives the TLS settings for each connection; the system's if None.
    """

    def __init__(self, config: ClientConfig, tls: Context | None = None) -> None:
        if not config.containers:
            raise ValueError("containers: empty; the operator's config must have a container for the planner")
        super().__init__("the planner's container is not ready yet")
        self._config = config
        self._tls = tls
        self._container = config.containers[0].tag
        self.connection: Connection | None = None
        """The connection to the engine, while there is one."""
        self._node_requests: asyncio.Queue[Request] = asyncio.Queue()
        self._reminder = Reminder()
        self._failure = ""
        self._listener: PlannerListener
        self._states: Subscriber[dict[str, Any]]

    @property
    def expects_manager(self) -> bool:
        """Whether the operator's config has a fleet manager."""
        return any(add.node.exe == MANAGER_EXECUTABLE for add in self._config.nodes)

    async def run(self, listener: PlannerListener, ready: Callable[[], Awaitable[None]]) -> None:
        """Create the planner's container, connect to it, and receive messages until cancelled."""
        self._listener = listener
        config = self._config
        async with Connection(
            config.url,
            config.user,
            config.password.get_secret_value(),
            config.robot,
            tls=self._tls,
            on_error=lambda text: listener.take_event(text, "bad"),
            on_state=self._on_state,
        ) as connection:
            self.connection = connection  # before the planner: emergency stops do not need it
            try:
                for request in config.setup():
                    await connection.request(request)
                await self._join_planner(connection)
                await ready()
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._follow_robots(connection))
                    group.create_task(self._restart_nodes(connection))
                    group.create_task(self._follow_changes(connection))
                    group.create_task(self._follow_states(connection))
                    group.create_task(self._read_grid(connection))
            finally:
                self.connection = None
                await connection.remove_all()

    def on_engine(self, state: dict[str, Any]) -> None:
        """Handle a state of the engine: restart nodes that ended."""
        for request in node_requests(self._config, state):
            self._node_requests.put_nowait(request)

    async def _join_planner(self, connection: Connection) -> None:
        await self._receive_states(connection)
        for tag, service in _SERVICES:
            self._calls[service] = _caller(await connection.service_client(tag, service.type_name))
            await self._join(connection, tag, "ServiceClientInterface", service.type_name, service.name)
        for tag in ("fleetState", *(tag for tag, _ in _SERVICES)):
            await connection.wait_active(tag)

    async def _follow_changes(self, connection: Connection) -> None:
        """Receive changes, beside whole states until the planner is known to publish changes."""
        for tag, service in _NEWER_SERVICES:
            self._calls[service] = _caller(await connection.service_client(tag, service.type_name))
            await self._join(connection, tag, "ServiceClientInterface", service.type_name, service.name)
        await connection.subscriber("fleetChanges", CHANGES, self._listener.take_changes)
        await self._join(connection, "fleetChanges", "SubscriberInterface", CHANGES, CHANGES_TOPIC)
        self._listener.may_have_missed()
        await connection.subscriber("fleetPoses", POSES, self._listener.take_poses)
        await self._join(connection, "fleetPoses", "SubscriberInterface", POSES, POSES_TOPIC)
        await connection.subscriber("fleetEvents", EVENTS, self._take_fleet_event)
        await self._join(connection, "fleetEvents", "SubscriberInterface", EVENTS, EVENTS_TOPIC)

    def _take_fleet_event(self, message: dict[str, Any]) -> None:
        self._listener.take_fleet_event(message["data"])

    async def _read_grid(self, connection: Connection) -> None:
        """Receive the grid once for each start of the planner: each blocked cell publishes it anew."""
        came = asyncio.Event()

        def take(message: dict[str, Any]) -> None:
            self._listener.take_grid(message)
            came.set()

        while True:
            await self._grid_needed.wait()
            self._grid_needed.clear()
            came.clear()
            grid = await connection.subscriber("fleetMap", GRID, take)
            await self._join(connection, "fleetMap", "SubscriberInterface", GRID, GRID_TOPIC)
            await came.wait()
            await grid.close()
            await connection.remove_interface(self._container, "fleetMap")

    async def _follow_states(self, connection: Connection) -> None:
        """Receive whole states while changes are not followed."""
        while True:
            await self._changes_followed.wait()
            await self._states.close()
            await connection.remove_interface(self._container, "fleetState")
            await self._states_needed.wait()
            await self._receive_states(connection)

    async def _receive_states(self, connection: Connection) -> None:
        self._states = await connection.subscriber("fleetState", STATE, self._listener.take_state)
        await self._join(connection, "fleetState", "SubscriberInterface", STATE, STATE_TOPIC)

    async def _follow_robots(self, connection: Connection) -> None:
        while True:
            await self._follow(connection, await self._new_robots.get())

    async def _restart_nodes(self, connection: Connection) -> None:
        while True:
            await connection.request(await self._node_requests.get())

    async def _follow(self, connection: Connection, robot: str) -> None:
        """Subscribe to a robot's pose."""
        tag, listener = f"pose{robot}", self._listener
        await connection.subscriber(tag, POSE, lambda message: listener.take_pose(robot, message))
        await self._join(connection, tag, "SubscriberInterface", POSE, pose_topic(robot))

    async def _join(
        self, connection: Connection, tag: str, interface_type: str, type_name: str, address: str
    ) -> None:
        await connection.add_interface(self._container, tag, interface_type, type_name, addr=address)
        await connection.connect(f"{connection.robot_id}/{tag}", f"{self._container}/{tag}")

    def _on_state(self, state: State, words: str) -> None:
        if is_failure(state, words):
            self._report_failure(words)
        elif state is State.LOST:
            self._listener.take_event(f"connection to the engine lost: {words}", "bad")
        elif state is State.RESTORED:
            self._listener.take_event("connection to the engine restored", "good")
            self._listener.may_have_missed()

    def _report_failure(self, words: str) -> None:
        """Log at once and every few seconds why there is no connection; tell the pages once."""
        if self._reminder.is_due(words):
            _log.warning("%s is not connected to the engine: %s", self._config.robot, words)
        if words != self._failure:
            self._failure = words
            self._listener.take_event(f"no connection to the engine: {words}", "bad")


def _caller(client: ServiceClient[dict[str, Any]]) -> Call:
    async def call(request: dict[str, Any]) -> dict[str, Any]:
        try:
            return await client(request, timeout=CALL_TIMEOUT_S)
        except CallError as error:
            raise PlannerUnavailableError(f"the planner did not answer: {error}") from error
        except ClientError as error:
            raise PlannerUnavailableError(f"the engine cannot be reached: {error}") from error

    return call
