"""Service calls: those that wait for an answer, and those that are being served."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rce.aio.tasks import BackgroundTasks, pass_cancellation
from rce.guard import Holding, Holdings
from rce.link.exceptions import NotConnectedError, OverloadedError
from rce.link.frames import MAX_ID

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce.link.channel import Channel
    from rce.link.interface import Buffer
    from rce.link.settings import LinkLimits

_log = logging.getLogger(__name__)


class PendingCalls:
    """Calls of one channel that have no answer yet, by id."""

    def __init__(self, max_calls: int) -> None:
        self._max_calls = max_calls
        self._last = 0
        self._answers: dict[int, asyncio.Future[bytes]] = {}

    def __len__(self) -> int:
        return len(self._answers)

    def add(self) -> tuple[int, asyncio.Future[bytes]]:
        """Begin a call.

        Returns:
            Its id and its answer.

        Raises:
            OverloadedError: Too many calls have no answer.
        """
        if len(self._answers) >= self._max_calls:
            raise OverloadedError(f"{len(self._answers)} calls have no answer yet")
        self._last = self._last % MAX_ID + 1
        while self._last in self._answers:
            self._last = self._last % MAX_ID + 1
        answer = asyncio.get_running_loop().create_future()
        self._answers[self._last] = answer
        return self._last, answer

    def drop(self, call_id: int) -> bool:
        """Forget a call; false if it was answered."""
        return self._answers.pop(call_id, None) is not None

    def answer(self, call_id: int, payload: bytes) -> None:
        """Hand an answer to its caller, if the caller still waits."""
        answer = self._answers.pop(call_id, None)
        if answer is not None and not answer.done():
            answer.set_result(payload)

    def fail(self, call_id: int, error: Exception) -> None:
        """Fail a call with an error, if its caller still waits."""
        answer = self._answers.pop(call_id, None)
        if answer is not None and not answer.done():
            answer.set_exception(error)

    def fail_all(self, make_error: Callable[[], Exception]) -> None:
        """Fail every waiting call with an error."""
        for call_id in list(self._answers):
            self.fail(call_id, make_error())


class CallServer:
    """Answers the requests that peers send to one interface.

    A request is held until it has been answered. When memory is short, the oldest is answered with a fault.

    At most :attr:`LinkLimits.serving` requests are served at a time; :attr:`LinkLimits.waiting` more wait in
    order, and later ones are answered with a fault at once.
    """

    def __init__(
        self,
        serve: Callable[[bytes], Awaitable[Buffer]],
        limits: LinkLimits,
        name: str,
        holdings: Holdings | None = None,
    ) -> None:
        self._serve = serve
        self._limits = limits
        self._name = name
        self._scope = BackgroundTasks()
        self._serving: dict[tuple[Channel, int], asyncio.Task[None]] = {}
        self._waiting: dict[tuple[Channel, int], bytes] = {}
        self._holdings = Holdings() if holdings is None else holdings
        self._held: dict[tuple[Channel, int], Holding] = {}
        self._closed = False

    def accept(self, channel: Channel, call_id: int, payload: bytes) -> None:
        """Serve a request, now or when its turn comes.

        Raises:
            NotConnectedError: The interface is closed.
            OverloadedError: Too many requests wait.
        """
        if self._closed:
            raise NotConnectedError
        if len(self._scope) < self._limits.serving:
            self._begin(channel, call_id, payload)
        elif len(self._waiting) < self._limits.waiting:
            self._waiting[channel, call_id] = payload
        else:
            raise OverloadedError(f"{len(self._waiting)} requests wait to be served")
        key = channel, call_id
        holding = self._holdings.hold(len(payload), lambda: self._give_up(*key))
        if self.has(*key):
            self._held[key] = holding
        else:
            holding.release()

    def has(self, channel: Channel, call_id: int) -> bool:
        """Return whether a request is being served or waits."""
        return (channel, call_id) in self._serving or (channel, call_id) in self._waiting

    def serves(self, channel: Channel) -> bool:
        """Return whether a request of a channel is being served or waits."""
        return any(key[0] is channel for keys in (self._serving, self._waiting) for key in keys)

    def cancel(self, channel: Channel, call_id: int | None = None) -> None:
        """Stop working on a request, or on all requests of a channel; they get no answer."""
        if call_id is not None:
            self._drop((channel, call_id))
            return
        for key in {*self._held, *self._waiting, *self._serving}:
            if key[0] is channel:
                self._drop(key)

    async def close(self) -> None:
        """Stop working and wait until that has happened."""
        self._closed = True
        self._waiting.clear()
        self._serving.clear()
        for holding in self._held.values():
            holding.release()
        self._held.clear()
        await self._scope.close()

    def _begin(self, channel: Channel, call_id: int, payload: bytes) -> None:
        task = self._scope.spawn(self._run(channel, call_id, payload), name=f"{self._name} request {call_id}")
        self._serving[channel, call_id] = task
        task.add_done_callback(self._next)

    async def _run(self, channel: Channel, call_id: int, payload: bytes) -> None:
        try:
            answer = await self._serve(payload)
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - logged
            pass_cancellation(error)
            _log.debug("%s: request failed", self._name, exc_info=True)
            if self._finish(channel, call_id):
                channel.fault(call_id, error)
        else:
            if self._finish(channel, call_id):
                channel.reply(call_id, answer)

    def _finish(self, channel: Channel, call_id: int) -> bool:
        """Take note that a request was served; return false if its caller no longer waits."""
        if self._serving.get((channel, call_id)) is not asyncio.current_task():
            return False
        del self._serving[channel, call_id]
        holding = self._held.pop((channel, call_id), None)
        if holding is not None:
            holding.release()
        return True

    def _drop(self, key: tuple[Channel, int]) -> None:
        """Stop working on a request, if it is known."""
        self._waiting.pop(key, None)
        if (holding := self._held.pop(key, None)) is not None:
            holding.release()
        if (task := self._serving.pop(key, None)) is not None:
            task.cancel()

    def _give_up(self, channel: Channel, call_id: int) -> None:
        """Answer a request with a fault, because memory is short."""
        if self.has(channel, call_id):
            self.cancel(channel, call_id)
            channel.fault(call_id, OverloadedError("memory is short; the request was given up"))

    def _next(self, _ended: asyncio.Task[None]) -> None:
        while self._waiting and len(self._scope) < self._limits.serving and not self._closed:
            key = next(iter(self._waiting))
            self._begin(*key, self._waiting.pop(key))
