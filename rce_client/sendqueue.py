"""What waits to be sent to the engine: requests, then small messages, then larger ones, topics in turn.

Pure, but for one event.
"""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce.aio.queues import BoundedQueue
from rce_client.exceptions import LostError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce.protocol import Frame


@dataclass(frozen=True, slots=True)
class QueueLimits:
    """Limits of the messages that wait to be sent. A topic's queue always accepts one message of any size."""

    topic_messages: int = 64
    """Messages of one topic; beyond it, the oldest is dropped."""
    topic_bytes: int = 16 << 20
    """Bytes of the messages of one topic; beyond it, the oldest are dropped."""
    small_bytes: int = 4 << 10
    """Messages up to this size, such as a velocity, go before larger ones of other topics."""
    burst_bytes: int = 256 << 10
    """Bytes of small messages after which a larger one is sent."""
    control_messages: int = 1024
    """Service messages; beyond it, calls fail. Requests are always accepted."""


@dataclass(eq=False, slots=True)
class QueuedMessage:
    """The frames of one message."""

    frames: Sequence[Frame]
    size: int
    key: str | None = None
    """A message with a key is dropped only for a newer one with this key. Latched messages: the source."""
    sent: asyncio.Future[None] | None = None
    """Completed when the message was handed to the network, or failed."""
    on_received: Callable[[], object] | None = None
    """Called when the engine has answered a ping that was sent after the message."""

    @classmethod
    def of(cls, frames: Sequence[Frame], key: str | None = None) -> QueuedMessage:
        """Make a queued message of frames as :mod:`rce.protocol.codec` writes them."""
        return cls(frames, sum(map(len, frames)), key)


class SendQueue:
    """Two lanes: control, in order and complete; data, one queue per interface that forgets its oldest.

    Invariant: a topic's queue is in ``_small`` or ``_large`` exactly while it is not empty; in which one is
    looked at when its turn comes. Their order is the order of turns.
    """

    def __init__(self, limits: QueueLimits) -> None:
        self._limits = limits
        self._control: deque[QueuedMessage] = deque()
        self._small: OrderedDict[str, BoundedQueue[QueuedMessage]] = OrderedDict()
        self._large: OrderedDict[str, BoundedQueue[QueuedMessage]] = OrderedDict()
        self._burst = 0
        """Bytes of small messages since the last larger one."""
        self._filled = asyncio.Event()
        self.dropped: Counter[str] = Counter()
        """Interface tag to the number of its messages that were thrown away."""

    def __bool__(self) -> bool:
        return bool(self._control or self._small or self._large)

    @property
    def full(self) -> bool:
        """Whether the control lane holds as much as it should."""
        return len(self._control) >= self._limits.control_messages

    def put_control(self, queued: QueuedMessage) -> None:
        """Add a message that must arrive."""
        self._control.append(queued)
        self._filled.set()

    def put_data(self, tag: str, queued: QueuedMessage, queue_size: int | None = None) -> None:
        """Add a message of a topic; where the queue is full the oldest is dropped and counted.

        Args:
            tag: The interface.
            queued: The message.
            queue_size: Messages of the topic that may wait; None: as many as the limits allow.
        """
        queue = self._small.get(tag) or self._large.get(tag)
        if queue is None:
            limits = self._limits
            queue = BoundedQueue(
                queue_size or limits.topic_messages,
                limits.topic_bytes,
                on_drop=lambda _: self.dropped.update((tag,)),
            )
            queue.put(queued, queued.size, queued.key)
            self._enlist(tag, queue)
        else:
            queue.put(queued, queued.size, queued.key)
        self._filled.set()

    def pop(self) -> QueuedMessage | None:
        """Remove and return what is to be sent next; None if nothing waits."""
        if self._control:
            return self._control.popleft()
        while self._small and not (self._large and self._burst >= self._limits.burst_bytes):
            tag, queue = self._small.popitem(last=False)
            if queue.head_size <= self._limits.small_bytes:
                self._burst += queue.head_size
                return self._take(tag, queue)
            self._enlist(tag, queue)
        if not self._large:
            return None
        self._burst = 0
        return self._take(*self._large.popitem(last=False))

    def _take(self, tag: str, queue: BoundedQueue[QueuedMessage]) -> QueuedMessage:
        queued = queue.take()
        if queue:
            self._enlist(tag, queue)
        return queued

    def _enlist(self, tag: str, queue: BoundedQueue[QueuedMessage]) -> None:
        lane = self._small if queue.head_size <= self._limits.small_bytes else self._large
        lane[tag] = queue

    async def get(self) -> QueuedMessage:
        """Wait until there is something to send; remove and return it. Cancelling removes nothing."""
        while (queued := self.pop()) is None:
            self._filled.clear()
            await self._filled.wait()
        return queued

    def clear(self) -> None:
        """Remove everything, as there is no connection; senders that wait get a :class:`LostError`."""
        while (queued := self.pop()) is not None:
            if queued.sent is not None and not queued.sent.done():
                queued.sent.set_exception(LostError("the connection ended before the message was sent"))
