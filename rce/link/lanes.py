"""Which frame a link sends next (sans-I/O).

Three classes, served in this order:

1. frames of the link itself (OPEN, CLOSE, FAULT, CANCEL, PING ...), in order;
2. the *control lane*: channels whose oldest waiting message is small, in turn;
3. the *data lane*: channels whose oldest waiting message is large, one fragment each in turn.

A channel stands in one lane at a time, by its oldest message, so that its messages are never reordered: a
small message overtakes the images of other channels, not its own channel's. After every :data:`URGENT_BURST`
bytes of small messages the data lane gets one fragment, so that it is never starved.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from rce.link.exceptions import ProtocolError
from rce.link.frames import FRAGMENT_SIZE, Frame, FrameType, encode, pack_fragment, pack_header
from rce.link.queues import SMALL_MESSAGE, Lane, OutgoingQueue

if TYPE_CHECKING:
    from rce.link.settings import LinkLimits

URGENT_BURST = 2 * FRAGMENT_SIZE
"""Bytes of small messages after which the data lane gets its turn, if it has anything to send."""
MAX_CONTROL_FRAMES = 16384
"""A peer that lets so many frames of the link itself pile up does not read."""

_JOIN_SIZE = 16 * 1024
"""Up to this size copying a payload behind its header is cheaper than handing two buffers on."""

Chunk = tuple[bytes | memoryview, ...]
"""Buffers to write one after the other."""


class Lanes:
    """The frames that wait on one link."""

    def __init__(self, limits: LinkLimits) -> None:
        self._max_begun = limits.unfinished_bytes
        self._control: deque[bytes] = deque()
        self._urgent: deque[OutgoingQueue] = deque()
        self._bulk: deque[OutgoingQueue] = deque()
        self._burst = 0
        self._begun_bytes = 0

    def __bool__(self) -> bool:
        return bool(self._control or self._urgent or self._bulk)

    @property
    def control(self) -> bool:
        """Whether frames of the link itself wait."""
        return bool(self._control)

    @property
    def urgent(self) -> bool:
        """Whether small messages wait."""
        return bool(self._urgent)

    def add_control(self, frame: Frame) -> None:
        """Append a frame of the link itself.

        Raises:
            ProtocolError: The peer does not read.
        """
        if len(self._control) >= MAX_CONTROL_FRAMES:
            raise ProtocolError("the peer does not read")
        self._control.append(encode(frame))

    def add(self, queue: OutgoingQueue, frame: Frame) -> None:
        """Append a message of a channel.

        Raises:
            OverloadedError: As :meth:`OutgoingQueue.push`.
        """
        queue.push(frame)
        if queue.lane is Lane.NONE:
            self._enlist(queue)

    def withdraw(self, queue: OutgoingQueue, call_id: int) -> bool:
        """Take a call back; the peer is told if it has a part of it. False if all of it is on its way."""
        return self._abort(queue, queue.give_up(call_id)) or queue.withdraw(call_id)

    def clear(self, queue: OutgoingQueue) -> None:
        """Throw away what waits on a channel; the peer is told if it has a part of it."""
        self._abort(queue, queue.clear())

    def _abort(self, queue: OutgoingQueue, begun: int) -> bool:
        """Tell the peer that the rest of a message of ``begun`` bytes does not come; if 0, there is none."""
        if begun:
            self._begun_bytes -= begun
            self._control.append(encode(Frame(FrameType.ABORT, queue.channel)))
        return bool(begun)

    def next(self, limit: int = FRAGMENT_SIZE) -> Chunk | None:
        """Return the next frame to write; none if nothing waits.

        Args:
            limit: Most bytes of payload in a frame of the data lane.
        """
        if self._control:
            return (self._control.popleft(),)
        while self._urgent and not (self._bulk and self._burst >= URGENT_BURST):
            queue = self._leave(self._urgent)
            head = queue.head
            if head is not None and len(head.payload) <= SMALL_MESSAGE:
                return self._whole(queue)
            self._enlist(queue)
        while self._bulk:
            queue = self._leave(self._bulk)
            head = queue.head
            if head is None:
                continue
            if not self._may_begin(queue, head):
                self._enlist(queue)
                continue
            self._burst = 0
            return self._part(queue, limit)
        return self.next(limit) if self._urgent else None

    def _may_begin(self, queue: OutgoingQueue, head: Frame) -> bool:
        """Whether the peer accepts the next part of the queue; true for one queue of the lane at least."""
        return (
            bool(queue.sent)
            or not self._begun_bytes
            or self._begun_bytes + len(head.payload) <= self._max_begun
        )

    def _whole(self, queue: OutgoingQueue) -> Chunk:
        frame, _, size = queue.take()
        self._burst += size
        self._enlist(queue)
        return frame_chunk(frame)

    def _part(self, queue: OutgoingQueue, limit: int) -> Chunk:
        frame, start, end = queue.take(limit)
        total = len(frame.payload)
        if start == 0 and end == total:
            chunk = frame_chunk(frame)
        else:
            length = end - start
            if start == 0:
                self._begun_bytes += total
                header = pack_header(frame, length, total)
            else:
                header = pack_fragment(frame.channel, length, total)
            if end == total:
                self._begun_bytes -= total
            chunk = (header, memoryview(frame.payload)[start:end])
        self._enlist(queue)
        return chunk

    def _enlist(self, queue: OutgoingQueue) -> None:
        head = queue.head
        if head is None:
            queue.lane = Lane.NONE
        elif len(head.payload) <= SMALL_MESSAGE:
            queue.lane = Lane.URGENT
            self._urgent.append(queue)
        else:
            queue.lane = Lane.BULK
            self._bulk.append(queue)

    @staticmethod
    def _leave(lane: deque[OutgoingQueue]) -> OutgoingQueue:
        queue = lane.popleft()
        queue.lane = Lane.NONE
        return queue


def frame_chunk(frame: Frame) -> Chunk:
    """Return the buffers of a frame with its whole payload."""
    size = len(frame.payload)
    header = pack_header(frame, size, size)
    return (header + frame.payload,) if size <= _JOIN_SIZE else (header, frame.payload)
