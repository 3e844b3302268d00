"""Bodies of requests that end if the server takes nothing of them: aiohttp limits only what follows them."""

from __future__ import annotations

import asyncio
import contextlib
import io
import os
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from typing import BinaryIO

_PIECE = 1 << 16
"""Bytes that are taken at a time: few, so that a slow network counts as one that works."""


class StalledError(TimeoutError):
    """The server took nothing of a body for too long."""


@contextlib.asynccontextmanager
async def watched_body(
    file: BinaryIO, *, stall_s: float, answer_s: float
) -> AsyncIterator[io.BufferedIOBase]:
    """Give a file as the body of a request, and cancel the block if the server hangs or was cut off.

    Args:
        file: What is sent.
        stall_s: Seconds in which some of it has to be taken, as long as there is more of it.
        answer_s: Seconds that the rest of the block may take once all was taken.

    Raises:
        StalledError: Nothing was taken for ``stall_s``.
        TimeoutError: The block did not end within ``answer_s``.

    Example:
        >>> async with watched_body(file, stall_s=30, answer_s=300) as body:
        ...     await session.put(url, data=body)
    """
    body = _Body(file)
    loop = asyncio.get_running_loop()
    timer: asyncio.TimerHandle
    try:
        async with asyncio.timeout(None) as limit:

            def look() -> None:
                nonlocal timer
                left = body.taken + (answer_s if body.is_all_taken else stall_s) - time.monotonic()
                if left > 0:
                    timer = loop.call_later(left, look)
                else:
                    limit.reschedule(loop.time())

            timer = loop.call_later(stall_s, look)
            try:
                yield body
            finally:
                timer.cancel()
    except TimeoutError as error:
        if limit.expired() and not body.is_all_taken:
            raise StalledError(f"it took nothing of the file for {stall_s:.0f} s") from error
        raise


class _Body(io.BufferedIOBase):
    """A file that notes when it was read: aiohttp reads a piece, in a thread, once the last one was taken."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        start = file.tell()
        self._size = file.seek(0, os.SEEK_END)
        file.seek(start)
        self.taken = time.monotonic()
        self.is_all_taken = False

    def read(self, size: int | None = -1, /) -> bytes:
        piece = self._file.read(_PIECE if size is None or size < 0 else min(size, _PIECE))
        self.taken = time.monotonic()
        self.is_all_taken = self._file.tell() >= self._size
        return piece

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def fileno(self) -> int:
        return self._file.fileno()
