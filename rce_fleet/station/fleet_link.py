"""The station's dealings with the planner: state and poses come in, requests go out, over any wire."""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple, Protocol, TypeAlias, assert_never

from rce_fleet.station.desired import Desired, DesiredCell, DesiredGoal
from rce_fleet.station.view import FleetView

STATE = "fleet/FleetState"
STATE_TOPIC = "/fleet/state"
POSE = "geometry_msgs/PoseWithCovarianceStamped"
CALL_TIMEOUT_S = 10.0
TELL_AGAIN_S = 20.0
"""How long a planner that was restarted is told again what it does not know."""
TELL_EVERY_S = 0.5


class PlannerService(NamedTuple):
    """A service of the planner: its name in the planner's ROS graph, and its type."""

    name: str
    cls: str


SET_GOAL = PlannerService("/fleet/set_goal", "fleet/SetGoal")
BLOCK_CELL = PlannerService("/fleet/block_cell", "fleet/BlockCell")


def pose_topic(robot: str) -> str:
    """The topic on which the planner tells a robot's pose."""
    return f"/fleet/poses/{robot}"


class PlannerError(Exception):
    """The fleet does not do what was asked."""


class PlannerUnavailableError(PlannerError):
    """The planner cannot be reached at this moment."""


class Listener(Protocol):
    """Gets what comes in over a wire. Messages are in their JSON form."""

    def take_state(self, message: dict[str, Any]) -> None:
        """Take a ``fleet/FleetState``."""

    def take_pose(self, robot: str, message: dict[str, Any]) -> None:
        """Take a robot's pose message."""

    def take_event(self, text: str, tone: str) -> None:
        """Take words on what happened; the tone is ``good``, ``warn`` or ``bad``."""


Ask: TypeAlias = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]
"""Calls a service of the planner; raises :class:`PlannerAwayError` if there is no answer."""


class PlannerWire(ABC):
    """A way to the planner: through the engine, or in its own ROS graph.

    Args:
        away: What is wrong as long as the planner's services are not joined.
    """

    def __init__(self, away: str) -> None:
        self._away = away
        self._new_robots: asyncio.Queue[str] = asyncio.Queue()
        self._asks: dict[PlannerService, Ask] = {}

    @abstractmethod
    async def run(self, listener: Listener, ready: Callable[[], Awaitable[None]]) -> None:
        """Let state and poses come in until cancelled; call ``ready`` once the planner can be heard."""

    def follow(self, robot: str) -> None:
        """Let a robot's poses come in."""
        self._new_robots.put_nowait(robot)

    async def call(self, service: PlannerService, request: dict[str, Any]) -> dict[str, Any]:
        """Ask the planner.

        Raises:
            PlannerAwayError: There is no answer.
        """
        ask = self._asks.get(service)
        if ask is None:
            raise PlannerUnavailableError(self._away)
        return await ask(request)


class FleetLink:
    """What the station knows and wants of the fleet.

    Args:
        wire: The way to the planner.
        view: Gets what comes in.
        on_change: Called with ``state`` or ``poses`` after the view took something.
        on_event: Called with words and a tone (``good``, ``warn``, ``bad`` or none) when something happens.
    """

    def __init__(
        self,
        wire: PlannerWire,
        view: FleetView,
        *,
        on_change: Callable[[str], None],
        on_event: Callable[[str, str], None],
    ) -> None:
        self._wire = wire
        self._view = view
        self._on_change = on_change
        self._on_event = on_event
        self._desired = Desired()
        self._planner_began: str | None = None
        self._planner_restarted = asyncio.Event()
        self._known: set[str] = set()

    async def run(self, ready: Callable[[], Awaitable[None]]) -> None:
        """Keep taking what comes until cancelled; ``ready`` is called once the planner can be heard."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._wire.run(self, ready))
            group.create_task(self._tell_again())

    async def set_goal(self, robot: str, cell: int | None) -> str:
        """Send a robot to a cell, or let it stop (None); returns what the planner says.

        Raises:
            PlannerError: The planner refuses, or is away.
        """
        said = await self._ask(SET_GOAL, {"robot": robot, "cell": -1 if cell is None else cell})
        self._desired.set_goal(robot, cell)
        return said

    async def block_cell(self, cell: int, *, blocked: bool) -> str:
        """Block or free a cell; returns what the planner says.

        Raises:
            PlannerError: The planner refuses, or is away.
        """
        said = await self._ask(BLOCK_CELL, {"cell": cell, "blocked": blocked})
        self._desired.set_cell(cell, blocked=blocked)
        return said

    async def _ask(self, service: PlannerService, request: dict[str, Any]) -> str:
        answer = await self._wire.call(service, request)
        if not answer["ok"]:
            raise PlannerError(answer["message"])
        return str(answer["message"])

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
        for desired in self._desired.unmet(self._view.state) if self._view.state else ():
            with contextlib.suppress(PlannerError):
                match desired:
                    case DesiredCell(cell, blocked):
                        await self.block_cell(cell, blocked=blocked)
                    case DesiredGoal(robot, cell):
                        await self.set_goal(robot, cell)
                    case _:
                        assert_never(desired)

    # What comes in

    def take_state(self, message: dict[str, Any]) -> None:
        """Take a ``fleet/FleetState``."""
        self._view.on_state(message)
        if self._planner_began not in (None, message["started"]):
            self._planner_restarted.set()
        self._planner_began = message["started"]
        for robot in self._view.robot_ids():
            if robot not in self._known:
                self._known.add(robot)
                self._wire.follow(robot)
        self._on_change("state")

    def take_pose(self, robot: str, message: dict[str, Any]) -> None:
        """Take a robot's pose message."""
        self._view.on_pose(robot, message)
        self._on_change("poses")

    def take_event(self, text: str, tone: str) -> None:
        """Take words on what happened."""
        self._on_event(text, tone)
