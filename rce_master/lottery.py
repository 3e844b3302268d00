"""Turns that come every few seconds, drawn by lot among those who wait for them (lottery scheduling).

A queue would not do where anyone may ask as often as they like: those who ask most would hold all its places.
"""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

_Waiting: TypeAlias = "dict[asyncio.Future[None], Callable[[], int]]"


class Lottery:
    """Gives the turns of each key to those who wait for one.

    Args:
        take: Takes a turn of a key if there is one. Returns 0, or the seconds until there is one.
        dice: Chooses; None: one that cannot be predicted.
    """

    def __init__(self, take: Callable[[str], float], dice: random.Random | None = None) -> None:
        self._take = take
        self._dice = dice or random.SystemRandom()
        self._waiting: dict[str, _Waiting] = {}
        self._givers: dict[str, asyncio.Task[None]] = {}

    def take(self, key: str) -> bool:
        """Take a turn now, if there is one that no other waits for; return whether there was one."""
        return key not in self._waiting and not self._take(key)

    async def draw(self, key: str, tickets: Callable[[], int], longest: float) -> bool:
        """Wait for a turn.

        Args:
            key: Whose turns.
            tickets: Returns how many times this caller counts in a draw, at least 1.
            longest: Seconds to wait at most.

        Returns:
            Whether it has a turn; if not, others drew all that came meanwhile.
        """
        own = asyncio.get_running_loop().create_future()
        if key not in self._waiting:
            self._waiting[key] = {}
            self._givers[key] = asyncio.create_task(self._give(key), name="lottery")
        waiting = self._waiting[key]
        waiting[own] = tickets
        try:
            drawn, _ = await asyncio.wait([own], timeout=longest)
            return bool(drawn)
        finally:
            waiting.pop(own, None)
            if not waiting and self._waiting.get(key) is waiting:
                del self._waiting[key]
                self._givers.pop(key).cancel()

    async def _give(self, key: str) -> None:
        """Give turns as they come, until all who wait have one."""
        waiting = self._waiting[key]
        while waiting:
            seconds = self._take(key)
            if seconds:
                await asyncio.sleep(seconds)
                continue
            tickets = [count() for count in waiting.values()]
            (chosen,) = self._dice.choices(list(waiting), tickets)
            del waiting[chosen]
            chosen.set_result(None)
        del self._waiting[key], self._givers[key]
