"""Sends again what a busy engine dropped."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rce.aio.backoff import Backoff

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

PAUSES = Backoff(first=0.5, longest=30.0, jitter=0.5)
"""Pauses until the requests are sent again."""

CALM_S = 2.0
"""After so long without a drop, the engine has taken all that was repeated."""


class Repetition:
    """Repeats requests until the engine drops none of them.

    An engine drops requests of a client that sends them faster than the master carries them out. It names
    their type only, so all are repeated; the engine takes what is there already silently.

    Args:
        spawn: Runs a coroutine as long as the connection is used.
        repeat: Sends all requests again.
        on_dropped: Called with the number of drops before they are repeated, not with each: a program that
            makes a thousand interfaces would fill its log.
    """

    def __init__(
        self,
        spawn: Callable[[Coroutine[object, object, None]], asyncio.Task[None]],
        repeat: Callable[[], Awaitable[None]],
        on_dropped: Callable[[int], None],
    ) -> None:
        self._spawn = spawn
        self._repeat = repeat
        self._on_dropped = on_dropped
        self._task: asyncio.Task[None] | None = None
        self._dropped = 0

    def note_drop(self) -> None:
        """Learn that the engine dropped a request."""
        self._dropped += 1
        if self._task is None or self._task.done():
            self._task = self._spawn(self._run())

    async def _run(self) -> None:
        pauses = PAUSES.start()
        while self._dropped:
            await asyncio.sleep(pauses.next())
            dropped, self._dropped = self._dropped, 0
            self._on_dropped(dropped)
            await self._repeat()
            await asyncio.sleep(CALM_S)
