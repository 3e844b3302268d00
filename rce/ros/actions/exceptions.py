"""Errors of actions.

::

    RosError
    +-- ActionError
        +-- GoalFailedError         a goal ended without success: how, why, and with which result
        +-- IllegalTransitionError  a goal cannot do that in its present state (misuse, or a peer out of step)
        +-- UnknownGoalError        a server was asked about a goal that it does not remember
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.lifecycle import InvalidTransitionError
from rce.ros.errors import RosError

if TYPE_CHECKING:
    from rce.ros.actions.states import GoalState
    from rce.ros.types import Message


class ActionError(RosError):
    """Base of all errors of :mod:`rce.ros.actions`."""


class GoalFailedError(ActionError):
    """A goal did not succeed.

    Attributes:
        goal_id: Which goal.
        state: How it ended: aborted, rejected, preempted, recalled or lost.
        text: The server's text on it.
        result: The result, which comes for failed goals too; None for a lost goal.
    """

    def __init__(self, goal_id: str, state: GoalState, text: str, result: Message | None) -> None:
        super().__init__(goal_id, state, text, result)
        self.goal_id = goal_id
        self.state = state
        self.text = text
        self.result = result

    def __str__(self) -> str:
        reason = f": {self.text}" if self.text else ""
        return f"goal {self.goal_id} was {self.state.name.lower()}{reason}"


class IllegalTransitionError(InvalidTransitionError, ActionError):
    """An event does not fit the state of a goal; nothing was changed.

    For a client's goal, the event is the state that its server reported.
    """


class UnknownGoalError(ActionError, LookupError):
    """The server does not know the goal, or no longer.

    Attributes:
        goal_id: Which goal.
    """

    def __init__(self, goal_id: str) -> None:
        super().__init__(goal_id)
        self.goal_id = goal_id

    def __str__(self) -> str:
        return f"there is no goal {self.goal_id}"
