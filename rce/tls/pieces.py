"""Writes to a TLS transport in pieces, so that what waits there stays countable.

A TLS transport of asyncio or uvloop encrypts what it gets at once, and says only what it has not encrypted
yet: encrypted data that the other end does not take neither counts nor pauses the writer.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

PIECE = 64 << 10
"""Bytes that are written at a time. With the transport's own limit, about the most that is not counted."""


class PiecewiseTransport(asyncio.Transport):
    """Takes the place of a TLS transport for its protocol.

    The protocol calls :meth:`resume_sending` when the transport has told it to resume, and :meth:`forget`
    when the connection is lost.

    Args:
        transport: The TLS transport.
        is_paused: Returns whether it has paused the protocol.
    """

    def __init__(self, transport: asyncio.Transport, is_paused: Callable[[], bool]) -> None:
        super().__init__()
        self._transport = transport
        self._is_paused = is_paused
        self._kept: deque[memoryview] = deque()
        self._kept_bytes = 0
        self._closing = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Write data, or keep it until the transport takes it."""
        if len(data) <= PIECE and not self._kept and not self._closing and not self._is_paused():
            self._transport.write(data)
        else:
            self.writelines((data,))

    def writelines(self, buffers: Iterable[bytes | bytearray | memoryview]) -> None:
        """Write several buffers, one after the other."""
        if self.is_closing():
            return
        for data in buffers:
            if len(data):
                self._kept.append(memoryview(data))
                self._kept_bytes += len(data)
        self.resume_sending()

    def resume_sending(self) -> None:
        """Write what was kept, as far as the transport takes it; then close, if that was asked for."""
        while self._kept and not self._is_paused():
            self._transport.writelines(self._next_piece())
        if self._closing and not self._kept:
            self._transport.close()

    def forget(self) -> None:
        """Drop what was kept."""
        self._kept.clear()
        self._kept_bytes = 0

    def close(self) -> None:
        """Close the transport when it has taken everything."""
        self._closing = True
        self.resume_sending()

    def abort(self) -> None:
        """Close the transport at once."""
        self._closing = True
        self.forget()
        self._transport.abort()

    def is_closing(self) -> bool:
        """Return whether the transport closes, or will."""
        return self._closing or self._transport.is_closing()

    def get_write_buffer_size(self) -> int:
        """Return the bytes that wait, here or in the transport."""
        return self._kept_bytes + self._transport.get_write_buffer_size()

    # The transport's own

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Return what is known of the connection."""
        return self._transport.get_extra_info(name, default)

    def pause_reading(self) -> None:
        """Pass no received data on until reading is resumed."""
        self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Pass received data on."""
        self._transport.resume_reading()

    def is_reading(self) -> bool:
        """Return whether received data is passed on."""
        return self._transport.is_reading()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Set when the protocol is paused."""
        self._transport.set_write_buffer_limits(high, low)

    def get_write_buffer_limits(self) -> tuple[int, int]:
        """Return when the protocol is paused."""
        return self._transport.get_write_buffer_limits()

    def can_write_eof(self) -> bool:
        """Return that TLS cannot close one direction alone."""
        return False

    def _next_piece(self) -> list[memoryview]:
        piece: list[memoryview] = []
        room = PIECE
        while self._kept and room:
            data = self._kept.popleft()
            if len(data) > room:
                self._kept.appendleft(data[room:])
                data = data[:room]
            piece.append(data)
            room -= len(data)
        self._kept_bytes -= PIECE - room
        return piece
