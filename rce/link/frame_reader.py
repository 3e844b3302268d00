"""Reads frames from a stream, each message straight into its memory (sans-I/O)."""

from __future__ import annotations

import io

from rce.buffers import unfilled
from rce.link.exceptions import ProtocolError
from rce.link.frames import HEADER, HEADER_SIZE, Frame, FrameType
from rce.link.settings import KIB, LinkLimits

_TYPES = {int(t): t for t in FrameType}
_CARRIERS = frozenset({FrameType.DATA, FrameType.CALL, FrameType.REPLY})
_NOTHING = io.BytesIO()
_SCRATCH_SIZE = 64 * KIB
_DIRECT_SIZE = 16 * KIB
"""Payloads from here on are read straight into their message, unless all of them is there already."""


class _Message:
    """A message that is being received; handed on only when all of its memory was filled."""

    __slots__ = ("_buffer", "dropped", "filled", "first", "total", "view")

    def __init__(self, first: Frame, total: int) -> None:
        self.first = first
        self.total = total
        self.filled = 0
        self.dropped = False
        """Whether nothing is kept of it; the rest is read to get past it."""
        self._buffer = unfilled(total)
        self.view = self._buffer.getbuffer()

    def write(self, data: memoryview) -> None:
        end = self.filled + len(data)
        if not self.dropped:
            self.view[self.filled : end] = data
        self.filled = end

    def finish(self) -> Frame:
        self.view.release()
        return self.first._replace(payload=self._buffer.getvalue())

    def discard(self) -> None:
        """Release the buffer; it must not be freed while a view of it exists."""
        self.dropped = True
        self.view.release()
        self._buffer = _NOTHING


