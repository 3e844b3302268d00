"""A goal as the program that works on it sees it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from rce.aio.tasks import cancel_and_wait
from rce.ros.actions.goal_id import GoalId
from rce.ros.actions.ledger import Entry
from rce.ros.actions.states import GoalEvent, GoalState

if TYPE_CHECKING:
    from rce.ros.types import Message, Time

Content = Mapping[str, Any]
"""The fields of a message."""


class GoalServer(Protocol):
    """The server, as its goals use it."""

    def transition(self, entry: Entry, event: GoalEvent, text: str, result: Message | Content | None) -> None:
        """Apply an event to a goal and tell its clients."""

    def publish_feedback(self, entry: Entry, feedback: Message | Content) -> None:
        """Publish feedback to the goal's clients."""

    async def sleep(self, seconds: float) -> bool:
        """Sleep in ROS time; return whether the node continues."""


class ServerGoal:
    """One goal of an action server; what handlers are called with.

    Attributes:
        request: The goal's content, a message of the action's ``Goal`` type.
    """

    def __init__(self, server: GoalServer, entry: Entry, request: Message) -> None:
        self.request = request
        self._server = server
        self._entry = entry
        self._stop = asyncio.Event()

    def __repr__(self) -> str:
        return f"<ServerGoal {self.id} {self.state.name}>"

    @property
    def goal_id(self) -> GoalId:
        """The goal's name and stamp."""
        return self._entry.goal_id

    @property
    def id(self) -> str:
        """The goal's name, unique in the graph."""
        return self._entry.goal_id.id

    @property
    def stamp(self) -> Time:
        """When the client made the goal."""
        return self._entry.goal_id.time

    @property
    def state(self) -> GoalState:
        """The goal's state."""
        return self._entry.state

    @property
    def text(self) -> str:
        """The latest text on the goal's state."""
        return self._entry.text

    # Transitions

    def accept(self, text: str = "") -> None:
        """Begin to work on it.

        Raises:
            IllegalTransitionError: It was accepted already, or is over.
        """
        self._server.transition(self._entry, GoalEvent.ACCEPT, text, None)

    def reject(self, text: str = "", result: Message | Content | None = None) -> None:
        """Refuse to work on it.

        Raises:
            IllegalTransitionError: It was accepted already, or is over.
        """
        self._server.transition(self._entry, GoalEvent.REJECT, text, result)

    def succeed(self, result: Message | Content | None = None, text: str = "") -> None:
        """End the goal with success. ``result`` is a message, or a mapping of its fields.

        Raises:
            IllegalTransitionError: It was not accepted, or is over.
            SerializationError: The result does not fit its type; the goal continues.
        """
        self._server.transition(self._entry, GoalEvent.SUCCEED, text, result)

    def abort(self, text: str = "", result: Message | Content | None = None) -> None:
        """End the goal without success.

        Raises:
            IllegalTransitionError: It was not accepted, or is over.
            SerializationError: The result does not fit its type; the goal continues.
        """
        self._server.transition(self._entry, GoalEvent.ABORT, text, result)

    def cancel(self, text: str = "", result: Message | Content | None = None) -> None:
        """End it early: preempted if it was accepted, else recalled.

        Raises:
            IllegalTransitionError: It is over.
            SerializationError: The result does not fit its type; the goal continues.
        """
        self._server.transition(self._entry, GoalEvent.CANCEL, text, result)

    def publish_feedback(self, feedback: Message | Content | None = None, /, **fields: Any) -> None:
        """Publish feedback, given as a message, as a mapping of its fields, or by its fields.

        Raises:
            SerializationError: A value does not fit its field.
        """
        self._server.publish_feedback(self._entry, fields if feedback is None else feedback)

    # Cancellation

    @property
    def cancel_requested(self) -> bool:
        """Whether a client, or a newer goal of a simple server, asks to end it."""
        return self._stop.is_set()

    async def wait_for_cancel(self) -> None:
        """Wait until it is asked to end."""
        await self._stop.wait()

    async def sleep(self, seconds: float) -> bool:
        """Sleep in ROS time, or wake up early because the goal is asked to end or the node to stop.

        Simulated time that jumps back wakes up too.

        Returns:
            Whether to go on: ``while await goal.sleep(0.1): ...``.
        """
        sleeping = asyncio.ensure_future(self._server.sleep(seconds))
        stopping = asyncio.ensure_future(self._stop.wait())
        try:
            await asyncio.wait((sleeping, stopping), return_when=asyncio.FIRST_COMPLETED)
            return not self._stop.is_set() and sleeping.result()
        finally:
            await cancel_and_wait(sleeping, stopping)

    def request_cancel(self) -> None:
        """Ask the handler to end the goal. The server calls this; a program may too."""
        self._stop.set()
