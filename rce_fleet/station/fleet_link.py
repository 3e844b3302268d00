"""The link between station and planner: receives state and poses, sends requests."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from math import inf
from typing import Any, assert_never

from rce.aio.backoff import Backoff
from rce_fleet.coordination.following import ChangeFollower
from rce_fleet.station.desired import Desired, DesiredCell, DesiredGoal
from rce_fleet.station.planner_client import (
    BLOCK_CELL,
    FLEET_REQUEST,
    GET_STATE,
    SET_GOAL,
    SET_GRID,
    SET_MODE,
    PlannerClient,
    PlannerError,
    PlannerService,
    PlannerUnavailableError,
)
from rce_fleet.station.view import FleetView, ViewChange

RESEND_FOR_S = 20.0
"""How long goals and blocked cells are sent again to a restarted planner."""
RESEND_EVERY_S = 0.5
GRID_WAIT_S = 2.0
"""How long the grid of a restarted planner is awaited before goals and cells are sent: it may be another."""
ASK_AGAIN = Backoff(first=1.0, longest=60.0)
"""Pauses before the complete state is requested again, while a planner does not answer."""
SILENT_S = 10.0
"""A planner publishes a change, or the number of the last one, every second. After this time without one, the
planner is asked whether it still publishes changes."""

POSES_WAIT_S = 10.0
"""A planner that has sent states for this time, but no poses, is of an earlier release: each robot's own
topic of poses is followed then."""


def _ignore(value: object) -> None:
    del value


class FleetLink:
    """Keeps the station's view up to date, and sends requests to the planner.

    Args:
        client: The client of the planner.
        view: Updated with state and poses.
        on_change: Called with the change after the view was updated with a state or changes.
        on_pose: Called with a robot's id after its pose was updated.
        on_event: Called with a text and a tone (``good``, ``warn``, ``bad`` or empty) for each event.
        on_fleet_event: Called with each event of the fleet manager, a JSON object.
        on_planner: Called with the time since when the planner is away, seconds since 1970, and with None
            when it is back: it sent nothing for :data:`SILENT_S`, and does not answer.
    """

    def __init__(
        self,
        client: PlannerClient,
        view: FleetView,
        *,
        on_change: Callable[[ViewChange], None],
        on_pose: Callable[[str], None],
        on_event: Callable[[str, str], None],
        on_fleet_event: Callable[[str], None] = _ignore,
        on_planner: Callable[[float | None], None] = _ignore,
    ) -> None:
        self._client = client
        self._view = view
        self._on_change = on_change
        self._on_pose = on_pose
        self._follower = ChangeFollower()
        self._state_needed = asyncio.Event()
        self._changes_came = asyncio.Event()
        self._changes_at = 0.0
        """When a change, or the number of the last one, came."""
        self._asked_in_vain = False
        self._told = False
        """Whether an event told that the planner publishes no changes."""
        self._on_event = on_event
        self._on_fleet_event = on_fleet_event
        self._on_planner = on_planner
        self._began_at = 0.0
        self._is_away = False
        self._desired = Desired()
        self._unanswered: Counter[str | int] = Counter()
        """Robots and cells with requests that the planner has not answered yet."""
        self._planner_started: str | None = None
        self._planner_restarted = asyncio.Event()
        self._grid_came = asyncio.Event()
        self._changes_grid = False
        """Whether this station changed the grid, and the planner's new state is not here yet."""
        self._known: set[str] = set()
        """Robots whose own topic of poses is followed."""
        self._poses_due: float | None = None
        """When poses must have come from this planner; infinite: they came. None: it has no robots yet."""

    async def run(self, ready: Callable[[], Awaitable[None]]) -> None:
        """Receive messages until cancelled; ``ready`` is called once the planner is connected."""
        self._changes_at = _now()
        self._began_at = time.monotonic()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._client.run(self, ready))
            group.create_task(self._resend())
            group.create_task(self._keep_up())
            group.create_task(self._notice_silence())

    async def set_goal(self, robot: str, cell: int | None) -> str:
        """Send a robot to a cell, or stop it (None); return the planner's answer.

        Raises:
            PlannerError: The planner refused, or cannot be reached.
        """
        with self._asking(robot):
            said = await self._call(SET_GOAL, {"robot": robot, "cell": -1 if cell is None else cell})
            self._desired.set_goal(robot, cell)
        return said

    async def block_cell(self, wanted: DesiredCell) -> str:
        """Block or free a cell; return the planner's answer.

        Raises:
            PlannerError: The planner refused, or cannot be reached.
        """
        with self._asking(wanted.cell):
            said = await self._call(BLOCK_CELL, wanted.request(time.time()))
            self._desired.set_cell(wanted)
        return said

    def forget_cell(self, cell: int) -> None:
        """Do not send a cell to a restarted planner again: the fleet manager does."""
        self._desired.forget_cell(cell)

    def forget_goal(self, robot: str) -> None:
        """Do not send a goal to a restarted planner again: the fleet manager does."""
        self._desired.forget_goal(robot)

    def forget_requests(self) -> None:
        """Send no goals and cells to a restarted planner again: the fleet manager runs, and does."""
        self._desired.clear()

    @property
    def expects_manager(self) -> bool:
        """Whether the fleet was configured with a fleet manager."""
        return self._client.expects_manager

    @property
    def can_ask_manager(self) -> bool:
        """Whether requests can reach a fleet manager now, if there is one."""
        return self._client.offers(FLEET_REQUEST)

    @property
    def knows_modes(self) -> bool:
        """Whether the planner can be asked for robots' modes; one of an earlier release knows none."""
        return self._client.offers(SET_MODE)

    async def set_grid(self, choice: dict[str, Any], *, preview: bool) -> dict[str, Any]:
        """Lay another grid over the planner's map, or only show it; return the planner's answer.

        Goals and blocked cells that were requested are numbers of the grid before, and are forgotten.

        Args:
            choice: ``cell_size``, ``origin_x``, ``origin_y``, ``origin_yaw`` and ``blocked_share``.
            preview: Only return the grid.

        Raises:
            PlannerError: The planner refused, or cannot be reached.
        """
        self._changes_grid |= not preview
        try:
            answer = await self._ask(SET_GRID, {**choice, "preview": preview})
        except PlannerError:
            self._changes_grid &= preview
            raise
        if not preview:
            self._desired.clear()
        return answer

    async def set_mode(self, robot: str, mode: str, *, reason: str, user: str) -> str:
        """Set who drives a robot, or stop and resume the fleet (robot empty); return the planner's answer.

        A planner of an earlier release knows no modes: the robot's goal is removed instead.

        Raises:
            PlannerError: The planner refused, or cannot be reached.
        """
        if not self.knows_modes:
            if not robot:
                raise PlannerUnavailableError("this planner cannot pause the fleet")
            return await self.set_goal(robot, None) if mode != "automatic" else ""
        return await self._call(SET_MODE, {"robot": robot, "mode": mode, "reason": reason, "by": user})

    async def request(self, request: dict[str, Any]) -> dict[str, Any]:
        """Ask the fleet manager (``fleet/Request``); return its answer.

        Raises:
            PlannerUnavailableError: It does not answer.
        """
        return await self._client.call(FLEET_REQUEST, request)

    @contextlib.contextmanager
    def _asking(self, subject: str | int) -> Iterator[None]:
        """Send nothing of before about a robot or cell while a request about it is on its way."""
        self._unanswered[subject] += 1
        try:
            yield
        finally:
            self._unanswered[subject] -= 1
            if not self._unanswered[subject]:
                del self._unanswered[subject]

    async def _call(self, service: PlannerService, request: dict[str, Any]) -> str:
        return str((await self._ask(service, request))["message"])

    async def _ask(self, service: PlannerService, request: dict[str, Any]) -> dict[str, Any]:
        answer = await self._client.call(service, request)
        if not answer["ok"]:
            raise PlannerError(answer["message"])
        return answer

    async def _resend(self) -> None:
        """Send goals and blocked cells to a restarted planner again, for a while or until it reports them."""
        while True:
            await self._planner_restarted.wait()
            self._planner_restarted.clear()
            with contextlib.suppress(TimeoutError):  # an earlier planner publishes no grid
                async with asyncio.timeout(GRID_WAIT_S):
                    await self._grid_came.wait()
            self._on_event("the planner was restarted; sending goals and blocked cells again", "warn")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RESEND_FOR_S):
                    while not self._planner_restarted.is_set():
                        await self._send_unmet()
                        await asyncio.sleep(RESEND_EVERY_S)

    async def _keep_up(self) -> None:
        """Request the complete state whenever changes are missing.

        A planner that does not answer may be of an earlier release, which publishes complete states only.
        They are followed until it answers. It is asked again after a pause that grows, and as soon as it
        publishes a change.
        """
        pauses = ASK_AGAIN.start()
        while True:
            await self._state_needed.wait()
            self._changes_came.clear()
            try:
                answer = await self._client.call(GET_STATE, {})
            except PlannerUnavailableError:
                self._asked_in_vain = True
                self._follower.fall_back()
                self._client.receive_states()
                self._notice_absence()
                await asyncio.sleep(ASK_AGAIN.first)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(pauses.next() - ASK_AGAIN.first):
                        await self._changes_came.wait()
                continue
            pauses.reset()
            self._asked_in_vain = self._told = False
            self._note_heard()
            self._state_needed.clear()
            early = self._follower.take_snapshot(answer)
            self._client.stop_states()
            self._take(answer["state"]["started"], self._view.on_state(answer["state"], time.time()))
            for message in early:
                self._take(message["started"], self._view.on_changes(message, time.time()))
            self._request_if_behind()

    async def _notice_silence(self) -> None:
        """Ask a planner that stopped publishing changes: another one may have taken its place."""
        while True:
            await asyncio.sleep(max(0.1, self._changes_at + SILENT_S - _now()))
            if _now() - self._changes_at >= SILENT_S:
                if self._follower.follows:
                    self.may_have_missed()
                self._changes_at = _now()
            self._notice_absence()

    def _notice_absence(self) -> None:
        """Tell that the planner is away if it sends nothing and does not answer, or was never heard."""
        now = time.monotonic()
        is_never_heard = self._view.planner_heard_at is None
        heard_at = self._view.planner_heard_at or self._began_at
        if self._is_away or now - heard_at < SILENT_S or not (self._asked_in_vain or is_never_heard):
            return
        self._is_away = True
        self._on_planner(time.time() - (now - heard_at))
        self._on_event("the planner does not answer; what is shown of the robots is old", "bad")

    def _note_heard(self) -> None:
        self._view.planner_heard_at = time.monotonic()
        if self._is_away:
            self._is_away = False
            self._on_planner(None)
            self._on_event("the planner answers again", "good")

    def _request_if_behind(self) -> None:
        if self._follower.is_behind:
            self._state_needed.set()

    async def _send_unmet(self) -> None:
        state, now = self._view.state, time.time()
        for desired in self._desired.unmet(state, now) if state else ():
            if not self._desired.holds(desired):  # changed while those before it were sent
                continue
            with contextlib.suppress(PlannerError):
                match desired:
                    case DesiredCell(cell):
                        if cell not in self._unanswered:
                            await self._call(BLOCK_CELL, desired.request(time.time()))
                    case DesiredGoal(robot, cell):
                        if robot not in self._unanswered:
                            await self._call(SET_GOAL, {"robot": robot, "cell": cell})
                    case _:
                        assert_never(desired)

    # What comes in

    def take_state(self, message: dict[str, Any]) -> None:
        """Handle a ``fleet/FleetState``; ignore it if the planner publishes changes."""
        self._note_heard()
        if self._follower.follows:
            return
        self._take(message["started"], self._view.on_state(message, time.time()))
        if self._asked_in_vain and not self._told and not self._changes_came.is_set():
            self._told = True
            self._on_event("the planner publishes no changes; following its complete state instead", "warn")

    def take_changes(self, message: dict[str, Any]) -> None:
        """Handle a ``fleet/FleetChanges``."""
        self._note_heard()
        self._changes_at = _now()
        self._changes_came.set()
        if self._follower.take_changes(message):
            self._take(message["started"], self._view.on_changes(message, time.time()))
        self._request_if_behind()

    def may_have_missed(self) -> None:
        """Request the complete state."""
        self._follower.lose()
        self._request_if_behind()

    def _take(self, planner_started: str, change: ViewChange) -> None:
        """Subscribe to new robots, and report the change."""
        if self._planner_started not in (None, planner_started):
            self._poses_due = None
            self._grid_came.clear()
            self._client.read_grid()
            if self._changes_grid or change.is_new_map:
                self._desired.clear()
                self._on_event("the fleet has a new grid; its goals are removed", "warn")
            else:
                self._planner_restarted.set()
            self._changes_grid = False
        self._planner_started = planner_started
        self._follow_poses()
        self._on_change(change)

    def _follow_poses(self) -> None:
        """Follow each robot's own topic, if the planner does not publish the poses of all together."""
        robots = self._view.robot_ids()
        if self._poses_due is None and robots:
            self._poses_due = _now() + POSES_WAIT_S
        if self._poses_due is None or _now() < self._poses_due:
            return
        for robot in robots:
            if robot not in self._known:
                self._known.add(robot)
                self._client.follow(robot)

    def take_poses(self, message: dict[str, Any]) -> None:
        """Handle the poses of many robots."""
        self._note_heard()
        self._poses_due = inf
        for robot in self._view.on_poses(message, time.monotonic()):
            self._on_pose(robot)

    def take_pose(self, robot: str, message: dict[str, Any]) -> None:
        """Handle a robot's pose message."""
        self._note_heard()
        self._view.on_pose(robot, message)
        self._on_pose(robot)

    def take_grid(self, message: dict[str, Any]) -> None:
        """Handle the grid, a ``nav_msgs/OccupancyGrid``: it has the rotation."""
        change = self._view.on_grid(message)
        if change.is_new_map:
            self._desired.clear()
        self._grid_came.set()
        self._on_change(change)

    def take_fleet_event(self, text: str) -> None:
        """Handle an event of the fleet manager."""
        self._on_fleet_event(text)

    def take_event(self, text: str, tone: str) -> None:
        """Handle an event."""
        self._on_event(text, tone)


def _now() -> float:
    return asyncio.get_running_loop().time()
