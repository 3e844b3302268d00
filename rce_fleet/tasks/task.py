"""A task and its life cycle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from rce.lifecycle import LifeCycle
from rce_fleet.exceptions import TransitionError
from rce_fleet.tasks.order import Action, Order, Stop


class TaskState(Enum):
    """State of a task."""

    QUEUED = "queued"
    """It waits for a robot, its earliest start, or tasks that come before it."""
    ASSIGNED = "assigned"
    """It is in a robot's queue; the robot has not begun with it."""
    RUNNING = "running"
    """A robot drives to a stop, or does something there."""
    HELD = "held"
    """A person or program holds it. A robot that carries its load stands still; else it has no robot."""
    SUSPENDED = "suspended"
    """The robot that has its load or acts for it cannot continue now; it continues when the robot can."""
    CANCELLING = "cancelling"
    """It was cancelled; its robot ends its action and brings the load away."""
    DONE = "done"
    """All stops were made."""
    FAILED = "failed"
    """It cannot be carried out; ``reason`` says why."""
    CANCELLED = "cancelled"
    """It was cancelled, and no robot carries its load."""


class TaskCause(Enum):
    """Causes of a change of a task's state."""

    ASSIGN = "assigned"
    """It was put into a robot's queue."""
    START = "started"
    """A robot begins with it."""
    RELEASE = "released"
    """Its robot gave it up; another one may take it."""
    HOLD = "held"
    """It was put on hold."""
    RESUME = "resumed"
    """The hold ended, and no robot has its load."""
    CONTINUE = "continued"
    """Its robot, which has its load, continues."""
    SUSPEND = "suspended"
    """Its robot has its load or acts for it, and cannot continue."""
    CANCEL = "cancelled"
    """It was cancelled, or its robot brought the load away after that."""
    RETURN = "returning"
    """It was cancelled while a robot had its load or acted for it."""
    FINISH = "finished"
    """All stops were made."""
    FAIL = "failed"
    """A rule ends it without success."""


TASK_LIFE: LifeCycle[TaskState, TaskCause] = LifeCycle(
    "task",
    {
        TaskState.QUEUED: {
            TaskCause.ASSIGN: TaskState.ASSIGNED,
            TaskCause.START: TaskState.RUNNING,
            TaskCause.FINISH: TaskState.DONE,
            TaskCause.HOLD: TaskState.HELD,
            TaskCause.CANCEL: TaskState.CANCELLED,
            TaskCause.FAIL: TaskState.FAILED,
        },
        TaskState.ASSIGNED: {
            TaskCause.ASSIGN: TaskState.ASSIGNED,
            TaskCause.START: TaskState.RUNNING,
            TaskCause.FINISH: TaskState.DONE,
            TaskCause.RELEASE: TaskState.QUEUED,
            TaskCause.HOLD: TaskState.HELD,
            TaskCause.CANCEL: TaskState.CANCELLED,
            TaskCause.FAIL: TaskState.FAILED,
        },
        TaskState.RUNNING: {
            TaskCause.FINISH: TaskState.DONE,
            TaskCause.RELEASE: TaskState.QUEUED,
            TaskCause.HOLD: TaskState.HELD,
            TaskCause.SUSPEND: TaskState.SUSPENDED,
            TaskCause.CANCEL: TaskState.CANCELLED,
            TaskCause.RETURN: TaskState.CANCELLING,
            TaskCause.FAIL: TaskState.FAILED,
        },
        TaskState.HELD: {
            TaskCause.RESUME: TaskState.QUEUED,
            TaskCause.CONTINUE: TaskState.RUNNING,
            TaskCause.CANCEL: TaskState.CANCELLED,
            TaskCause.RETURN: TaskState.CANCELLING,
            TaskCause.FAIL: TaskState.FAILED,
        },
        TaskState.SUSPENDED: {
            TaskCause.FINISH: TaskState.DONE,
            TaskCause.RELEASE: TaskState.QUEUED,
            TaskCause.CONTINUE: TaskState.RUNNING,
            TaskCause.HOLD: TaskState.HELD,
            TaskCause.CANCEL: TaskState.CANCELLED,
            TaskCause.RETURN: TaskState.CANCELLING,
            TaskCause.FAIL: TaskState.FAILED,
        },
        TaskState.CANCELLING: {
            TaskCause.CANCEL: TaskState.CANCELLED,
            TaskCause.FAIL: TaskState.FAILED,
        },
        TaskState.DONE: {},
        TaskState.FAILED: {},
        TaskState.CANCELLED: {},
    },
    error=TransitionError,
)

