"""Locks for requests that the planner may refuse."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

from rce_fleet.exceptions import JournalError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable


class ChangeLocks:
    """Locks for what requests change at the planner, one for each robot, cell and so on.

    A request that is refused goes back to what was before it. That must not be what another request wrote to
    which the planner has not answered yet: both may be refused. Emergency stops wait for none
    of these: stations send them to robots and planner themselves.

    Args:
        failure: Returns why nothing can be accepted now; empty: it can.
    """

    def __init__(self, failure: Callable[[], str]) -> None:
        self._failure = failure
        self._locks: WeakValueDictionary[tuple[str, str], asyncio.Lock] = WeakValueDictionary()

    @asynccontextmanager
    async def hold(self, kind: str, name: str = "") -> AsyncIterator[None]:
        """Let requests that change the same thing follow each other.

        Args:
            kind: What is changed: ``mode``, ``goal``, ``zone`` or ``cell``.
            name: Of which robot, or which zone or cell; empty: the fleet's.

        Raises:
            JournalError: The journal cannot be written since then.
        """
        lock = self._locks.setdefault((kind, name), asyncio.Lock())
        async with lock:
            if failure := self._failure():
                raise JournalError(failure)
            yield
