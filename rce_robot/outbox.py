"""What waits to be sent to one robot: two lanes, bounded, fair among interfaces (sans-I/O).

* The *control lane* carries what is small and urgent: ``ST``, ``ER``, small service messages. It always
  goes first and is never thinned out: when it is full, the sender is told.
* The *data lane* holds one queue per interface. Interfaces take turns by deficit round robin, so that a
  stream of 10 MB images leaves room for every small message that comes meanwhile.

A robot that stops reading fills its own queues and nothing else. A topic's queue then forgets its oldest
message for every new one and counts it; a service's queue refuses, so that the caller learns of it.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rce_robot.outgoing import Rendered


class Overflow(Enum):
    """What a full queue does with a new message."""

    DROP_OLDEST = "drop oldest"
    """Forget the oldest message and count it. Topics."""
    REFUSE = "refuse"
    """Take no more; the sender is told. Services."""


class Queued(Protocol):
    """What a queue holds."""

    @property
    def size(self) -> int:
        """Bytes that it counts in the queue's limits."""

    def render(self) -> Rendered | None:
        """Make it ready to be sent; None if that turns out to be impossible.

        Called when its turn has come: a message that is dropped in the queue costs no conversion.
        """


@dataclass(frozen=True, slots=True)
class OutboxLimits:
    """How much may wait for one robot. A queue always takes one message, however large."""

    queue_messages: int = 128
    """Messages per interface."""
    queue_bytes: int = 16 << 20
    """Bytes per interface."""
    total_bytes: int = 64 << 20
    """Bytes of all interfaces together; topics make room, services may add their own queue to it."""
    control_messages: int = 4096
    control_bytes: int = 8 << 20
    quantum: int = 256 << 10
    """Bytes an interface may send per turn while others wait."""


class _Flow:
    """The queue of one interface in the data lane. ``credit`` is what it may send now, in bytes."""

    __slots__ = ("bytes", "credit", "latched", "messages", "overflow", "sources", "tag")

    def __init__(self, tag: str, overflow: Overflow) -> None:
        self.tag = tag
        self.overflow = overflow
        self.messages: deque[tuple[Queued, int]] = deque()
        self.bytes = 0
        """Of all but the latched messages."""
        self.credit = 0
        self.latched: dict[str, tuple[tuple[Queued, int], int]] = {}
        """By source: the latched message as it is in the queue, and the bytes that it counts."""
        self.sources: dict[int, str] = {}
        """The sources of latched messages, by the ``id`` of the queue's entries."""

    @property
    def droppable(self) -> int:
        """How many messages may be dropped: all but the latched ones."""
        return len(self.messages) - len(self.latched)

    def push(self, message: Queued, size: int) -> None:
        self.messages.append((message, size))
        self.bytes += size

    def push_latched(self, source: str, message: Queued, *, shared: bool) -> int:
        """Add the latched message of a source; return the bytes that it counts."""
        entry = (message, message.size)
        counted = 0 if shared else entry[1]
        self.messages.append(entry)
        self.latched[source] = (entry, counted)
        self.sources[id(entry)] = source
        return counted

    def pop(self) -> tuple[Queued, int, int]:
        """Return the oldest message, its size, and the bytes that it counts as latched one."""
        entry = self.messages.popleft()
        source = self.sources.pop(id(entry), None)
        if source is not None:
            return (*entry, self.latched.pop(source)[1])
        self.bytes -= entry[1]
        return (*entry, -1)

    def drop_oldest(self) -> int:
        """Drop the oldest that is not latched; return its size."""
        index = next(i for i, entry in enumerate(self.messages) if id(entry) not in self.sources)
        size = self.messages[index][1]
        del self.messages[index]
        self.bytes -= size
        return size

    def drop_latched(self, source: str) -> int:
        """Drop the latched message of a source; return the bytes that it counted."""
        entry, counted = self.latched.pop(source)
        del self.sources[id(entry)]
        index = next(i for i, other in enumerate(self.messages) if other is entry)
        del self.messages[index]
        return counted