ENDED = frozenset(state for state, row in TASK_LIFE.table.items() if not row)
"""States that a task does not leave."""


@dataclass(frozen=True, slots=True)
class StopVisit:
    """A stop that a robot reached. Times are seconds since 1970.

    Attributes:
        stop: Number of the stop, from 0 over all rounds; -1: the return of the load.
        robot: The robot.
        cell: Where.
        started_at: When it arrived, and its action began.
        ended_at: When the action ended; None: it is under way.
    """

    stop: int
    robot: str
    cell: int
    started_at: float
    ended_at: float | None = None


RETURN = -1
"""Number of the stop at which a cancelled task's load is given away."""


@dataclass(frozen=True, slots=True)
class Task:
    """A task. Immutable; changes make a new one. Times are seconds since 1970.

    Attributes:
        number: Counts the fleet's tasks from 1.
        order: What is to be done.
        requester: Who asked for it.
        key: The requester's own key; empty: none.
        created_at: When it was accepted.
        state: Its state.
        changed_at: When the state changed last.
        revision: Grows by one with each change.
        robot: The robot that does it, or whose queue it is in; empty: none.
        target: The cell that the robot goes to, or acts in.
        visits: Stops that were reached.
        position: Number of stops whose actions have ended.
        confirmed: Whether the end of the present action was confirmed.
        loads: Loads that the robot carries for it.
        reason: Why it waits, is suspended or has failed, for people.
        started_at: When a robot first began with it.
        late: Whether its deadline has passed before it was done.
        occurrence: Number of a recurring task's occurrence, from 1.
        recurs_at: When its next occurrence is due; None: there is none.
        cancelled_by: Who cancelled it.
        asked: Digest of the first order, to recognize a second request with the same key.
        is_stranded: Whether the robot that brings the load of a cancelled task away does not answer, or finds
            no way.
    """

    number: int
    order: Order
    requester: str
    key: str
    created_at: float
    changed_at: float
    state: TaskState = TaskState.QUEUED
    revision: int = 1
    robot: str = ""
    target: int | None = None
    visits: tuple[StopVisit, ...] = ()
    position: int = 0
    confirmed: bool = False
    loads: int = 0
    reason: str = ""
    started_at: float | None = None
    late: bool = False
    occurrence: int = 1
    recurs_at: float | None = None
    cancelled_by: str = ""
    asked: str = ""
    is_stranded: bool = False

    @property
    def id(self) -> str:
        """Its name: ``T12``."""
        return f"T{self.number}"

    @property
    def has_ended(self) -> bool:
        """Whether it is done, failed or cancelled."""
        return self.state in ENDED

    @property
    def can_be_cancelled(self) -> bool:
        """Whether a cancel changes it: it is open and was not cancelled, or another occurrence follows."""
        return self.recurs_at is not None if self.has_ended else self.state is not TaskState.CANCELLING

    @property
    def is_loaded(self) -> bool:
        """Whether a robot carries a load for it."""
        return self.loads > 0

    @property
    def action(self) -> StopVisit | None:
        """The visit whose action is under way; None: there is none."""
        if self.visits and self.visits[-1].ended_at is None:
            return self.visits[-1]
        return None

    @property
    def next_stop(self) -> Stop | None:
        """The stop that comes next, or whose action is under way; None after the last."""
        return self.order.stop(self.position) if self.position < self.order.length else None

    @property
    def is_bound(self) -> bool:
        """Whether only its present robot can continue: it has the load, or acts."""
        return self.is_loaded or self.action is not None

    @property
    def question(self) -> str:
        """What people have to decide about it, in words; empty: nothing."""
        waits = self.state is TaskState.SUSPENDED or (self.state is TaskState.CANCELLING and self.is_stranded)
        if not self.is_loaded or self.action is not None or not waits:
            return ""
        return f"Where is the load that {self.robot} has? Wait for the robot, or say where the load is."

    @property
    def load_from(self) -> int | None:
        """The cell where the load that the robot carries was taken."""
        for visit in reversed(self.visits):
            if visit.stop >= 0 and self.order.stop(visit.stop).action is Action.PICK:
                return visit.cell
        return None

    def after(self, cause: TaskCause, now: float, reason: str = "") -> Task:
        """Return the task after a change of its state.

        Raises:
            TransitionError: Its state does not allow the cause. Nothing was changed.
        """
        state = TASK_LIFE.advance(self.state, cause, self.id)
        return replace(self, state=state, changed_at=now, revision=self.revision + 1, reason=reason)
