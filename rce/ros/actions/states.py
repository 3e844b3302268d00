"""The states of a goal, as its server and its client see them: two tables. Pure.

The server's table is that of http://wiki.ros.org/actionlib/DetailedDescription, "Server Description"; the
client's is "Client Description" there: what a client makes of each status that a server reports, also when
it missed some on the way.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, IntEnum, auto

from rce.lifecycle import LifeCycle
from rce.ros.actions.exceptions import IllegalTransitionError


class GoalState(IntEnum):
    """The server's view of a goal; the numbers are those of ``actionlib_msgs/GoalStatus``."""

    PENDING = 0
    """The server has it and has not decided yet."""
    ACTIVE = 1
    """The server works on it."""
    PREEMPTED = 2
    """Ended: cancelled while it was worked on."""
    SUCCEEDED = 3
    """Ended: reached."""
    ABORTED = 4
    """Ended: the server gave it up."""
    REJECTED = 5
    """Ended: the server did not accept it."""
    PREEMPTING = 6
    """Active, and asked to end."""
    RECALLING = 7
    """Pending, and asked to end."""
    RECALLED = 8
    """Ended: cancelled before it was worked on."""
    LOST = 9
    """Ended, for its client only: the server does not know it, or is gone."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more will happen to the goal."""
        return self in _OVER


_OVER = frozenset(
    {
        GoalState.PREEMPTED,
        GoalState.SUCCEEDED,
        GoalState.ABORTED,
        GoalState.REJECTED,
        GoalState.RECALLED,
        GoalState.LOST,
    }
)


class GoalEvent(Enum):
    """An event of a goal at its server."""

    ACCEPT = auto()
    """The server begins to work on it."""
    REJECT = auto()
    """The server will not work on it."""
    REQUEST_CANCEL = auto()
    """A client asks to end it."""
    CANCEL = auto()
    """The server ended it early, as asked."""
    SUCCEED = auto()
    """The server reached it."""
    ABORT = auto()
    """The server gave it up."""


_S, _E = GoalState, GoalEvent

GOAL_LIFE: LifeCycle[GoalState, GoalEvent] = LifeCycle(
    "goal",
    {
        _S.PENDING: {
            _E.ACCEPT: _S.ACTIVE,
            _E.REJECT: _S.REJECTED,
            _E.REQUEST_CANCEL: _S.RECALLING,
            _E.CANCEL: _S.RECALLED,
        },
        _S.RECALLING: {
            _E.ACCEPT: _S.PREEMPTING,
            _E.REJECT: _S.REJECTED,
            _E.CANCEL: _S.RECALLED,
        },
        _S.ACTIVE: {
            _E.REQUEST_CANCEL: _S.PREEMPTING,
            _E.CANCEL: _S.PREEMPTED,
            _E.SUCCEED: _S.SUCCEEDED,
            _E.ABORT: _S.ABORTED,
        },
        _S.PREEMPTING: {
            _E.CANCEL: _S.PREEMPTED,
            _E.SUCCEED: _S.SUCCEEDED,
            _E.ABORT: _S.ABORTED,
        },
        _S.REJECTED: {},
        _S.RECALLED: {},
        _S.PREEMPTED: {},
        _S.SUCCEEDED: {},
        _S.ABORTED: {},
        _S.LOST: {},
    },
    error=IllegalTransitionError,
)
"""A goal at its server. Transitions that are not listed are illegal."""


class CommState(Enum):
    """The client's view of a goal; the numbers are those of rospy's actionlib."""

    WAITING_FOR_GOAL_ACK = 0
    """Sent; the server has not listed it yet."""
    PENDING = 1
    """The server lists it as pending."""
    ACTIVE = 2
    """The server works on it."""
    WAITING_FOR_RESULT = 3
    """The server lists it as ended; the result is still to come."""
    WAITING_FOR_CANCEL_ACK = 4
    """The client asked to end it; the server does not show that it knows."""
    RECALLING = 5
    """The server knows that a goal it has not accepted yet is to end."""
    PREEMPTING = 6
    """The server knows that a goal it works on is to end."""
    DONE = 7
    """The result is there, or the goal is lost."""


_C = CommState

