"""What waits to be sent to the engine: requests first, then topics in turn. Pure, but for one event."""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_client.exceptions import LostError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.protocol.codec import Frame


@dataclass(frozen=True, slots=True)
class QueueLimits:
    """How much may wait to be sent. A topic's queue always takes one message, however large."""

    topic_messages: int = 64
    topic_bytes: int = 16 << 20
    control_messages: int = 1024
    """Service messages and requests; sending another waits."""


@dataclass(eq=False, slots=True)
class Parcel:
    """The frames of one message."""

    frames: Sequence[Frame]
    size: int
    key: str | None = None
    """A message with a key is dropped only for a newer one of the same key: what is latched, by source."""
    sent: asyncio.Future[None] | None = None
    """Completed when the message was handed to the network, or could not be."""

    @classmethod
    def of(cls, frames: Sequence[Frame], key: str | None = None) -> Parcel:
        """Make a parcel of frames as :mod:`rce.protocol.codec` writes them."""
        return cls(frames, sum(map(len, frames)), key)


class SendQueue:
    """Two lanes: control, in order and complete; data, one queue per interface that forgets its oldest.

    Invariant: ``_topics`` holds no empty queue; its order is the order of turns.
    """

    def __init__(self, limits: QueueLimits) -> None:
        self._limits = limits
        self._control: deque[Parcel] = deque()
        self._topics: OrderedDict[str, deque[Parcel]] = OrderedDict()
        self._bytes: Counter[str] = Counter()
        self._filled = asyncio.Event()
        self.dropped: Counter[str] = Counter()
        """Interface tag to the number of its messages that were thrown away."""

    def __bool__(self) -> bool:
        return bool(self._control or self._topics)

    @property
    def full(self) -> bool:
        """Whether the control lane holds as much as it should."""
        return len(self._control) >= self._limits.control_messages

    def put_control(self, parcel: Parcel) -> None:
        """Add a message that must arrive."""
        self._control.append(parcel)
        self._filled.set()

    def put_data(self, tag: str, parcel: Parcel) -> None:
        """Add a message of a topic; where the queue is full the oldest is dropped and counted."""
        queue = self._topics.setdefault(tag, deque())
        limits = self._limits
        while len(queue) >= limits.topic_messages or self._bytes[tag] + parcel.size > limits.topic_bytes:
            index = _oldest_to_drop(queue, parcel.key)
            if index is None:
                break
            self._bytes[tag] -= queue[index].size
            del queue[index]
            self.dropped[tag] += 1
        queue.append(parcel)
        self._bytes[tag] += parcel.size
        self._filled.set()

    def pop(self) -> Parcel | None:
        """Take what is to be sent next, None if nothing waits."""
        if self._control:
            return self._control.popleft()
        if not self._topics:
            return None
        tag, queue = self._topics.popitem(last=False)
        parcel = queue.popleft()
        self._bytes[tag] -= parcel.size
        if queue:
            self._topics[tag] = queue
        else:
            del self._bytes[tag]
        return parcel

    async def get(self) -> Parcel:
        """Wait for what is to be sent next."""
        while (parcel := self.pop()) is None:
            self._filled.clear()
            await self._filled.wait()
        return parcel

    def clear(self) -> None:
        """Throw away everything, because there is no connection to send it on."""
        while (parcel := self.pop()) is not None:
            if parcel.sent is not None and not parcel.sent.done():
                parcel.sent.set_exception(LostError("the connection ended before the message was sent"))


def _oldest_to_drop(queue: Sequence[Parcel], key: str | None) -> int | None:
    """Return the oldest message that has no key, or one that a newer message or the next one has too."""
    newest = {parcel.key: index for index, parcel in enumerate(queue)}
    if key is not None:
        newest.pop(key, None)
    return next(
        (i for i, parcel in enumerate(queue) if parcel.key is None or newest.get(parcel.key) != i), None
    )
