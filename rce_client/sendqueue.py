"""What waits to be sent to the engine: requests first, then topics in turn. Pure, but for one event."""

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

    Invariant: ``_topics`` holds no empty queue; its order is the order of turns.
    """

    def __init__(self, limits: QueueLimits) -> None:
        self._limits = limits
        self._control: deque[QueuedMessage] = deque()
        self._topics: OrderedDict[str, BoundedQueue[QueuedMessage]] = OrderedDict()
        self._filled = asyncio.Event()
        self.dropped: Counter[str] = Counter()
        """Interface tag to the number of its messages that were thrown away."""

    def __bool__(self) -> bool:
        return bool(self._control or self._topics)

    @property
    def full(self) -> bool:
        """Whether the control lane holds as much as it should."""
        return len(self._control) >= self._limits.control_messages

    def put_control(self, queued: QueuedMessage) -> None:
        """Add a message that must arrive."""
        self._control.append(queued)
        self._filled.set()

    def put_data(self, tag: str, queued: QueuedMessage) -> None:
        """Add a message of a topic; where the queue is full the oldest is dropped and counted."""
        queue = self._topics.get(tag)
        if queue is None:
            limits = self._limits
            queue = self._topics[tag] = BoundedQueue(
                limits.topic_messages, limits.topic_bytes, on_drop=lambda _: self.dropped.update((tag,))
            )
        queue.put(queued, queued.size, queued.key)
        self._filled.set()

    def pop(self) -> QueuedMessage | None:
        """Remove and return what is to be sent next; None if nothing waits."""
        if self._control:
            return self._control.popleft()
        if not self._topics:
            return None
        tag, queue = self._topics.popitem(last=False)
        queued = queue.take()
        if queue:
            self._topics[tag] = queue
        return queued

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