class Outbox:
    """The queues between a robot's interfaces and its connection.

    Invariants: a flow is in ``_ring`` exactly while it holds messages; ``_data_bytes`` is the sum of the
    flows' bytes; no queue is over its limits by more than one message.
    """

    def __init__(self, limits: OutboxLimits = OutboxLimits(), dropped: Counter[str] | None = None) -> None:
        self._limits = limits
        self._control: deque[tuple[Queued, int]] = deque()
        self._control_bytes = 0
        self._states: dict[str, Queued] = {}
        self._flows: dict[str, _Flow] = {}
        self._ring: deque[_Flow] = deque()
        self._data_bytes = 0
        self._latched_bytes = 0
        self.dropped: Counter[str] = Counter() if dropped is None else dropped
        """Interface tag to the number of its messages that were thrown away; may outlive the outbox."""

    def __bool__(self) -> bool:
        return bool(self._states or self._control or self._ring)

    @property
    def bytes(self) -> int:
        """Bytes that wait in both lanes."""
        return self._control_bytes + self._data_bytes + self._latched_bytes

    def put_state(self, key: str, message: Queued) -> None:
        """Queue a statement that makes an earlier, unsent one of the same ``key`` obsolete (``ST``)."""
        self._states[key] = message

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

    def put_data(self, tag: str, message: Queued, overflow: Overflow = Overflow.DROP_OLDEST) -> bool:
        """Queue a message of the interface ``tag``; its first message settles the queue's ``overflow``.

        Returns:
            False if the queue is full and refuses.
        """
        size = message.size
        flow = self._flows.get(tag)
        if flow is None:
            flow = self._flows[tag] = _Flow(tag, overflow)
        if flow.overflow is Overflow.REFUSE and self._over(flow, size):
            return False
        while self._over(flow, size):
            self._drop(flow)
        if self._data_bytes + size > self._limits.total_bytes:
            self._make_room(size)
        if not flow.messages:
            self._ring.append(flow)
        flow.push(message, size)
        self._data_bytes += size
        return True

    def put_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        """Queue the latched message of a source of the topic ``tag``, in place of an earlier one.

        It is not part of what the limits hold and what makes room for others: a burst of many topics' latched
        messages waits until the robot has read it.

        Args:
            tag: Of the interface.
            source: Whose message it is; empty for what is said of all sources.
            message: The message.
            shared: Its bytes are kept elsewhere too and counted there.
        """
        flow = self._flows.get(tag)
        if flow is None:
            flow = self._flows[tag] = _Flow(tag, Overflow.DROP_OLDEST)
        if source in flow.latched:
            self._latched_bytes -= flow.drop_latched(source)
            self.dropped[tag] += bool(source)
        elif not flow.messages:
            self._ring.append(flow)
        self._latched_bytes += flow.push_latched(source, message, shared=shared)

    def drop_latched(self, tag: str, source: str) -> None:
        """Forget the latched message of a source that was not sent yet."""
        flow = self._flows.get(tag)
        if flow is not None and source in flow.latched:
            self._latched_bytes -= flow.drop_latched(source)
            self.dropped[tag] += 1
            self._leave_if_empty(flow)

    def pop(self) -> Queued | None:
        """Take the message to send next, None if nothing waits."""
        if self._states:
            key = next(iter(self._states))
            return self._states.pop(key)
        if self._control:
            message, size = self._control.popleft()
            self._control_bytes -= size
            return message
        if self._ring:
            return self._pop_data()
        return None

    def discard(self, tag: str) -> None:
        """Forget the messages of an interface that is gone; that it is gone is still said."""
        flow = self._flows.pop(tag, None)
        if flow is not None and flow.messages:
            self._ring.remove(flow)
            self._data_bytes -= flow.bytes
            self._latched_bytes -= sum(counted for _, counted in flow.latched.values())

    def shed(self, size: int) -> None:
        """Forget the oldest messages of the topics that hold most, until ``size`` bytes are free.

        Latched messages go last.
        """
        goal = self.bytes - size
        while self.bytes > goal and self._drop_of_largest_topic():
            pass
        for flow in list(self._ring):
            for source, (_, counted) in list(flow.latched.items()):
                if self.bytes > goal and counted:
                    self.drop_latched(flow.tag, source)

    def clear(self) -> None:
        """Forget everything."""
        for flow in self._ring:
            self.dropped[flow.tag] += len(flow.messages)
        self._flows.clear()
        self._ring.clear()
        self._control.clear()
        self._states.clear()
        self._data_bytes = self._control_bytes = self._latched_bytes = 0

    def _over(self, flow: _Flow, size: int) -> bool:
        limits = self._limits
        return bool(flow.droppable) and (
            flow.droppable >= limits.queue_messages or flow.bytes + size > limits.queue_bytes
        )

    def _make_room(self, size: int) -> None:
        """Drop from whichever topic holds most, until ``size`` more bytes fit or no topic holds anything."""
        while self._data_bytes + size > self._limits.total_bytes and self._drop_of_largest_topic():
            pass

    def _drop_of_largest_topic(self) -> bool:
        topics = [flow for flow in self._ring if flow.overflow is Overflow.DROP_OLDEST and flow.droppable]
        if topics:
            self._drop(max(topics, key=lambda flow: flow.bytes))
        return bool(topics)

    def _drop(self, flow: _Flow) -> None:
        self._data_bytes -= flow.drop_oldest()
        self.dropped[flow.tag] += 1
        self._leave_if_empty(flow)

    def _leave_if_empty(self, flow: _Flow) -> None:
        if not flow.messages:
            self._ring.remove(flow)
            flow.credit = 0

    def _pop_data(self) -> Queued:
        ring = self._ring
        while True:
            flow = ring[0]
            if len(ring) == 1 or flow.messages[0][1] <= flow.credit:
                break
            flow.credit += self._limits.quantum
            ring.rotate(-1)
        message, size, latched = flow.pop()
        if latched < 0:
            self._data_bytes -= size
        else:
            self._latched_bytes -= latched
        flow.credit = max(0, flow.credit - size)
        if not flow.messages:
            ring.popleft()
            flow.credit = 0
        return message
