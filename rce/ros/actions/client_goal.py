"""A goal as the requesting program sees it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from typing import TYPE_CHECKING, Any

from rce.aio.queues import BoundedQueue
from rce.ros.actions.exceptions import GoalFailedError
from rce.ros.actions.goal_id import GoalId
from rce.ros.actions.states import CommState, GoalState
from rce.ros.actions.tracker import GoalTracker
from rce.ros.node.settings import MAX_QUEUED_BYTES

if TYPE_CHECKING:
    from rce.ros.types import Message, Time

_log = logging.getLogger(__name__)

FEEDBACK_QUEUE = 100
"""How many feedbacks wait for an iteration before the oldest is dropped."""

FeedbackCallback = Callable[[Any], None]
"""Called with each feedback message; must not block."""

ChangeCallback = Callable[["ClientGoal"], None]
"""Called with the goal after each change of its state; must not block."""


class ClientGoal:
    """One goal of an action client. Made by :meth:`rce.ros.actions.ActionClient.send`.

    An async iterator over the feedback; it ends when the goal is over. The result has a connection of its
    own and may overtake the last feedback, which is dropped then, as in all of actionlib.
    """

    def __init__(
        self,
        goal_id: GoalId,
        tracker: GoalTracker,
        send_cancel: Callable[[ClientGoal], None],
        on_feedback: FeedbackCallback | None,
        on_change: ChangeCallback | None,
    ) -> None:
        self.goal_id = goal_id
        self.tracker = tracker
        """The goal's state."""
        self._send_cancel = send_cancel
        self._on_feedback = on_feedback
        self._on_change = on_change
        self._result: Message | None = None
        self._done = asyncio.Event()
        self._feedback: BoundedQueue[Message] = BoundedQueue(FEEDBACK_QUEUE, MAX_QUEUED_BYTES)
        self._arrived = asyncio.Event()

    def __repr__(self) -> str:
        return f"<ClientGoal {self.id} {self.state.name} {self.comm_state.name}>"

    @property
    def id(self) -> str:
        """The goal's name, unique in the graph."""
        return self.goal_id.id

    @property
    def stamp(self) -> Time:
        """When it was made; what :meth:`~rce.ros.actions.ActionClient.cancel_before` goes by."""
        return self.goal_id.time

    @property
    def state(self) -> GoalState:
        """The goal's state, as its server last said."""
        return self.tracker.state

    @property
    def comm_state(self) -> CommState:
        """The state of the communication with the server."""
        return self.tracker.comm

    @property
    def text(self) -> str:
        """The server's text on the goal's state."""
        return self.tracker.text

    @property
    def is_done(self) -> bool:
        """Whether the result has come or the goal is lost."""
        return self.tracker.is_done

    def cancel(self) -> None:
        """Ask the server to end the goal; without effect once it is over. The result tells how it ended."""
        if not self.is_done:
            self._send_cancel(self)

    async def wait(self, timeout: float | None = None) -> GoalState:
        """Wait until it is over.

        Returns:
            How it ended.

        Raises:
            TimeoutError: It is not over within ``timeout`` seconds; it continues.
        """
        async with asyncio.timeout(timeout):
            await self._done.wait()
        return self.state

    async def result(self, timeout: float | None = None) -> Message:
        """Wait for the result. A caller that is cancelled does not cancel the goal.

        Raises:
            GoalFailedError: It ended in another way than by success.
            TimeoutError: It is not over within ``timeout`` seconds; it continues.
        """
        state = await self.wait(timeout)
        if state is not GoalState.SUCCEEDED or self._result is None:
            raise GoalFailedError(self.id, state, self.text, self._result)
        return self._result

    def __aiter__(self) -> AsyncIterator[Message]:
        return self

    async def __anext__(self) -> Message:
        while not self._feedback:
            if self.is_done:
                raise StopAsyncIteration
            self._arrived.clear()
            await self._arrived.wait()
        return self._feedback.take()

    # For the client

    def feedback_received(self, feedback: Message) -> None:
        """Take feedback."""
        if self.is_done:
            return
        if self._on_feedback is not None:
            self._call(self._on_feedback, feedback)
        else:
            self._feedback.put(feedback, 0)
            self._arrived.set()

    def changed(self, passed: tuple[CommState, ...], result: Message | None = None) -> None:
        """Take a change of the tracker's state."""
        if not passed:
            return
        if self.is_done:
            self._result = result
            self._done.set()
            self._arrived.set()
        if self._on_change is not None:
            self._call(self._on_change, self)

    def _call(self, callback: Callable[[Any], None], argument: object) -> None:
        try:
            callback(argument)
        except Exception:  # noqa: BLE001 - the program's own fault, which must not stop the client
            _log.exception("a callback of goal %s failed", self.id)