class FrameReader:
    """Turns bytes into frames: fill :meth:`get_buffer`, then tell :meth:`advance` how much was filled.

    Attributes:
        max_message: Largest message that is accepted, in bytes.
        held_bytes: Set aside for messages that have not come as a whole yet.
    """

    def __init__(self, limits: LinkLimits, *, max_message: int | None = None) -> None:
        self.max_message = limits.max_message if max_message is None else max_message
        self._max_unfinished_bytes = limits.unfinished_bytes
        self._unfinished_bytes = 0
        self.held_bytes = 0
        self._scratch = memoryview(bytearray(_SCRATCH_SIZE))
        self._start = 0
        self._end = 0
        self._unfinished: dict[int, _Message] = {}
        self._current: _Message | None = None
        """The message whose payload is read straight into it."""
        self._missing = 0
        """Payload bytes of the current frame that have not come yet."""

    def get_buffer(self) -> memoryview:
        """Return where the next bytes go; never empty."""
        message = self._current
        # The last byte of a frame goes through the scratch: an event loop holds the buffer that it fills
        # until `advance` returns, and until then the message could not be taken without a copy.
        if message is not None and self._missing > 1 and not message.dropped:
            return message.view[message.filled : message.filled + self._missing - 1]
        return self._scratch[self._end :]

    def advance(self, count: int) -> list[Frame]:
        """Take ``count`` bytes that were written to the buffer.

        Returns:
            The messages that these bytes completed, in order.

        Raises:
            ProtocolError: The bytes are not frames. The reader cannot be used any more.
        """
        if self._current is not None and self._missing > 1 and not self._current.dropped:
            self._current.filled += count
            self._missing -= count
            return []
        self._end += count
        return self._parse()

    @property
    def missing(self) -> int:
        """Bytes that are needed at least to continue: of a header, or of the frame whose header is known."""
        if self._current is not None:
            return self._missing
        known = self._end - self._start
        if known < HEADER_SIZE:
            return HEADER_SIZE - known
        length: int = HEADER.unpack_from(self._scratch, self._start)[5]
        return HEADER_SIZE + length - known

    def feed(self, data: bytes | memoryview) -> list[Frame]:
        """Take bytes that lie elsewhere. As :meth:`advance`."""
        frames: list[Frame] = []
        rest = memoryview(data)
        while rest:
            buffer = self.get_buffer()
            count = min(len(buffer), len(rest))
            buffer[:count] = rest[:count]
            buffer.release()
            frames += self.advance(count)
            rest = rest[count:]
        return frames

    def drop_unfinished(self, size: int) -> list[Frame]:
        """Forget the oldest messages that have not come as a whole yet; their remaining bytes are skipped.

        Not to be called between :meth:`get_buffer` and :meth:`advance`.

        Args:
            size: Bytes that are to be free, if so many are held.

        Returns:
            The first frame of each, without payload.
        """
        goal = self.held_bytes - size
        dropped: list[Frame] = []
        for message in self._messages():
            if self.held_bytes <= goal:
                break
            if not message.dropped:
                message.discard()
                self.held_bytes -= message.total
                dropped.append(message.first)
        return dropped

    def close(self) -> None:
        """Forget the messages that did not become complete. The reader cannot be used any more."""
        for message in self._messages():
            message.discard()
        self._unfinished.clear()
        self._current = None

    def _messages(self) -> list[_Message]:
        """Return what has not come as a whole yet, oldest first."""
        current = {} if self._current is None else {self._current: None}
        return list(dict.fromkeys(self._unfinished.values()) | current)

    def _parse(self) -> list[Frame]:
        frames: list[Frame] = []
        while self._start < self._end:
            if self._current is not None:
                self._continue_payload(frames)
            elif self._end - self._start < HEADER_SIZE or not self._parse_frame(frames):
                break
        self._compact()
        return frames

    def _continue_payload(self, frames: list[Frame]) -> None:
        message = self._current
        assert message is not None
        count = min(self._missing, self._end - self._start)
        message.write(self._scratch[self._start : self._start + count])
        self._start += count
        self._missing -= count
        if self._missing == 0:
            self._current = None
            if message.filled == message.total:
                if self._unfinished.get(message.first.channel) is message:
                    del self._unfinished[message.first.channel]
                    self._unfinished_bytes -= message.total
                if not message.dropped:
                    self.held_bytes -= message.total
                    frames.append(message.finish())

    def _parse_frame(self, frames: list[Frame]) -> bool:
        """Parse the frame at the start of the scratch; false if more of it must come first."""
        number, flags, zero, call_id, channel, length, total = HEADER.unpack_from(self._scratch, self._start)
        frame_type = _TYPES.get(number)
        if frame_type is None or zero:
            raise ProtocolError("these bytes are not a frame")
        if length > total or total > self.max_message:
            raise ProtocolError(f"message of {total} bytes (limit {self.max_message}), {length} in one frame")
        body = self._start + HEADER_SIZE
        is_here = length <= self._end - body
        is_small = length < _DIRECT_SIZE and frame_type is not FrameType.FRAGMENT
        if length == total and (is_small or (is_here and frame_type in _CARRIERS)):
            if not is_here:
                return False
            self._start = body + length
            frame = Frame(frame_type, channel, call_id, flags, bytes(self._scratch[body : self._start]))
            if frame_type is not FrameType.ABORT:
                frames.append(frame)
            else:
                self._abort(channel)
            return True
        self._start = body
        self._begin_payload(Frame(frame_type, channel, call_id, flags), length, total)
        return True

    def _begin_payload(self, first: Frame, length: int, total: int) -> None:
        if length == 0:
            raise ProtocolError("empty part of a message")
        message = self._unfinished.get(first.channel)
        if first.type is FrameType.FRAGMENT:
            if message is None or message.total != total or message.filled + length > total:
                raise ProtocolError("fragment of an unknown message")
        elif first.type not in _CARRIERS:
            raise ProtocolError(f"{first.type.name} of {total} bytes")
        elif length < total:
            if message is not None or self._unfinished_bytes + total > self._max_unfinished_bytes:
                raise ProtocolError("too many unfinished messages")
            message = self._unfinished[first.channel] = _Message(first, total)
            self._unfinished_bytes += total
            self.held_bytes += total
        else:
            message = _Message(first, total)
            self.held_bytes += total
        self._current = message
        self._missing = length

    def _abort(self, channel: int) -> None:
        message = self._unfinished.pop(channel, None)
        if message is None:
            raise ProtocolError("ABORT without an unfinished message")
        self._unfinished_bytes -= message.total
        if not message.dropped:
            self.held_bytes -= message.total
        message.discard()

    def _compact(self) -> None:
        if self._start == self._end:
            self._start = self._end = 0
        elif self._start + HEADER_SIZE + _DIRECT_SIZE > _SCRATCH_SIZE:
            rest = bytes(self._scratch[self._start : self._end])
            self._scratch[: len(rest)] = rest
            self._start, self._end = 0, len(rest)
