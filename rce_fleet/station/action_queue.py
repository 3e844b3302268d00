"""The actions of a station's users on their way to the engine's audit log."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce.aio.backoff import Backoff

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce_fleet.station.authentication import AuditedAction

_log = logging.getLogger(__name__)

MAX_QUEUED = 1000
"""Actions that wait while the engine is away; beyond it, further ones are dropped, and logged."""
PAUSES = Backoff(first=0.5, longest=30.0, jitter=0.5)
DRAIN_S = 3.0
"""How long a station that ends tries to send what waits."""


class EngineAwayError(Exception):
    """The engine does not take an action now.

    Attributes:
        retry_after: Seconds after which it may.
    """

    def __init__(self, reason: str, retry_after: float = 0.0) -> None:
        self.retry_after = retry_after
        super().__init__(reason)


class ActionRefusedError(Exception):
    """The engine never takes this action."""


@dataclass(frozen=True, slots=True)
class QueuedAction:
    """An action of a user."""

    token: str
    """The user's token, which may have ended when the action is sent; empty: the station itself."""
    user: str
    """The user's name; empty if it is not known."""
    action: AuditedAction

    def __str__(self) -> str:
        return f"{self.action.name} {self.action.subject} by {self.user or 'the station'}"


class ActionQueue:
    """Sends actions in their order, each until the engine has taken it.

    If an answer is lost, an action is sent once more, and may be in the audit log twice.

    Args:
        send: Sends one; raises :class:`EngineAwayError` or :class:`ActionRefusedError`.
    """

    def __init__(self, send: Callable[[QueuedAction], Awaitable[None]]) -> None:
        self._send = send
        self._waiting: deque[QueuedAction] = deque()
        self._some, self._none = asyncio.Event(), asyncio.Event()
        """Whether actions wait, and whether none do."""
        self._none.set()

    def put(self, queued: QueuedAction) -> None:
        """Let an action be sent, or drop it if too many wait. Does not wait."""
        if len(self._waiting) >= MAX_QUEUED:
            _log.warning("not in the audit log, too many wait for the engine: %s", queued)
            return
        self._waiting.append(queued)
        self._some.set()
        self._none.clear()

    async def run(self) -> None:
        """Send until cancelled."""
        pauses = PAUSES.start()
        is_away = False
        while True:
            await self._some.wait()
            queued = self._waiting[0]
            try:
                await self._send(queued)
            except EngineAwayError as error:
                if not is_away:
                    _log.warning("the engine takes no actions for its audit log, they wait: %s", error)
                is_away = True
                await asyncio.sleep(max(pauses.next(), error.retry_after))
                continue
            except ActionRefusedError as error:
                _log.warning("not in the audit log: %s: %s", queued, error)
            is_away = False
            pauses.reset()
            self._waiting.popleft()
            if not self._waiting:
                self._some.clear()
                self._none.set()

    async def drain(self) -> None:
        """Wait until all are sent, for :data:`DRAIN_S` at most; :meth:`run` must run."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(DRAIN_S):
                await self._none.wait()

    def drop(self) -> None:
        """Drop what waits, after :meth:`run` was cancelled, and log it."""
        for queued in self._waiting:
            _log.warning("not in the audit log, the station ends: %s", queued)
        self._waiting.clear()
