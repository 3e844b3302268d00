"""The messages that wait for one robot: two lanes, bounded, fair among interfaces (sans-I/O).

* The *control lane* carries small, urgent messages: ``ST``, ``ER``, small service messages. It always goes
  first and never drops messages: when it is full, the sender is told.
* The *data lane* holds one queue per interface. Interfaces whose oldest message is small, such as a velocity,
  go first, as in the links of the engine. The others take turns by deficit round robin, one after each
  quantum of small messages, so that none is starved.

A robot that stops reading fills only its own queues. A topic's queue then drops its oldest message for every
new one and counts it; a service's queue refuses, so that the caller gets an error.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce.aio.queues import BoundedQueue, OverflowPolicy

if TYPE_CHECKING:
    from collections.abc import Hashable

    from rce_robot.doors.base import Queued


_STATE_BYTES = 256
"""Memory of an unsent statement beside its text: each interface may have one."""


@dataclass(frozen=True, slots=True)
class OutboxLimits:
    """The limits of one robot's queues. A queue always takes one message of any size."""

    queue_messages: int = 128
    """Messages per interface."""
    queue_bytes: int = 16 << 20
    """Bytes per interface."""
    total_bytes: int = 64 << 20
    """Bytes of all interfaces together; topics make room, services may add their own queue to it."""
    control_messages: int = 4096
    control_bytes: int = 8 << 20
    quantum: int = 256 << 10
    """Bytes an interface may send per turn while others wait; also of small messages before a larger one."""
    small_bytes: int = 4 << 10
    """Messages up to this size go before larger ones of other interfaces."""


class _Flow:
    """The queue of one interface in the data lane. Latched messages are kept in it, by their sources.

    Attributes:
        ring: In which it waits for its turn; None: it is empty.
        tag: Of the interface.
        queue: The waiting messages, oldest first.
        credit: Bytes that it may send now.
        latched: By source, the bytes that its latched message counts: none if they are counted elsewhere.
    """

    __slots__ = ("credit", "latched", "queue", "ring", "tag")

    def __init__(self, tag: str, queue: BoundedQueue[Queued]) -> None:
        self.tag = tag
        self.queue = queue
        self.ring: deque[_Flow] | None = None
        self.credit = 0
        self.latched: dict[Hashable, int] = {}


