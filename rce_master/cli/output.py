"""Writing to this program's standard streams without blocking the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from queue import SimpleQueue
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable


class OutputWriter:
    """Writes in a thread, for a pager or a full pipe may take nothing for hours.

    Non-blocking writes would not do: that mode belongs to the open file, which other programs share, and the
    event loop cannot wait for regular files. To be used as a context manager, in an event loop. The thread
    does not keep the program from ending.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._pieces: SimpleQueue[tuple[int, bytes] | None] = SimpleQueue()
        self._queued = self._written = self._told = 0
        self._advanced = 0.0
        """When something was written, or the first piece came after all was written."""
        self._error: OSError | None = None
        self._changed = asyncio.Event()

    def __enter__(self) -> Self:
        threading.Thread(target=self._work, name="output", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._pieces.put(None)

    def write(self, fd: int, data: bytes) -> None:
        """Have bytes written to a descriptor."""
        if self._written == self._queued:
            self._advanced = self._loop.time()
        self._queued += len(data)
        self._pieces.put((fd, data))

    @property
    def stuck_for(self) -> float:
        """Seconds for which nothing was written though something waits; 0 if nothing waits."""
        return 0.0 if self._written == self._queued else self._loop.time() - self._advanced

    async def written(self) -> int:
        """Wait until something was written; return how many bytes since the last call. For one caller.

        Raises:
            OSError: Something could not be written.
        """
        await self._until(lambda: self._written > self._told)
        amount = self._written - self._told
        self._told = self._written
        return amount

    async def drain(self) -> None:
        """Wait until all is written.

        Raises:
            OSError: Something could not be written.
        """
        await self._until(lambda: self._written == self._queued)

    async def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            if self._error is not None:
                raise self._error
            self._changed.clear()
            await self._changed.wait()

    def _work(self) -> None:
        while (piece := self._pieces.get()) is not None:
            fd, data = piece
            rest = memoryview(data)
            try:
                while rest:
                    rest = rest[os.write(fd, rest) :]
            except OSError as error:
                self._tell(0, error)
                return
            self._tell(len(data), None)

    def _tell(self, amount: int, error: OSError | None) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop has ended meanwhile
            self._loop.call_soon_threadsafe(self._note, amount, error)

    def _note(self, amount: int, error: OSError | None) -> None:
        self._written += amount
        self._advanced = self._loop.time()
        self._error = error
        self._changed.set()
