"""The most common WebSocket frames: whole messages without extensions (RFC 6455, section 5.2).

For a small message, the ``websockets`` library takes longer for a frame than the engine for all other work.
So this module reads and writes these frames; the library reads all others, and answers pings. Pure.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from websockets.frames import Opcode

try:
    from websockets.speedups import apply_mask
except ImportError:  # the library was installed without its C extension
    from websockets.utils import apply_mask

if TYPE_CHECKING:
    from rce_robot.outgoing import Buffer

FIN_TEXT = 0x80 | Opcode.TEXT
FIN_BINARY = 0x80 | Opcode.BINARY
JOIN_BELOW = 16 << 10
"""Below this many bytes a copy costs less than another buffer in the transport's queue."""

_SHORT = struct.Struct("!BB")
_MEDIUM = struct.Struct("!BBH")
_LONG = struct.Struct("!BBQ")
_TWO_BYTE_LENGTH, _EIGHT_BYTE_LENGTH = 126, 127
_MASKED = 0x80
_MASK_SIZE = 4
_PONG = bytes((0x80 | Opcode.PONG,))
_WHOLE = {int(FIN_TEXT): Opcode.TEXT, int(FIN_BINARY): Opcode.BINARY}


class Found(NamedTuple):
    """A message that was received in one frame."""

    opcode: Opcode
    data: bytes
    end: int
    """Where the next frame begins."""


def find_message(data: bytes, start: int, max_size: int) -> Found | None:
    """Read a masked frame that is a message as a whole.

    Args:
        data: The received data.
        start: The beginning of a frame in it.
        max_size: Longest payload in bytes.

    Returns:
        None if the frame is of another kind, invalid or incomplete: the library handles it.
    """
    if len(data) < start + _SHORT.size:
        return None
    opcode = _WHOLE.get(data[start])
    size = data[start + 1] - _MASKED
    if opcode is None or size < 0:
        return None
    begin = start + _SHORT.size
    if size == _TWO_BYTE_LENGTH:
        begin = start + _MEDIUM.size
        size = int.from_bytes(data[start + _SHORT.size : begin], "big")
    elif size == _EIGHT_BYTE_LENGTH:
        begin = start + _LONG.size
        size = int.from_bytes(data[start + _SHORT.size : begin], "big")
    begin += _MASK_SIZE
    end = begin + size
    if end > len(data) or size > max_size:
        return None
    return Found(opcode, apply_mask(memoryview(data)[begin:end], data[begin - _MASK_SIZE : begin]), end)


def add_frame(buffers: list[Buffer], first: int, head: bytes, body: Buffer) -> None:
    """Append an unmasked frame of the payload ``head`` + ``body``, which begins with the byte ``first``."""
    size = len(head) + len(body)
    if size < _TWO_BYTE_LENGTH:
        header = _SHORT.pack(first, size)
    elif size < 1 << 16:
        header = _MEDIUM.pack(first, _TWO_BYTE_LENGTH, size)
    else:
        header = _LONG.pack(first, _EIGHT_BYTE_LENGTH, size)
    if size < JOIN_BELOW:
        buffers.append(b"".join((header, head, body)))
    else:
        buffers.append(header + head)
        buffers.append(body)


class Pongs:
    """Answers only the newest of several pings, and none while the robot does not read.

    RFC 6455, section 5.5.3, allows it. Otherwise a robot that sends pings and reads nothing would make the
    endpoint keep an answer to each.
    """

    def __init__(self) -> None:
        self._newest = b""

    def take(self, writes: list[bytes], *, writable: bool) -> list[bytes]:
        r"""Return what is to be written of the library's frames, in their order.

        Args:
            writes: Whole frames; an empty one ends the stream.
            writable: Whether a pong may be written now.

        Example:
            >>> pongs = Pongs()
            >>> pongs.take([b"\x8a\x00", b"\x8a\x01x", b"\x88\x00"], writable=True)
            [b'\x8a\x01x', b'\x88\x00']
        """
        pongs = [place for place, frame in enumerate(writes) if frame.startswith(_PONG)]
        if not pongs:
            return writes
        newest = pongs.pop()
        if not writable:
            self._newest = writes[newest]
            pongs.append(newest)
        dropped = frozenset(pongs)
        return [frame for place, frame in enumerate(writes) if place not in dropped]

    def pop(self) -> bytes:
        """Return the pong that waits, and forget it; empty if there is none."""
        newest, self._newest = self._newest, b""
        return newest
