"""Reads logs for the master, concurrently with its other requests."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rce.aio.tasks import BackgroundTasks
from rce.control import LogChunk, ReadLog
from rce.guard import CrowdedError, Turns

if TYPE_CHECKING:
    from collections.abc import Callable

AT_ONCE = 2
MAX_WAITING = 256


class LogReads:
    """Reads for several users at once; a user with many requests delays only their own.

    Args:
        read: Reads a piece of a log. Blocks; runs in a thread.
        send: Takes the answers.
    """

    def __init__(self, read: Callable[[ReadLog], LogChunk], send: Callable[[LogChunk], object]) -> None:
        self._read = read
        self._send = send
        self._turns = Turns(AT_ONCE, waiting=MAX_WAITING)
        self._tasks = BackgroundTasks()
        self._closed = False

    def take(self, message: ReadLog) -> None:
        """Queue a request; the answer follows later."""
        if self._closed:
            return
        self._tasks.spawn(self._answer(message), name=f"read of the log of {message.id}")

    async def close(self) -> None:
        """Stop answering."""
        self._closed = True
        await self._tasks.close()

    async def _answer(self, message: ReadLog) -> None:
        try:
            async with self._turns.turn(message.id.partition("/")[0]):
                chunk = await asyncio.to_thread(self._read, message)
        except CrowdedError:
            error = "too many logs are read on this machine just now; try again in a moment"
            chunk = LogChunk(request=message.request, offset=message.offset, error=error)
        self._send(chunk)
