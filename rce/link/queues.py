"""What waits to be sent on one channel: a bounded queue with a documented policy, and its counters."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from rce.control.model import InterfaceUsage
from rce.link.exceptions import Overloaded
from rce.link.frames import FRAGMENT_SIZE, LATCHED, FrameType
from rce.link.settings import KIB

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.link.frames import Frame

SMALL_MESSAGE = 4 * KIB
"""Messages up to this size are urgent.

Poses, goals, cancellations, states and most service calls fit; images, maps and long scans do not. A whole
one adds no more to anybody's waiting than a thirtieth of a fragment.
"""


class OverflowPolicy(Enum):
    """What happens when a queue is full."""

    DROP_OLDEST = "drop oldest"
    """The oldest waiting messages are thrown away and counted: topics, where the newest is worth most."""
    REFUSE = "refuse"
    """The new message is refused with ``Overloaded``: services, where none may be lost."""


@dataclass(slots=True)
class Counters:
    """What one interface moved; see :class:`~rce.control.model.InterfaceUsage`."""

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
    """What waits on all channels of one endpoint.

    Args:
        on_growth: Called after something was added.

    Attributes:
        bytes: Of payload.
    """

    def __init__(self, on_growth: Callable[[], None] = lambda: None) -> None:
        self.bytes = 0
        self.on_growth = on_growth


class Lane(Enum):
    """Where a channel's queue stands in line."""

    NONE = "none"
    URGENT = "urgent"
    BULK = "bulk"


class OutgoingQueue:
    """Messages of one channel that wait to be sent, oldest first.

    A message whose first part is on its way is neither dropped nor counted against the limits.

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
        self._policy = policy
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._frames: deque[Frame] = deque()
        self._kept: dict[int, Frame] = {}
        """The newest latched message of each source, and SOURCES (0), which a full queue does not drop."""
        self._bytes = 0
        self._backlog = backlog or Backlog()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def waiting_bytes(self) -> int:
        """Payload bytes in the queue, with those of a message that has begun."""
        return self._bytes

    @property
    def head(self) -> Frame:
        """The oldest message."""
        return self._frames[0]

    @property
    def urgent(self) -> bool:
        """Whether the oldest message is small."""
        return len(self._frames[0].payload) <= SMALL_MESSAGE

    def push(self, frame: Frame) -> None:
        """Append a message.

        Raises:
            Overloaded: The queue is full and its policy is to refuse.
        """
        size = len(frame.payload)
        while self._is_full(size):
            if self._policy is OverflowPolicy.REFUSE:
                raise Overloaded(f"{len(self._frames)} messages wait to be sent")
            if not self._drop_oldest():
                break
        self._frames.append(frame)
        if _is_kept(frame):
            self._kept[frame.id] = frame
        self._count(size)
        self._backlog.on_growth()

    def take(self, limit: int = FRAGMENT_SIZE) -> tuple[Frame, int, int]:
        """Take the next part of the oldest message.

        Args:
            limit: Most bytes of payload.

        Returns:
            The message, where the part begins and where it ends in its payload.
        """
        frame = self._frames[0]
        size = len(frame.payload)
        start = self.sent
        end = min(size, start + limit)
        self.sent = end
        if end == size:
            self._remove_head()
            self.counters.count_frame(frame)
        return frame, start, end

    def withdraw(self, call_id: int) -> bool:
        """Take a call back that has not begun; false if there is none."""
        for index, frame in enumerate(self._frames):
            if frame.id == call_id and not (index == 0 and self.sent):
                del self._frames[index]
                self._count(-len(frame.payload))
                return True
        return False

    def shed(self, size: int) -> None:
        """Drop the oldest messages of a topic that have not begun, until ``size`` bytes are free."""
        goal = self._bytes - size
        while (
            self._policy is OverflowPolicy.DROP_OLDEST
            and len(self._frames) > (1 if self.sent else 0)
            and self._bytes > goal
        ):
            if not self._drop_oldest():
                self._kept.clear()

    def clear(self) -> int:
        """Throw everything away.

        Returns:
            Size of the message that had begun and must be aborted; 0 if none had.
        """
        begun = len(self._frames[0].payload) if self.sent else 0
        self.counters.dropped += sum(frame.type is not FrameType.SOURCES for frame in self._frames)
        self._frames.clear()
        self._kept.clear()
        self._count(-self._bytes)
        self.sent = 0
        return begun

    def _is_full(self, size: int) -> bool:
        begun = len(self._frames[0].payload) if self.sent else 0
        waiting = len(self._frames) - (1 if self.sent else 0)
        if waiting == 0:
            return False
        return waiting >= self._max_messages or self._bytes - begun + size > self._max_bytes

    def _drop_oldest(self) -> bool:
        """Drop the oldest message that may be dropped; false if there is none."""
        for index in range(1 if self.sent else 0, len(self._frames)):
            frame = self._frames[index]
            if self._kept.get(frame.id) is not frame:
                self._count(-len(frame.payload))
                del self._frames[index]
                self.counters.dropped += 1
                return True
        return False

    def _remove_head(self) -> None:
        frame = self._frames.popleft()
        if self._kept.get(frame.id) is frame:
            del self._kept[frame.id]
        self._count(-len(frame.payload))
        self.sent = 0

    def _count(self, change: int) -> None:
        self._bytes += change
        self._backlog.bytes += change


def _is_kept(frame: Frame) -> bool:
    """Tell whether a message stays in a full queue until a newer one of its source comes."""
    return frame.type is FrameType.SOURCES or (frame.type is FrameType.DATA and bool(frame.flags & LATCHED))
