"""Action clients: the five topics of an action, and a tracker for each goal."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from contextlib import AsyncExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rce.aio.tasks import TaskScope, run_until_first
from rce.ros.actions import topics
from rce.ros.actions.client_goal import ChangeCallback, ClientGoal, FeedbackCallback
from rce.ros.actions.exceptions import IllegalTransitionError
from rce.ros.actions.goal_id import GoalId
from rce.ros.actions.states import CommState, GoalState
from rce.ros.actions.tracker import GoalTracker, SilenceClock
from rce.ros.closing import release
from rce.ros.errors import NodeClosedError

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher, Subscriber
    from rce.ros.types import Message, Time

_log = logging.getLogger(__name__)

SILENCE_TIMEOUT = 10.0
"""Seconds without a status of the server, which should send five a second, after which its goals are lost."""

TICK = 0.25
"""Seconds between checks whether a message must be repeated or a goal given up, while goals are under way."""


class ActionClient:
    """Uses an action, with any number of goals at the same time. An async context manager.

    ``async with ActionClient(node, "fibonacci", "actionlib_tutorials/FibonacciAction") as client:``
    ``goal = await client.send(order=5)``, ``print(await goal.result())``

    Leaving the block forgets the goals: they continue at the server, and count as lost here.

    Attributes:
        name: The action's global name.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        action_type: str,
        *,
        silence_timeout: float = SILENCE_TIMEOUT,
    ) -> None:
        """Prepare a client.

        Args:
            node: The node that it is part of; it must be running while the client is.
            name: The action's name: the namespace of its topics.
            action_type: Its type, such as ``actionlib_tutorials/FibonacciAction``; ``Action`` may be left
                out.
            silence_timeout: Seconds without a message of the server after which its goals are lost;
                ``math.inf``: never.
                Time does not count while simulated time stands still.
        """
        self.name = node.resolve(name)
        self._node = node
        self._types = topics.ActionTypes.named(action_type)
        self._silence_timeout = silence_timeout
        self._goals: dict[str, ClientGoal] = {}
        self._payloads: dict[str, bytes] = {}
        self._heard_at = 0.0
        self._heard = asyncio.Event()
        self._busy = asyncio.Event()
        self._stack = AsyncExitStack()
        self._clock: SilenceClock
        self._goal: Publisher
        self._cancel: Publisher
        self._inputs: list[Subscriber] = []

    def __repr__(self) -> str:
        return f"<ActionClient {self.name} {len(self._goals)} goals>"

    @property
    def goals(self) -> tuple[ClientGoal, ...]:
        """The goals that are not over, the oldest first."""
        return tuple(self._goals.values())

    # Life

    async def __aenter__(self) -> Self:
        node, types = self._node, self._types
        self._clock = _silence_clock(node)
        async with AsyncExitStack() as stack:
            stack.callback(self._lose_all, "the client was closed")
            self._goal = await node.advertise(f"{self.name}/goal", types.action_goal)
            stack.push_async_callback(release, self._goal)
            self._cancel = await node.advertise(f"{self.name}/cancel", topics.GOAL_ID)
            stack.push_async_callback(release, self._cancel)
            for topic, message_type, callback in (
                ("feedback", types.action_feedback, self._feedback_received),
                ("result", types.action_result, self._result_received),
                ("status", topics.STATUS, self._status_received),
            ):
                subscriber = await node.subscribe(f"{self.name}/{topic}", message_type, callback)
                stack.push_async_callback(release, subscriber)
                self._inputs.append(subscriber)
            tasks = await stack.enter_async_context(TaskScope())  # ends first: it publishes
            tasks.spawn(self._look_after_goals(), name=f"goals of {self.name}")
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()
        self._inputs.clear()

    # For programs

    async def wait_for_server(self, timeout: float | None = None) -> None:
        """Wait until a server has spoken and all five topics are connected.

        Raises:
            TimeoutError: No server was connected within ``timeout`` seconds.
            NodeClosedError: The node was told to stop.
        """
        async with asyncio.timeout(timeout):
            if not self._heard.is_set():
                await run_until_first(self._heard.wait(), self._node.until_shutdown())
                if not self._heard.is_set():
                    raise NodeClosedError(f"node {self._node.name} was told to stop")
            await self._goal.wait_for_subscribers()
            await self._cancel.wait_for_subscribers()
            for subscriber in self._inputs:
                await subscriber.wait_for_publishers()

    async def send(
        self,
        goal: Message | Mapping[str, Any] | None = None,
        /,
        *,
        on_feedback: FeedbackCallback | None = None,
        on_change: ChangeCallback | None = None,
        **fields: Any,
    ) -> ClientGoal:
        """Wait for a server and send it a goal.

        Args:
            goal: The goal, as a message of the action's ``Goal`` type or a mapping of its fields.
            on_feedback: Called with each feedback message; without it, iterate over the goal.
            on_change: Called with the goal after each change of its state.
            fields: The goal's fields, in place of ``goal``.

        Raises:
            SerializationError: A value does not fit its field.
            NodeClosedError: The node was told to stop.
        """
        if goal is not None and fields:
            raise TypeError("give a goal or its fields, not both")
        now = self._node.now()
        goal_id = GoalId.make(self._node.name, now)
        message = self._goal.type.new(
            header={"stamp": now}, goal_id=goal_id.fields, goal=fields if goal is None else goal
        )
        payload = self._goal.type.serialize(message)
        await self.wait_for_server()
        time = self._clock.now()
        sent = ClientGoal(
            goal_id, GoalTracker(goal_id.id, time, time), self._send_cancel, on_feedback, on_change
        )
        self._goals[sent.id], self._payloads[sent.id] = sent, payload
        self._goal.publish_serialized(payload)
        self._busy.set()
        return sent

    def cancel_all(self) -> None:
        """Ask the server to end all goals, those of other clients too."""
        self._cancel.publish(GoalId().fields)

    def cancel_before(self, time: Time) -> None:
        """Ask the server to end all goals made up to a time, those of other clients and late ones too."""
        self._cancel.publish(stamp=time)

    # Messages of the server

    def _status_received(self, message: Message) -> None:
        now = self._clock.now()
        self._heard_at = now
        self._heard.set()
        listed = {status.goal_id.id: status for status in message.status_list}
        for goal in self.goals:
            status = listed.get(goal.id)
            if status is None:
                self._update(goal, goal.tracker.not_listed(now))
                continue
            try:
                self._update(goal, goal.tracker.listed(GoalState(status.status), status.text, now))
            except (IllegalTransitionError, ValueError) as error:
                _log.warning("the server of %s says what cannot be: %s", self.name, error)

    def _result_received(self, message: Message) -> None:
        goal = self._goals.get(message.status.goal_id.id)
        if goal is None:
            return
        try:
            state = GoalState(message.status.status)
        except ValueError as error:
            _log.warning("the server of %s says what cannot be: %s", self.name, error)
            state = GoalState.LOST
        self._update(goal, goal.tracker.ended(state, message.status.text, self._clock.now()), message.result)

    def _feedback_received(self, message: Message) -> None:
        goal = self._goals.get(message.status.goal_id.id)
        if goal is not None:
            goal.feedback_received(message.feedback)

    # Repeating messages and giving goals up

    async def _look_after_goals(self) -> None:
        while True:
            await self._busy.wait()
            await asyncio.sleep(TICK)
            if self._node.is_shutdown:
                self._lose_all("the node stops")
            now = self._clock.now()
            for goal in self.goals:
                self._update(goal, goal.tracker.check(now, self._heard_at, self._silence_timeout))
                if goal.tracker.must_repeat(now):
                    self._repeat(goal)
            if not self._goals:
                self._busy.clear()

    def _repeat(self, goal: ClientGoal) -> None:
        if not goal.tracker.is_acknowledged:
            self._goal.publish_serialized(self._payloads[goal.id])
        if goal.comm_state is CommState.WAITING_FOR_CANCEL_ACK:
            self._cancel.publish(id=goal.id)

    def _send_cancel(self, goal: ClientGoal) -> None:
        self._cancel.publish(id=goal.id)
        self._update(goal, goal.tracker.cancelled(self._clock.now()))

    def _lose_all(self, text: str) -> None:
        for goal in self.goals:
            self._update(goal, goal.tracker.lose(text, self._clock.now()))

    def _update(self, goal: ClientGoal, passed: tuple[CommState, ...], result: Message | None = None) -> None:
        if goal.is_done:
            self._goals.pop(goal.id, None)
            self._payloads.pop(goal.id, None)
        goal.changed(passed, result)


def _silence_clock(node: Node) -> SilenceClock:
    """Return the clock for silence: not the time of day, which may be set back, unless time is simulated."""
    machine = asyncio.get_running_loop().time
    return SilenceClock(machine, node.time if node.is_time_simulated else machine)
