"""The core of ``move_client``: a list of cells becomes one navigation goal after the other.

It keeps the robot moving smoothly by sending the farthest cell that lies straight ahead on the list, and
replaces that goal while the robot drives when a longer list comes. It never sends a goal that is not on
the list, and all cells between two goals are on it. Messages may get lost or come twice: a goal is sent
again until the robot's ``move_base`` lists it, a cancellation until the goal is over.

Pure: events and the time go in, instructions come out.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from math import atan2
from typing import TYPE_CHECKING, Any

from rce.lifecycle import LifeCycle, remember
from rce_fleet.exceptions import TransitionError

if TYPE_CHECKING:
    from rce_fleet.planning.grid import GridMap

REPEAT_AFTER = 1.0
"""Seconds after which a goal or cancellation that had no effect is sent again."""

QUIET_TIME = 1.0
"""Seconds without an active goal after which the robot is considered to have none."""

STAMP_STEP = 1e-3
"""Seconds between two time stamps while the clock is behind the newest one."""

RECALLED_S, RECALLED_FACTOR = 1.0, 60.0
"""Seconds by which the next goal is made newer after the robot has recalled one, and how they grow."""

LATEST_STAMP = 4.2e9
"""Seconds; a ROS time has 32 bits for them. Goals of others may have any time stamp."""


class ClientState(Enum):
    """What a move client does."""

    IDLE = "idle"
    """No goal is active; the list is empty or driven to its end."""
    DRIVING = "driving"
    """A goal of the list is active."""
    CANCELLING = "cancelling"
    """A goal may still be active and is being cancelled."""
    FAILED = "failed"
    """The robot aborted a goal; its list was dropped."""


class ClientEvent(Enum):
    """Causes of a change of state."""

    DRIVE = "drive"
    """A goal is sent."""
    ARRIVE = "arrive"
    """The robot is at its goal, or the list that it is driven along has ended."""
    FAIL = "fail"
    """The robot aborted a goal."""
    STOP = "stop"
    """The active goal is outdated: it is cancelled."""
    STOPPED = "stopped"
    """No goal is active any more."""
    RENEW = "renew"
    """A new list came after a failure."""


CLIENT_LIFE: LifeCycle[ClientState, ClientEvent] = LifeCycle(
    "move client",
    {
        ClientState.IDLE: {
            ClientEvent.DRIVE: ClientState.DRIVING,
        },
        ClientState.DRIVING: {
            ClientEvent.ARRIVE: ClientState.IDLE,
            ClientEvent.STOP: ClientState.CANCELLING,
            ClientEvent.FAIL: ClientState.FAILED,
        },
        ClientState.CANCELLING: {
            ClientEvent.STOPPED: ClientState.IDLE,
        },
        ClientState.FAILED: {
            ClientEvent.RENEW: ClientState.IDLE,
        },
    },
    error=TransitionError,
)


class GoalState(Enum):
    """State of a navigation goal; the numbers are those of ``actionlib_msgs/GoalStatus``."""

    PENDING = 0
    ACTIVE = 1
    PREEMPTED = 2
    SUCCEEDED = 3
    ABORTED = 4
    REJECTED = 5
    PREEMPTING = 6
    RECALLING = 7
    RECALLED = 8
    LOST = 9

    @property
    def over(self) -> bool:
        """Whether the state is final."""
        return self not in _UNDER_WAY


_UNDER_WAY = frozenset({GoalState.PENDING, GoalState.ACTIVE, GoalState.PREEMPTING, GoalState.RECALLING})


@dataclass(frozen=True, slots=True)
class SendGoal:
    """Give the robot a navigation goal. A goal sent again has the same id and stamp.

    Attributes:
        id: Id of the goal.
        stamp: Time stamp, seconds; a cancellation with a later stamp also stops it.
        cell: The goal cell.
        heading: Direction of travel, radians.
    """

    id: str
    stamp: float
    cell: int
    heading: float


@dataclass(frozen=True, slots=True)
class SendStop:
    """Cancel every goal with a time stamp up to ``stamp`` (seconds), also if it arrives later."""

    stamp: float


@dataclass(frozen=True, slots=True)
class ClientReport:
    """Progress of a move client, the acknowledgement for the planner.

    Attributes:
        revision: Number of the last accepted list; 0 before the first.
        state: State of the client.
        cells: The accepted list; empty after a cancellation.
        reached: The last cell of the list that was reached.
        target: The cell that the robot is sent to.
    """

    revision: int = 0
    state: ClientState = ClientState.CANCELLING
    cells: tuple[int, ...] = ()
    reached: int | None = None
    target: int | None = None


Instruction = SendGoal | SendStop | ClientReport


@dataclass(slots=True)
class MoveClient:
    """Turns lists of cells into navigation goals.

    It begins in ``CANCELLING``: a goal from before a restart of this client may be active, and only the
    robot knows that.

    Time stamps never go back: a robot drops goals that are older than a cancellation, and a cancellation
    does not stop newer goals. When the clock was set back they grow from the newest one, and waits begin
    anew.

    Args:
        grid: Size and place of the cells.
        name: Prefix of goal ids; two clients of one robot must have different ones.
        started: Time of the start, seconds; makes goal ids different from those before a restart.

    Attributes:
        newest_stamp: The newest time stamp of a goal or cancellation, seconds.
    """

    grid: GridMap
    name: str
    started: float
    _report: ClientReport = field(default_factory=ClientReport)
    newest_stamp: float = float("-inf")
    _ahead: float = RECALLED_S
    _now: float = float("-inf")
    _heading: float = 0.0
    _goal: SendGoal | None = None
    _step: int | None = None
    _sent_at: float = float("-inf")
    _quiet_since: float | None = None
    _count: int = 0
    _recent: tuple[ClientEvent, ...] = ()

    @property
    def report(self) -> ClientReport:
        """The current report."""
        return self._report

    def take_cells(self, revision: int | None, cells: list[int], now: float) -> list[Instruction]:
        """Accept a list of cells, unless a newer one is known.

        Args:
            revision: Number of the list, growing; ``None`` if the sender does not number them.
            cells: The cells, from the robot's own on; empty to stop it.
            now: Time, seconds.

        Raises:
            ValueError: The list leaves the map or is not a path; nothing was changed.
        """
        self._see(now)
        known = self._report
        if revision is None:
            if tuple(cells) == known.cells:
                return []
            revision = known.revision + 1
        if revision <= known.revision:
            return []
        if any(cell not in self.grid for cell in cells) or not self.grid.is_path(cells):
            raise ValueError(f"{cells} is not a path on the map")
        if not cells:
            return self._drop(revision, now)
        return self._follow(revision, tuple(cells), now)

    def cancel(self, now: float) -> list[Instruction]:
        """Drop the list and stop the robot."""
        self._see(now)
        return self._drop(self._report.revision, now)

    def take_goal_states(
        self, states: dict[str, GoalState], now: float, newest_stamp: float = float("-inf")
    ) -> list[Instruction]:
        """Handle the robot's status list, with the finished goals in it.

        Args:
            states: State of each goal by its id.
            now: Time, seconds.
            newest_stamp: The newest time stamp of these goals, seconds: of others too, by their clocks.
        """
        self._see(now)
        # One step more: seconds as a number are not exact to the nanosecond.
        self.newest_stamp = max(self.newest_stamp, min(newest_stamp + STAMP_STEP, LATEST_STAMP))
        if self._report.state is ClientState.CANCELLING:
            return self._await_stop(states, now)
        if self._goal is None:
            return []
        state = states.get(self._goal.id)
        if state is None and now - self._sent_at >= REPEAT_AFTER:
            self._sent_at = now
            return [self._goal]
        return self._finished(state, now) if state is not None and state.over else []

    def take_result(self, goal_id: str, state: GoalState, now: float) -> list[Instruction]:
        """Handle the result of a goal; results of replaced goals are ignored."""
        self._see(now)
        if self._goal is None or goal_id != self._goal.id or not state.over:
            return []
        if self._report.state is ClientState.CANCELLING:
            return self._stopped(now)
        return self._finished(state, now)

    def tick(self, now: float) -> list[Instruction]:
        """Send a cancellation that had no effect again; call it a few times a second."""
        self._see(now)
        if self._report.state is ClientState.CANCELLING and now - self._sent_at >= REPEAT_AFTER:
            return [self._make_stop(now)]
        return []

    # Lists

    def _drop(self, revision: int, now: float) -> list[Instruction]:
        self._update(revision=revision, cells=(), reached=None)
        if self._report.state is ClientState.DRIVING:
            return [*self._stop(now), self._report]
        if self._report.state is ClientState.FAILED:
            self._advance(ClientEvent.RENEW)
        return [self._report]

    def _follow(self, revision: int, cells: tuple[int, ...], now: float) -> list[Instruction]:
        before = self._report
        if before.state is ClientState.FAILED:
            self._advance(ClientEvent.RENEW)
        reached = before.reached if before.reached in cells else None
        self._update(revision=revision, cells=cells, reached=reached)
        if before.state is ClientState.DRIVING and before.target not in cells:
            self._update(reached=None)
            return [*self._stop(now), self._report]
        return [*self._proceed(now), self._report]

    def _proceed(self, now: float) -> list[Instruction]:
        """Return the next goal, or a farther one in place of the current one."""
        report = self._report
        if report.state is ClientState.CANCELLING:
            return []
        index = self._next_index()
        if index is None:
            if report.state is ClientState.DRIVING:
                self._advance(ClientEvent.ARRIVE)
                self._update(target=None)
            self._goal = None
            return []
        cell = report.cells[index]
        if report.state is ClientState.DRIVING and cell == report.target:
            return []
        if report.state is ClientState.IDLE:
            self._advance(ClientEvent.DRIVE)
        self._heading = self._heading_to(index)
        self._step = cell - report.cells[index - 1] if index else None
        self._update(target=cell)
        self._count += 1
        stamp = self.newest_stamp = max(now, self.newest_stamp + STAMP_STEP)
        self._goal = SendGoal(f"{self.name}-{self.started:.3f}-{self._count}", stamp, cell, self._heading)
        self._sent_at = now
        return [self._goal]

    def _next_index(self) -> int | None:
        """Return the index of the farthest cell straight ahead; ``None`` at the end of the list.

        The first cell of a list is a goal of its own, because the robot's direction before it is unknown.
        """
        cells, target, reached = self._report.cells, self._report.target, self._report.reached
        if self._report.state is ClientState.DRIVING and target in cells:
            index, step = cells.index(target), self._step
        elif reached in cells:
            index = cells.index(reached) + 1
            if index == len(cells):
                return None
            step = cells[index] - cells[index - 1]
        else:
            return 0 if cells else None
        while step is not None and index + 1 < len(cells) and cells[index + 1] - cells[index] == step:
            index += 1
        return index

    def _heading_to(self, index: int) -> float:
        """Return the direction of travel at a cell of the list; at the first, towards the second."""
        cells = self._report.cells
        if len(cells) == 1:
            return self._heading
        before, after = (cells[index - 1], cells[index]) if index else (cells[0], cells[1])
        (x, y), (to_x, to_y) = self.grid.centre(before), self.grid.centre(after)
        return atan2(to_y - y, to_x - x)

    # Goals

    def _finished(self, state: GoalState, now: float) -> list[Instruction]:
        self._goal = None
        if state is GoalState.RECALLED:
            # A stop is newer than the goal: one by an earlier client, whose clock was ahead. Robots do not
            # tell the time stamps of stops.
            self.newest_stamp = min(max(now, self.newest_stamp) + self._ahead, LATEST_STAMP)
            self._ahead *= RECALLED_FACTOR
        else:
            self._ahead = RECALLED_S
        if state is not GoalState.SUCCEEDED:
            self._advance(ClientEvent.FAIL)
            self._update(cells=(), reached=None, target=None)
            return [self._report]
        self._update(reached=self._report.target)
        self._advance(ClientEvent.ARRIVE)
        self._update(target=None)
        return [*self._proceed(now), self._report]

    def _stop(self, now: float) -> list[Instruction]:
        self._advance(ClientEvent.STOP)
        self._update(target=None)
        return [self._make_stop(now)]

    def _make_stop(self, now: float) -> SendStop:
        self._sent_at = now
        self.newest_stamp = max(now, self.newest_stamp)
        return SendStop(self.newest_stamp)

    def _await_stop(self, states: dict[str, GoalState], now: float) -> list[Instruction]:
        """Return whether all goals have ended.

        The goal of this client must be listed as ended. Goals that were lost or are from before a restart
        cannot be checked: no goal must have been active for a while; the cancellation's time stamp stops
        those that arrive later.
        """
        if self._sent_at == float("-inf"):
            return self.tick(now)
        if any(not state.over for state in states.values()):
            self._quiet_since = None
            return []
        if self._goal is not None and self._goal.id in states:
            return self._stopped(now)
        if self._quiet_since is None:
            self._quiet_since = now
        return self._stopped(now) if now - self._quiet_since >= QUIET_TIME else []

    def _stopped(self, now: float) -> list[Instruction]:
        self._goal = self._quiet_since = None
        self._advance(ClientEvent.STOPPED)
        return [*self._proceed(now), self._report]

    # Time and state

    def _see(self, now: float) -> None:
        """Note the time; if the clock was set back, waits begin anew."""
        if now < self._now:
            self._sent_at = min(self._sent_at, now)
            self._quiet_since = None
        self._now = now

    def _advance(self, event: ClientEvent) -> None:
        state = CLIENT_LIFE.advance(self._report.state, event, self.name, self._recent)
        self._recent = remember(self._recent, event)
        self._update(state=state)

    def _update(self, **changes: Any) -> None:
        self._report = replace(self._report, **changes)
