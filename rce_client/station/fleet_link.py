"""The station's way to the planner: state and poses come in, wishes go out, all through the engine."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Any

from rce.config.client import ClientConfig
from rce.protocol.messages import Request
from rce_client.connection import Connection, State
from rce_client.ends import ServiceClient
from rce_client.exceptions import CallError, ClientError
from rce_client.station.respawn import repairs
from rce_client.station.view import FleetView
from rce_client.station.wishes import CellWish, GoalWish, Wishes

STATE = "fleet/FleetState"
POSE = "geometry_msgs/PoseWithCovarianceStamped"
SET_GOAL = "fleet/SetGoal"
BLOCK_CELL = "fleet/BlockCell"
CALL_TIMEOUT_S = 10.0
TELL_AGAIN_S = 20.0
"""How long a planner that was restarted is told again what it does not know."""
TELL_EVERY_S = 0.5


class FleetError(Exception):
    """The fleet does not do what was asked."""


class PlannerAwayError(FleetError):
    """The planner cannot be reached at this moment."""


class FleetLink:
    """A connection to the fleet's container.

    Args:
        config: The operator's configuration; its first container is the planner's.
        view: Gets what comes in.
        on_change: Called with ``state`` or ``poses`` after the view took something.
        on_event: Called with words and a tone (``good``, ``warn``, ``bad`` or none) when something happens.
    """

    def __init__(
        self,
        config: ClientConfig,
        view: FleetView,
        *,
        on_change: Callable[[str], None],
        on_event: Callable[[str, str], None],
    ) -> None:
        if not config.containers:
            raise ValueError("containers: the fleet's configuration names no container for the planner")
        self._config = config
        self._container = config.containers[0].tag
        self._view = view
        self._on_change = on_change
        self._on_event = on_event
        self._wishes = Wishes()
        self._planner_began: str | None = None
        self._planner_restarted = asyncio.Event()
        self._repairs: asyncio.Queue[Request] = asyncio.Queue()
        self._known: set[str] = set()
        self._new_robots: asyncio.Queue[str] = asyncio.Queue()
        self._set_goal: ServiceClient[dict[str, Any]] | None = None
        self._block_cell: ServiceClient[dict[str, Any]] | None = None
        self._connection = Connection(
            config.url,
            config.user,
            config.password.get_secret_value(),
            config.robot,
            on_error=lambda text: on_event(text, "bad"),
            on_state=self._on_state,
        )

    async def run(self, ready: Callable[[], Awaitable[None]]) -> None:
        """Make the planner's container, wire it, and keep taking what comes until cancelled."""
        async with self._connection as connection:
            try:
                for request in self._config.setup():
                    await connection.request(request)
                await self._wire(connection)
                await ready()
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._follow_robots(connection))
                    group.create_task(self._repair(connection))
                    group.create_task(self._tell_again())
            finally:
                await connection.remove_all()

    async def set_goal(self, robot: str, cell: int | None) -> str:
        """Send a robot to a cell, or let it stop (None); returns what the planner says.

        Raises:
            FleetError: The planner refuses, or is away.
        """
        said = await self._ask(self._set_goal, {"robot": robot, "cell": -1 if cell is None else cell})
        self._wishes.set_goal(robot, cell)
        return said

    async def block_cell(self, cell: int, *, blocked: bool) -> str:
        """Block or free a cell; returns what the planner says.

        Raises:
            FleetError: The planner refuses, or is away.
        """
        said = await self._ask(self._block_cell, {"cell": cell, "blocked": blocked})
        self._wishes.set_cell(cell, blocked=blocked)
        return said

    def on_engine(self, state: dict[str, Any]) -> None:
        """Take the engine's state; nodes that ended are started again."""
        for request in repairs(self._config, state):
            self._repairs.put_nowait(request)

    async def _ask(self, service: ServiceClient[dict[str, Any]] | None, request: dict[str, Any]) -> str:
        if service is None:
            raise PlannerAwayError("the planner's container is not ready yet")
        try:
            answer = await service(request, timeout=CALL_TIMEOUT_S)
        except CallError as error:
            raise PlannerAwayError(f"the planner did not answer: {error}") from error
        except ClientError as error:
            raise PlannerAwayError(f"the engine cannot be reached: {error}") from error
        if not answer["ok"]:
            raise FleetError(answer["message"])
        return str(answer["message"])

    async def _wire(self, connection: Connection) -> None:
        await connection.subscriber("fleetState", STATE, self._take_state)
        self._set_goal = await connection.service_client("setGoal", SET_GOAL)
        self._block_cell = await connection.service_client("blockCell", BLOCK_CELL)
        for tag, kind, cls, address in (
            ("fleetState", "SubscriberInterface", STATE, "/fleet/state"),
            ("setGoal", "ServiceClientInterface", SET_GOAL, "/fleet/set_goal"),
            ("blockCell", "ServiceClientInterface", BLOCK_CELL, "/fleet/block_cell"),
        ):
            await connection.add_interface(self._container, tag, kind, cls, addr=address)
            await self._join(connection, tag)
        for tag in ("fleetState", "setGoal", "blockCell"):
            await connection.wait_active(tag)

    async def _follow_robots(self, connection: Connection) -> None:
        while True:
            await self._follow(connection, await self._new_robots.get())

    async def _repair(self, connection: Connection) -> None:
        while True:
            await connection.request(await self._repairs.get())

    async def _tell_again(self) -> None:
        """Tell a planner that was restarted what it forgot, until it knows or it is time to give up."""
        while True:
            await self._planner_restarted.wait()
            self._planner_restarted.clear()
            self._on_event("the planner was restarted; telling it goals and blocked cells again", "warn")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TELL_AGAIN_S):
                    while not self._planner_restarted.is_set():
                        await self._tell_unmet()
                        await asyncio.sleep(TELL_EVERY_S)

    async def _tell_unmet(self) -> None:
        for wish in self._wishes.unmet(self._view.state) if self._view.state else ():
            with contextlib.suppress(FleetError):
                match wish:
                    case CellWish(cell, blocked):
                        await self.block_cell(cell, blocked=blocked)
                    case GoalWish(robot, cell):
                        await self.set_goal(robot, cell)

    async def _follow(self, connection: Connection, robot: str) -> None:
        """Wire a robot's pose to the station."""
        tag = f"pose{robot}"
        await connection.subscriber(tag, POSE, lambda message: self._take_pose(robot, message))
        await connection.add_interface(
            self._container, tag, "SubscriberInterface", POSE, addr=f"/{robot}/amcl_pose"
        )
        await self._join(connection, tag)

    async def _join(self, connection: Connection, tag: str) -> None:
        await connection.connect(f"{connection.robot_id}/{tag}", f"{self._container}/{tag}")

    def _take_state(self, message: dict[str, Any]) -> None:
        self._view.on_state(message)
        if self._planner_began not in (None, message["started"]):
            self._planner_restarted.set()
        self._planner_began = message["started"]
        for robot in self._view.robot_ids():
            if robot not in self._known:
                self._known.add(robot)
                self._new_robots.put_nowait(robot)
        self._on_change("state")

    def _take_pose(self, robot: str, message: dict[str, Any]) -> None:
        self._view.on_pose(robot, message)
        self._on_change("poses")

    def _on_state(self, state: State, words: str) -> None:
        if state is State.LOST:
            self._on_event(f"connection to the engine lost: {words}", "bad")
        elif state is State.RESTORED:
            self._on_event("connection to the engine is back", "good")
