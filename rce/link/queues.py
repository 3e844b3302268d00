"""The outgoing queue of one channel, and its counters."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from rce.aio.queues import BoundedQueue, OverflowPolicy
from rce.control import InterfaceUsage
from rce.link.exceptions import OverloadedError
from rce.link.frames import FRAGMENT_SIZE, LATCHED, Frame, FrameType
from rce.link.settings import KIB

if TYPE_CHECKING:
    from collections.abc import Callable


SMALL_MESSAGE = 4 * KIB
"""Messages up to this size are urgent.

Poses, goals, cancellations, states and most service calls fit; images, maps and long scans do not. A whole
one delays any other message by no more than a thirtieth of a fragment.
"""


@dataclass(slots=True)
class Counters:
    """The traffic of one interface; see :class:`~rce.control.model.InterfaceUsage`."""

    messages_in: int = 0
    messages_out: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    dropped: int = 0

    def count_in(self, size: int) -> None:
        """Count a message of a peer."""
        self.messages_in += 1
        self.bytes_in += size

    def count_frame(self, frame: Frame) -> None:
        """Count a message that was handed to the transport as a whole."""
        if frame.type is not FrameType.SOURCES:
            self.messages_out += 1
            self.bytes_out += len(frame.payload)

    def usage(self) -> InterfaceUsage:
        """Return the counters as the task set reports them."""
        return InterfaceUsage(
            messages_in=self.messages_in,
            messages_out=self.messages_out,
            bytes_in=self.bytes_in,
            bytes_out=self.bytes_out,
            dropped=self.dropped,
        )


class Backlog:
    """The payload that waits on all channels of one endpoint.

    Args:
        on_growth: Called after something was added.

    Attributes:
        bytes: Of payload.
    """

    def __init__(self, on_growth: Callable[[], None] = lambda: None) -> None:
        self.bytes = 0
        self.on_growth = on_growth


class Lane(Enum):
    """The lane of a channel's queue."""

    NONE = "none"
    URGENT = "urgent"
    BULK = "bulk"


class OutgoingQueue:
    """Messages of one channel that wait to be sent, oldest first.

    A message whose first part is on its way is neither dropped nor counted against the limits. The newest
    latched message of each source, and the newest SOURCES, are kept.

    Attributes:
        channel: The channel's number.
        counters: Of the channel's interface.
        lane: Kept by :class:`~rce.link.lanes.Lanes`.
        sent: Bytes of the oldest message that are on their way; 0 if it has not begun.
    """

    def __init__(
        self,
        channel: int,
        counters: Counters,
        policy: OverflowPolicy,
        *,
        max_messages: int,
        max_bytes: int,
        backlog: Backlog | None = None,
    ) -> None:
        self.channel = channel
        self.counters = counters
        self.lane = Lane.NONE
        self.sent = 0
        self._begun: Frame | None = None
        """The message of which a part is on its way."""
        self._waiting: BoundedQueue[Frame] = BoundedQueue(max_messages, max_bytes, policy, self._on_drop)
        self._bytes = 0
        self._backlog = backlog or Backlog()

    def __len__(self) -> int:
        return len(self._waiting) + (self._begun is not None)

    @property
    def waiting_bytes(self) -> int:
        """Payload bytes in the queue, with those of a message that has begun."""
        return self._bytes

    @property
    def head(self) -> Frame | None:
        """The oldest message; None if nothing waits."""
        return self._begun or self._waiting.peek()

    def push(self, frame: Frame) -> None:
        """Append a message.

        Raises:
            OverloadedError: The queue is full and its policy is to refuse.
        """
        waiting, backlog = self._waiting, self._backlog
        before = waiting.bytes
        if not waiting.put(frame, len(frame.payload), _key(frame)):
            raise OverloadedError(f"{len(self)} messages wait to be sent")
        change = waiting.bytes - before
        self._bytes += change
        backlog.bytes += change
        backlog.on_growth()

    def take(self, limit: int = FRAGMENT_SIZE) -> tuple[Frame, int, int]:
        """Take the next part of the oldest message.

        Args:
            limit: Most bytes of payload.

        Returns:
            The message, where the part begins and where it ends in its payload.
        """
        frame = self._begun or self._waiting.take()
        size = len(frame.payload)
        start = self.sent
        end = min(size, start + limit)
        if end < size:
            self._begun, self.sent = frame, end
        else:
            self._begun, self.sent = None, 0
            self._count(-size)
            self.counters.count_frame(frame)
        return frame, start, end

    def give_up(self, call_id: int) -> int:
        """Throw a call away of which a part is on its way.

        Returns:
            Size of the message, which must be aborted; 0 if that call has not begun, or was sent.
        """
        frame = self._begun
        if frame is None or frame.id != call_id:
            return 0
        size = len(frame.payload)
        self._begun, self.sent = None, 0
        self._count(-size)
        return size

    def withdraw(self, call_id: int) -> bool:
        """Take a call back that has not begun; false if there is none."""
        before = self._waiting.bytes
        found = self._waiting.remove(lambda frame: frame.id == call_id)
        self._count(self._waiting.bytes - before)
        return found

    def withdraw_latched(self, source: int) -> None:
        """Take the newest latched message of a source back, if it has not begun."""
        before = self._waiting.bytes
        self._waiting.remove_kept(source)
        self._count(self._waiting.bytes - before)

    def release_latched(self, source: int) -> None:
        """Have the newest latched message of a source be dropped like others: the source ended."""
        self._waiting.release(source)

    def shed(self, size: int) -> None:
        """Drop the oldest messages of a topic that have not begun, until ``size`` bytes are free.

        Those that are kept stay.
        """
        if self._waiting.policy is OverflowPolicy.DROP_OLDEST:
            before = self._waiting.bytes
            self._waiting.shed(size)
            self._count(self._waiting.bytes - before)

    def clear(self) -> int:
        """Throw everything away.

        Returns:
            Size of the message that had begun and must be aborted; 0 if none had.
        """
        begun = 0
        if self._begun is not None:
            begun = len(self._begun.payload)
            self._on_drop(self._begun)
        for frame in self._waiting:
            self._on_drop(frame)
        self._waiting.clear()
        self._count(-self._bytes)
        self._begun, self.sent = None, 0
        return begun

    def _on_drop(self, frame: Frame) -> None:
        self.counters.dropped += frame.type is not FrameType.SOURCES

    def _count(self, change: int) -> None:
        self._bytes += change
        self._backlog.bytes += change


def _key(frame: Frame) -> int | None:
    """Return the key under which a message is kept until a newer one comes; None if it may be dropped."""
    if frame.type is FrameType.SOURCES:
        return 0
    return frame.id if frame.type is FrameType.DATA and frame.flags & LATCHED else None
