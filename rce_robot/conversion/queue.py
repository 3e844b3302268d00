"""Conversions that take long (pictures), in a thread, one after the other, so that nobody else waits."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

In = TypeVar("In")
Out = TypeVar("Out")

MAX_WAITING = 4
"""Messages that wait for their conversion; more would only grow old."""


class Conveyor(Generic[In, Out]):
    """The costly conversions of one interface, in order. The oldest that waits gives way to a new one.

    Args:
        run: Runs a coroutine for as long as the robot is there; False if it does not.
        work: The conversion, called in a thread. Must not raise.
        deliver: Called in the event loop with what ``work`` returned.
    """

    def __init__(
        self,
        run: Callable[[Coroutine[Any, Any, None]], bool],
        work: Callable[[In], Out],
        deliver: Callable[[Out], None],
    ) -> None:
        self._run = run
        self._work = work
        self._deliver = deliver
        self._waiting: deque[In] = deque(maxlen=MAX_WAITING)
        self._running = False

    def put(self, item: In) -> bool:
        """Add a message; False if one had to be thrown away."""
        room = len(self._waiting) < MAX_WAITING
        self._waiting.append(item)
        if not self._running:
            self._running = self._run(self._convey())
            if not self._running:
                self._waiting.clear()
                return False
        return room

    def clear(self) -> None:
        """Forget what waits, because what ran has ended with the robot's connection."""
        self._waiting.clear()
        self._running = False

    async def _convey(self) -> None:
        try:
            while self._waiting:
                self._deliver(await asyncio.to_thread(self._work, self._waiting.popleft()))
        finally:
            self._running = False
            self._waiting.clear()
