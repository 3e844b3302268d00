"""Work on one goal: kinds of handlers, and how a handler's end ends the goal."""

from __future__ import annotations

import inspect
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import aclosing
from typing import TYPE_CHECKING, Any

from rce.ros.actions.server_goal import Content, ServerGoal
from rce.ros.actions.states import GoalState

if TYPE_CHECKING:
    from rce.ros.types import Message

Handler = Callable[[ServerGoal], Awaitable["Message | Content | None"] | AsyncGenerator[Any, None]]
"""Works on one goal: a coroutine function that returns the result, or an async generator of feedback."""

_NOT_ACCEPTED = frozenset({GoalState.PENDING, GoalState.RECALLING})


async def call(handler: Handler, goal: ServerGoal) -> Message | Content | None:
    """Let a handler work on a goal and return its result, if it returned one."""
    running: Any = handler(goal)
    if inspect.isawaitable(running):
        result: Message | Content | None = await running
        return result
    async with aclosing(running):
        async for feedback in running:
            goal.publish_feedback(feedback)
    return None


def conclude(goal: ServerGoal, result: Message | Content | None) -> None:
    """End a goal whose handler has returned, unless the handler ended it."""
    if goal.state.is_over:
        return
    if goal.state in _NOT_ACCEPTED:
        goal.reject("the server did not accept the goal")
    elif result is None and goal.cancel_requested:
        goal.cancel()
    else:
        goal.succeed(result)


def give_up(goal: ServerGoal, text: str) -> None:
    """End a goal that no handler works on any more, unless it is over."""
    if goal.state in _NOT_ACCEPTED:
        goal.reject(text)
    elif not goal.state.is_over:
        goal.abort(text)
