"""The planner as the station sees it: its topics and services, and the client that connects to it."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple, Protocol, TypeAlias

STATE = "fleet/FleetState"
STATE_TOPIC = "/fleet/state"
CHANGES = "fleet/FleetChanges"
CHANGES_TOPIC = "/fleet/changes"
GRID = "nav_msgs/OccupancyGrid"
GRID_TOPIC = "/fleet/map"
POSES = "fleet/FleetPoses"
POSES_TOPIC = "/fleet/poses"
POSE = "geometry_msgs/PoseWithCovarianceStamped"
CALL_TIMEOUT_S = 10.0


class PlannerService(NamedTuple):
    """A service of the planner: its name in the planner's ROS graph, and its type."""

    name: str
    type_name: str


SET_GOAL = PlannerService("/fleet/set_goal", "fleet/SetGoal")
BLOCK_CELL = PlannerService("/fleet/block_cell", "fleet/BlockCell")
SET_GRID = PlannerService("/fleet/set_grid", "fleet/SetGrid")
SET_MODE = PlannerService("/fleet/set_mode", "fleet/SetMode")
GET_STATE = PlannerService("/fleet/get_state", "fleet/GetState")
FLEET_REQUEST = PlannerService("/fleet/request", "fleet/Request")
"""Of the fleet manager, beside the planner."""
EVENTS = "std_msgs/String"
EVENTS_TOPIC = "/fleet/events"


def pose_topic(robot: str) -> str:
    """Return the topic on which the planner publishes a robot's pose, also one that has no common topic."""
    return f"/fleet/poses/{robot}"


class PlannerError(Exception):
    """The planner refused a request; the text says why."""


class PlannerUnavailableError(PlannerError):
    """The planner cannot be reached now; try again later."""


class PlannerListener(Protocol):
    """Gets the planner's messages, in their JSON form."""

    def take_state(self, message: dict[str, Any]) -> None:
        """Handle a ``fleet/FleetState``."""

    def take_changes(self, message: dict[str, Any]) -> None:
        """Handle a ``fleet/FleetChanges``."""

    def may_have_missed(self) -> None:
        """Handle a new or restored subscription to changes: some may have been missed."""

    def take_poses(self, message: dict[str, Any]) -> None:
        """Handle a ``fleet/FleetPoses``."""

    def take_pose(self, robot: str, message: dict[str, Any]) -> None:
        """Handle a robot's pose message."""

    def take_grid(self, message: dict[str, Any]) -> None:
        """Handle the grid, a ``nav_msgs/OccupancyGrid``."""

    def take_fleet_event(self, text: str) -> None:
        """Handle an event of the fleet manager, a JSON object."""

    def take_event(self, text: str, tone: str) -> None:
        """Handle an event; the tone is ``good``, ``warn`` or ``bad``."""


Call: TypeAlias = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]
"""Calls a service of the planner; raises :class:`PlannerUnavailableError` if none answers."""


class PlannerClient(ABC):
    """A client of the planner: through the engine, or in the planner's ROS graph.

    Args:
        away: Error text until the planner's services are connected.
    """

    def __init__(self, away: str) -> None:
        self._away = away
        self._new_robots: asyncio.Queue[str] = asyncio.Queue()
        self._calls: dict[PlannerService, Call] = {}
        self._changes_followed = asyncio.Event()
        self._states_needed = asyncio.Event()
        self._grid_needed = asyncio.Event()
        self._grid_needed.set()

    @property
    def expects_manager(self) -> bool:
        """Whether a fleet manager was configured; False: unknown."""
        return False

    @abstractmethod
    async def run(self, listener: PlannerListener, ready: Callable[[], Awaitable[None]]) -> None:
        """Receive state and poses until cancelled; call ``ready`` once the planner is connected."""

    def follow(self, robot: str) -> None:
        """Subscribe to a robot's poses, of a planner that does not publish those of all robots together."""
        self._new_robots.put_nowait(robot)

    def stop_states(self) -> None:
        """Stop receiving complete states; changes are enough."""
        self._states_needed.clear()
        self._changes_followed.set()

    def receive_states(self) -> None:
        """Receive complete states again, if this was stopped."""
        self._changes_followed.clear()
        self._states_needed.set()

    def read_grid(self) -> None:
        """Receive the grid once more: a planner that began anew may have another one."""
        self._grid_needed.set()

    def offers(self, service: PlannerService) -> bool:
        """Return whether the planner has a service that earlier releases do not have."""
        return service in self._calls

    async def call(self, service: PlannerService, request: dict[str, Any]) -> dict[str, Any]:
        """Call a service of the planner.

        Raises:
            PlannerUnavailableError: There is no answer.
        """
        call = self._calls.get(service)
        if call is None:
            raise PlannerUnavailableError(self._away)
        return await call(request)
