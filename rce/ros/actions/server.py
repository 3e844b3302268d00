"""Action servers: the five topics of an action, a ledger of goals, a policy and the program's handler."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, assert_never

from rce.aio.tasks import TaskScope
from rce.ros.actions import topics, work
from rce.ros.actions.goal_id import GoalId
from rce.ros.actions.ledger import MEMORY, Arrival, Entry, GoalLedger
from rce.ros.actions.policy import MAX_GOALS, Drop, ManyGoals, Policy, Refuse, SingleGoal, Start, Step, Stop
from rce.ros.actions.server_goal import Content, ServerGoal
from rce.ros.actions.states import GoalEvent
from rce.ros.closing import release

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher
    from rce.ros.types import Message, Time

_log = logging.getLogger(__name__)

STATUS_FREQUENCY = 5.0
"""Hz; the parameter ``actionlib_status_frequency`` of the node or a namespace above it overrides it."""

QUEUE_SIZE = 50
"""How many results, feedbacks and lists wait for a slow client, as in ROS's servers."""

STOPPED = "the server stopped"

CHANGES_LISTED = frozenset({GoalEvent.ACCEPT, GoalEvent.REQUEST_CANCEL})
"""Events that are told by a list at once; the others are told by a result."""


class ActionServer:
    """Provides an action: works on many goals side by side. An async context manager.

    ``async with ActionServer(node, "fibonacci", "actionlib_tutorials/FibonacciAction", compute): ...``

    The handler is called once for each goal. A coroutine function returns the result (a message, or a
    mapping of its fields), which means success, or ends the goal by ``goal.abort()`` and the like; an async
    generator yields feedback instead. A handler that returns ``None`` after a request to cancel has
    preempted the goal; one that raises has aborted it. Leaving the block cancels the handlers and aborts
    their goals.

    Attributes:
        name: The action's global name.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        action_type: str,
        handler: work.Handler,
        *,
        auto_accept: bool = True,
        max_goals: int = MAX_GOALS,
    ) -> None:
        """Prepare a server.

        Args:
            node: The node that it is part of; it must be running while the server is.
            name: The action's name: the namespace of its topics.
            action_type: Its type, such as ``actionlib_tutorials/FibonacciAction``; ``Action`` may be left
                out.
            handler: Works on a goal.
            auto_accept: Accept every goal before the handler is called; else the handler calls
                ``goal.accept()`` or ``goal.reject()``.
            max_goals: How many goals are worked on at the same time; more are rejected.
        """
        self.name = node.resolve(name)
        self._node = node
        self._types = topics.ActionTypes.named(action_type)
        self._handler = handler
        self._policy: Policy = ManyGoals(max_goals)
        self._auto_accept = auto_accept
        self._goals: dict[str, ServerGoal] = {}
        self._ledger = GoalLedger()
        self._latest = 0
        self._stack = AsyncExitStack()
        self._tasks = TaskScope()
        self._status: Publisher
        self._result: Publisher
        self._feedback: Publisher

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} {len(self._goals)} goals>"

    @property
    def goals(self) -> tuple[ServerGoal, ...]:
        """The goals that are not over, the oldest first."""
        return tuple(goal for goal in self._goals.values() if not goal.state.is_over)

    # Life

    async def __aenter__(self) -> Self:
        node, types = self._node, self._types
        async with AsyncExitStack() as stack:

            async def advertise(topic: str, message_type: str, *, latch: bool = False) -> Publisher:
                publisher = await node.advertise(
                    f"{self.name}/{topic}", message_type, latch=latch, queue_size=QUEUE_SIZE
                )
                stack.push_async_callback(release, publisher)
                return publisher

            self._result = await advertise("result", types.action_result)
            self._feedback = await advertise("feedback", types.action_feedback)
            self._status = await advertise("status", topics.STATUS, latch=True)
            frequency = await topics.number(node, await self._frequency_parameter(), STATUS_FREQUENCY)
            self._ledger.memory = await topics.number(node, f"{self.name}/status_list_timeout", MEMORY)
            stack.callback(self._give_up_rest)
            self._tasks = await stack.enter_async_context(TaskScope())
            self._publish_status()
            if frequency > 0:
                self._tasks.spawn(self._keep_publishing(1 / frequency), name=f"status of {self.name}")
            for topic, message_type, callback in (
                ("cancel", topics.GOAL_ID, self._cancel_received),
                ("goal", types.action_goal, self._goal_received),
            ):
                subscriber = await node.subscribe(f"{self.name}/{topic}", message_type, callback)
                stack.push_async_callback(release, subscriber)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def _frequency_parameter(self) -> str:
        return await self._node.search_param("actionlib_status_frequency") or "actionlib_status_frequency"

    async def _keep_publishing(self, period: float) -> None:
        while True:
            await asyncio.sleep(period)  # real time: clients need the list while ROS time stands still
            self._see_time()
            self._publish_status()

    # Messages of clients

    def _goal_received(self, message: Message) -> None:
        goal_id, now = GoalId.read(message.goal_id), self._see_time()
        if not goal_id.id:
            goal_id = GoalId(GoalId.make(self._node.name, now).id, goal_id.stamp)
        if not goal_id.stamp:
            goal_id = GoalId(goal_id.id, now.to_nsec())
        arrival = self._ledger.receive(goal_id, self._time())
        if arrival is Arrival.REPEATED:
            return
        entry = self._ledger[goal_id.id]
        if arrival is Arrival.CANCELLED:
            self._publish_result(entry, {})
            return
        self._goals[goal_id.id] = ServerGoal(self, entry, message.goal)
        self._perform(self._policy.offer(goal_id))

    def _cancel_received(self, message: Message) -> None:
        self._see_time()
        asked = self._ledger.cancel(GoalId.read(message), self._time())
        for goal_id in asked:
            self._perform(self._policy.cancel(goal_id))
        if asked:
            self._publish_status()

    def _see_time(self) -> Time:
        """Return ROS time, and notice if it jumped back: a simulation or a bag began again."""
        now = self._node.now()
        nanoseconds = now.to_nsec()
        if nanoseconds < self._latest:
            self._ledger.note_time_jump()
            self._policy.note_time_jump()
        self._latest = nanoseconds
        return now

    def _perform(self, steps: list[Step]) -> None:
        for step in steps:
            goal = self._goals[step.goal_id]
            match step:
                case Start():
                    self._tasks.spawn(self._work_on(goal), name=f"goal {goal.id}")
                case Stop():
                    goal.request_cancel()
                case Drop(text=text):
                    self._end_unstarted(goal, GoalEvent.CANCEL, text)
                case Refuse(text=text):
                    self._end_unstarted(goal, GoalEvent.REJECT, text)
                case _:
                    assert_never(step)

    def _end_unstarted(self, goal: ServerGoal, event: GoalEvent, text: str) -> None:
        del self._goals[goal.id]
        if not goal.state.is_over:
            self.transition(self._ledger[goal.id], event, text, None)

    # Calls of the program

    def transition(self, entry: Entry, event: GoalEvent, text: str, result: Message | Content | None) -> None:
        """Apply an event to a goal and tell its clients.

        Raises:
            IllegalTransitionError: It is not possible in the goal's state.
            SerializationError: The result does not fit its type; nothing was changed.
        """
        text = text.encode(errors="backslashreplace").decode()  # it is part of all later lists of goals
        content = self._result.type.new(result={} if result is None else result)
        self._result.type.serialize(content)
        self._ledger.apply(entry.goal_id.id, event, self._time(), text)
        if event in CHANGES_LISTED:
            self._publish_status()
        else:
            self._publish_result(entry, content.result)

    def publish_feedback(self, entry: Entry, feedback: Message | Content) -> None:
        """Publish feedback to a goal's clients.

        Raises:
            SerializationError: The feedback does not fit its type.
        """
        message_type = self._feedback.type
        message = message_type.new(header=self._header(), status=_status(entry), feedback=feedback)
        # As bytes: the program may change its message after that.
        self._feedback.publish_serialized(message_type.serialize(message))

    async def sleep(self, seconds: float) -> bool:
        """Sleep in ROS time; return whether the node continues."""
        return await self._node.sleep(seconds)

    # Work

    async def _work_on(self, goal: ServerGoal) -> None:
        """Run the handler; whatever it does, the goal is over at the end."""
        try:
            if self._auto_accept and not goal.state.is_over:
                goal.accept()
            if not goal.state.is_over:
                work.conclude(goal, await work.call(self._handler, goal))
        except (Exception, asyncio.CancelledError) as error:
            task = asyncio.current_task()
            if isinstance(error, asyncio.CancelledError) and task is not None and task.cancelling():
                work.give_up(goal, STOPPED)
                raise
            # The client gets every failure; a task that the handler waited for may have been cancelled too.
            _log.exception("the handler of %s failed on goal %s", self.name, goal.id)
            work.give_up(goal, f"{type(error).__name__}: {error}".removesuffix(": "))
        finally:
            self._goals.pop(goal.id, None)
            following = self._policy.ended(goal.id)
        self._perform(following)

    def _give_up_rest(self) -> None:
        """End the goals that wait, and those whose work was cancelled before it began."""
        while self._goals:
            _, goal = self._goals.popitem()
            work.give_up(goal, STOPPED)

    # Publishing

    def _publish_status(self) -> None:
        entries = self._ledger.listed(self._time())
        self._status.publish(header=self._header(), status_list=[_status(entry) for entry in entries])

    def _publish_result(self, entry: Entry, result: Message | Content) -> None:
        message_type = self._result.type
        message = message_type.new(header=self._header(), status=_status(entry), result=result)
        self._result.publish_serialized(message_type.serialize(message))
        self._publish_status()

    def _header(self) -> dict[str, Any]:
        return {"stamp": self._node.now()}

    @staticmethod
    def _time() -> float:
        return asyncio.get_running_loop().time()


class SimpleActionServer(ActionServer):
    """Works on one goal at a time; a newer goal stops the one before.

    The handler of the goal before sees ``goal.cancel_requested``; the newer one is accepted when it has
    ended. Of several that wait, the newest is left; the others are recalled.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        action_type: str,
        handler: work.Handler,
        *,
        auto_accept: bool = True,
    ) -> None:
        """Prepare a server; as for :class:`ActionServer`."""
        super().__init__(node, name, action_type, handler, auto_accept=auto_accept)
        self._policy = SingleGoal()


def _status(entry: Entry) -> dict[str, Any]:
    return {"goal_id": entry.goal_id.fields, "status": int(entry.state), "text": entry.text}
