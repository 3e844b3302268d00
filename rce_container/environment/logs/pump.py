"""Moves a node's output from its pipe into its log."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

_CHUNK = 1 << 16
_RATE_WINDOW_S = 0.25
_RATE_BYTES = 2 << 20


class Pump:
    """Reads a pipe, and slows down a writer that floods it.

    Args:
        pipe: The read end; the pump owns it.
        take: Receives the data in pieces.
    """

    def __init__(self, pipe: int, take: Callable[[bytes], None]) -> None:
        os.set_blocking(pipe, False)
        self._loop = asyncio.get_running_loop()
        self._pipe = pipe
        self._take = take
        self._open = True
        self._window_bytes = 0
        self._window_end = 0.0
        self._resume: asyncio.TimerHandle | None = None
        self._loop.add_reader(pipe, self._read)

    def close(self) -> None:
        """Read the rest of the pipe, and close it."""
        for _ in range(_RATE_BYTES // _CHUNK):
            if not self._open or not self._move():
                break
        self._end()

    def _read(self) -> None:
        if not self._move():
            return
        now = self._loop.time()
        if now >= self._window_end:
            self._window_end = now + _RATE_WINDOW_S
            self._window_bytes = 0
        elif self._window_bytes > _RATE_BYTES:
            self._loop.remove_reader(self._pipe)
            self._resume = self._loop.call_at(self._window_end, self._read_on)

    def _read_on(self) -> None:
        self._resume = None
        self._loop.add_reader(self._pipe, self._read)

    def _move(self) -> bool:
        """Move one chunk; return whether there may be more."""
        try:
            data = os.read(self._pipe, _CHUNK)
        except (BlockingIOError, InterruptedError):
            return False
        if not data:
            self._end()
            return False
        self._window_bytes += len(data)
        self._take(data)
        return True

    def _end(self) -> None:
        if not self._open:
            return
        self._open = False
        if self._resume is not None:
            self._resume.cancel()
        self._loop.remove_reader(self._pipe)
        os.close(self._pipe)