class Outbox:
    """The queues between a robot's interfaces and its connection.

    Invariants: a flow is in ``_small`` or ``_ring`` exactly while it holds messages; in which of them is
    looked at when its turn comes. ``_data_bytes`` is the sum of the flows' bytes; no queue is over its limits
    by more than one message.
    """

    def __init__(self, limits: OutboxLimits = OutboxLimits(), dropped: Counter[str] | None = None) -> None:
        self._limits = limits
        self._control: deque[tuple[Queued, int]] = deque()
        self._control_bytes = 0
        self._states: dict[str, Queued] = {}
        self._state_bytes = 0
        self._flows: dict[str, _Flow] = {}
        self._small: deque[_Flow] = deque()
        self._ring: deque[_Flow] = deque()
        self._burst = 0
        """Bytes of small messages since the last larger one."""
        self._data_bytes = 0
        self._latched_bytes = 0
        self.dropped: Counter[str] = Counter() if dropped is None else dropped
        """Interface tag to the number of its dropped messages; may outlive the outbox."""

    def __bool__(self) -> bool:
        return bool(self._states or self._control or self._small or self._ring)

    @property
    def bytes(self) -> int:
        """Bytes that wait in both lanes, and of statements."""
        return self._state_bytes + self._control_bytes + self._data_bytes + self._latched_bytes

    def put_state(self, key: str, message: Queued) -> None:
        """Queue a statement that makes an earlier, unsent one of the same ``key`` obsolete (``ST``)."""
        former = self._states.get(key)
        if former is not None:
            self._state_bytes -= _STATE_BYTES + former.size
        self._states[key] = message
        self._state_bytes += _STATE_BYTES + message.size

    def put_control(self, message: Queued) -> bool:
        """Queue a small urgent message.

        Returns:
            False if the lane is full and the message was not taken.
        """
        size = message.size
        if self._control and (
            len(self._control) >= self._limits.control_messages
            or self._control_bytes + size > self._limits.control_bytes
        ):
            return False
        self._control.append((message, size))
        self._control_bytes += size
        return True

    def put_data(
        self,
        tag: str,
        message: Queued,
        overflow: OverflowPolicy = OverflowPolicy.DROP_OLDEST,
        queue_size: int = 0,
    ) -> bool:
        """Queue a message of an interface; its first message settles what a full queue does.

        Args:
            tag: Of the interface.
            message: The message.
            overflow: Whether a full queue drops or refuses.
            queue_size: Messages that may wait; 0: as many as the limits allow.

        Returns:
            False if the queue is full and refuses.
        """
        size = message.size
        flow = self._flow(tag, overflow)
        if queue_size:
            flow.queue.max_items = min(queue_size, self._limits.queue_messages)
        if not self._make_room_in(flow, size):
            return False
        while self._data_bytes + size > self._limits.total_bytes and self._drop_of_largest_topic():
            pass
        flow.queue.put(message, size)
        self._data_bytes += size
        self._enlist(flow)
        return True

    def put_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        """Queue the latched message of a source of the topic ``tag``, in place of an earlier one.

        It does not count for the limits, and is not dropped to make room: a burst of many topics' latched
        messages waits until the robot has read it.

        Args:
            tag: Of the interface.
            source: The source of the message; empty for a statement about all sources.
            message: The message.
            shared: Whether its bytes are also kept elsewhere and counted there.
        """
        flow = self._flow(tag, OverflowPolicy.DROP_OLDEST)
        if flow.queue.remove_kept(source):
            self._latched_bytes -= flow.latched[source]
            self.dropped[tag] += bool(source)
        size = message.size
        flow.queue.put(message, size, source)
        flow.latched[source] = 0 if shared else size
        self._latched_bytes += flow.latched[source]
        self._enlist(flow)

    def drop_latched(self, tag: str, source: Hashable) -> None:
        """Drop the unsent latched message of a source."""
        flow = self._flows.get(tag)
        if flow is not None and flow.queue.remove_kept(source):
            self._latched_bytes -= flow.latched.pop(source)
            self.dropped[tag] += 1
            self._leave_if_empty(flow)

    def pop(self) -> Queued | None:
        """Take the message to send next; return None if the queues are empty."""
        if self._states:
            state = self._states.pop(next(iter(self._states)))
            self._state_bytes -= _STATE_BYTES + state.size
            return state
        if self._control:
            message, size = self._control.popleft()
            self._control_bytes -= size
            return message
        return self._pop_data()

    def discard(self, tag: str) -> None:
        """Drop the messages of a removed interface, except the statement of its removal."""
        flow = self._flows.pop(tag, None)
        if flow is not None and flow.queue:
            self._leave(flow)
            self._data_bytes -= flow.queue.droppable_bytes
            self._latched_bytes -= sum(flow.latched.values())

    def shed(self, size: int) -> None:
        """Drop the oldest messages of the topics that hold most, until ``size`` bytes are free.

        Latched messages are dropped last; statements about all sources stay.
        """
        goal = self.bytes - size
        while self.bytes > goal and self._drop_of_largest_topic():
            pass
        for flow in self._waiting():
            for source, counted in list(flow.latched.items()):
                if source != "" and counted and self.bytes > goal:
                    self.drop_latched(flow.tag, source)

    def clear(self) -> None:
        """Drop all messages."""
        for flow in self._waiting():
            self.dropped[flow.tag] += len(flow.queue)
        self._flows.clear()
        self._small.clear()
        self._ring.clear()
        self._control.clear()
        self._states.clear()
        self._state_bytes = self._data_bytes = self._control_bytes = self._latched_bytes = 0

    def _flow(self, tag: str, overflow: OverflowPolicy) -> _Flow:
        """Return the queue of an interface; make it if it does not exist."""
        flow = self._flows.get(tag)
        if flow is None:
            limits = self._limits
            queue: BoundedQueue[Queued] = BoundedQueue(
                limits.queue_messages, limits.queue_bytes, overflow, lambda _: self.dropped.update((tag,))
            )
            flow = self._flows[tag] = _Flow(tag, queue)
        return flow

    def _make_room_in(self, flow: _Flow, size: int) -> bool:
        """Drop messages of an interface to make room for ``size`` bytes; return False if it refuses them."""
        if not flow.queue:
            return True
        before = flow.queue.droppable_bytes
        has_room = flow.queue.make_room(size)
        self._data_bytes -= before - flow.queue.droppable_bytes
        self._leave_if_empty(flow)
        return has_room

    def _drop_of_largest_topic(self) -> bool:
        topics = [
            flow
            for flow in self._waiting()
            if flow.queue.policy is OverflowPolicy.DROP_OLDEST and flow.queue.droppable
        ]
        if topics:
            flow = max(topics, key=lambda flow: flow.queue.droppable_bytes)
            before = flow.queue.droppable_bytes
            flow.queue.drop_oldest()
            self._data_bytes -= before - flow.queue.droppable_bytes
            self._leave_if_empty(flow)
        return bool(topics)

    def _waiting(self) -> list[_Flow]:
        return [*self._small, *self._ring]

    def _enlist(self, flow: _Flow) -> None:
        """Have a flow wait for its turn, unless it does."""
        if flow.ring is None:
            flow.ring = self._small if flow.queue.head_size <= self._limits.small_bytes else self._ring
            flow.ring.append(flow)

    @staticmethod
    def _leave(flow: _Flow) -> None:
        if flow.ring is not None:
            flow.ring.remove(flow)
            flow.ring = None
            flow.credit = 0

    def _leave_if_empty(self, flow: _Flow) -> None:
        if not flow.queue:
            self._leave(flow)

    def _pop_data(self) -> Queued | None:
        flow = self._next_small() or self._next_large()
        if flow is None:
            return None
        size, source = flow.queue.head_size, flow.queue.kept_head
        message = flow.queue.take()
        if source is None:
            self._data_bytes -= size
        else:
            self._latched_bytes -= flow.latched.pop(source)
        if flow.ring is self._small:
            self._burst += size
            self._leave(flow)
            if flow.queue:
                self._enlist(flow)
        else:
            self._burst = 0
            flow.credit = max(0, flow.credit - size)
            self._leave_if_empty(flow)
        return message

    def _next_small(self) -> _Flow | None:
        """Return the flow whose small message is sent next; None if it is the turn of a larger one."""
        while self._small and not (self._ring and self._burst >= self._limits.quantum):
            flow = self._small[0]
            if flow.queue.head_size <= self._limits.small_bytes:
                return flow
            self._leave(flow)
            self._enlist(flow)
        return None

    def _next_large(self) -> _Flow | None:
        ring = self._ring
        while ring:
            flow = ring[0]
            if len(ring) == 1 or flow.queue.head_size <= flow.credit:
                return flow
            flow.credit += self._limits.quantum
            ring.rotate(-1)
        return None