CLIENT_TRANSITIONS: Mapping[CommState, Mapping[GoalState, tuple[CommState, ...]]] = {
    _C.WAITING_FOR_GOAL_ACK: {
        _S.PENDING: (_C.PENDING,),
        _S.ACTIVE: (_C.ACTIVE,),
        _S.REJECTED: (_C.PENDING, _C.WAITING_FOR_RESULT),
        _S.RECALLING: (_C.PENDING, _C.RECALLING),
        _S.RECALLED: (_C.PENDING, _C.WAITING_FOR_RESULT),
        _S.PREEMPTING: (_C.ACTIVE, _C.PREEMPTING),
        _S.PREEMPTED: (_C.ACTIVE, _C.PREEMPTING, _C.WAITING_FOR_RESULT),
        _S.SUCCEEDED: (_C.ACTIVE, _C.WAITING_FOR_RESULT),
        _S.ABORTED: (_C.ACTIVE, _C.WAITING_FOR_RESULT),
    },
    _C.PENDING: {
        _S.PENDING: (),
        _S.ACTIVE: (_C.ACTIVE,),
        _S.REJECTED: (_C.WAITING_FOR_RESULT,),
        _S.RECALLING: (_C.RECALLING,),
        _S.RECALLED: (_C.RECALLING, _C.WAITING_FOR_RESULT),
        _S.PREEMPTING: (_C.ACTIVE, _C.PREEMPTING),
        _S.PREEMPTED: (_C.ACTIVE, _C.PREEMPTING, _C.WAITING_FOR_RESULT),
        _S.SUCCEEDED: (_C.ACTIVE, _C.WAITING_FOR_RESULT),
        _S.ABORTED: (_C.ACTIVE, _C.WAITING_FOR_RESULT),
    },
    _C.ACTIVE: {
        _S.ACTIVE: (),
        _S.PREEMPTING: (_C.PREEMPTING,),
        _S.PREEMPTED: (_C.PREEMPTING, _C.WAITING_FOR_RESULT),
        _S.SUCCEEDED: (_C.WAITING_FOR_RESULT,),
        _S.ABORTED: (_C.WAITING_FOR_RESULT,),
    },
    _C.WAITING_FOR_CANCEL_ACK: {
        _S.PENDING: (),
        _S.ACTIVE: (),
        _S.REJECTED: (_C.WAITING_FOR_RESULT,),
        _S.RECALLING: (_C.RECALLING,),
        _S.RECALLED: (_C.RECALLING, _C.WAITING_FOR_RESULT),
        _S.PREEMPTING: (_C.PREEMPTING,),
        _S.PREEMPTED: (_C.PREEMPTING, _C.WAITING_FOR_RESULT),
        _S.SUCCEEDED: (_C.PREEMPTING, _C.WAITING_FOR_RESULT),
        _S.ABORTED: (_C.PREEMPTING, _C.WAITING_FOR_RESULT),
    },
    _C.RECALLING: {
        _S.RECALLING: (),
        _S.REJECTED: (_C.WAITING_FOR_RESULT,),
        _S.RECALLED: (_C.WAITING_FOR_RESULT,),
        _S.PREEMPTING: (_C.PREEMPTING,),
        _S.PREEMPTED: (_C.PREEMPTING, _C.WAITING_FOR_RESULT),
        _S.SUCCEEDED: (_C.PREEMPTING, _C.WAITING_FOR_RESULT),
        _S.ABORTED: (_C.PREEMPTING, _C.WAITING_FOR_RESULT),
    },
    _C.PREEMPTING: {
        _S.PREEMPTING: (),
        _S.PREEMPTED: (_C.WAITING_FOR_RESULT,),
        _S.SUCCEEDED: (_C.WAITING_FOR_RESULT,),
        _S.ABORTED: (_C.WAITING_FOR_RESULT,),
    },
    _C.WAITING_FOR_RESULT: {
        # A status that was on its way when the result was.
        _S.ACTIVE: (),
        _S.REJECTED: (),
        _S.RECALLED: (),
        _S.PREEMPTED: (),
        _S.SUCCEEDED: (),
        _S.ABORTED: (),
    },
    _C.DONE: {_S.REJECTED: (), _S.RECALLED: (), _S.PREEMPTED: (), _S.SUCCEEDED: (), _S.ABORTED: ()},
}
"""For each state and reported status, the states that the client passes; what is not here cannot be."""
