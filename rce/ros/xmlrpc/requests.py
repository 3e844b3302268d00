"""The requests of a client to one server, from the call until its answer: who waits, and for how long."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from typing import Any

from rce.ros.xmlrpc.batches import MAX_BYTES, MAX_CALLS

STOPPED_S = 2.0
"""An event loop that is later than this was stopped, or its machine was suspended."""
AFTER_STOP_S = 1.0
"""What a request that ran out of time meanwhile has left."""


class RpcRequest:
    """Calls that one caller waits for.

    Attributes:
        uri: The server.
        documents: The calls, encoded; they are made in this order.
        timeout: Seconds that the server may take.
        is_alone: Whether it must not go together with others.
        answer: The value or error of each call.
    """

    def __init__(
        self, uri: str, documents: Sequence[bytes], timeout: float, *, is_alone: bool = False
    ) -> None:
        loop = asyncio.get_running_loop()
        self.uri = uri
        self.documents = documents
        self.timeout = timeout
        self.is_alone = is_alone
        self.answer: asyncio.Future[list[Any]] = loop.create_future()
        self.since = loop.time()
        """When it began to wait: for its turn, or for the server's answer."""
        self.work: asyncio.Task[None] | None = None
        """Makes the calls, once it is their turn."""
        self.group: Sequence[RpcRequest] = ()
        """The requests whose calls are made by the same work."""

    def finish(self, answers: list[Any]) -> None:
        """Hand the answers to the caller, if it still waits."""
        if not self.answer.done():
            self.answer.set_result(answers)

    def fail(self, error: Exception, cause: BaseException | None = None) -> None:
        """Raise an error at the caller, if it still waits."""
        if not self.answer.done():
            error.__cause__ = cause
            self.answer.set_exception(error)


class RequestQueue:
    """Requests to one server; its truth is whether some wait for their turn."""

    def __init__(self) -> None:
        self._waiting: dict[RpcRequest, None] = {}
        self._answered_at = 0.0

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def add(self, request: RpcRequest) -> None:
        """Let a request wait for its turn."""
        self._waiting[request] = None

    def take(self, *, together: bool) -> list[RpcRequest]:
        """Return the request whose turn it is, and with ``together`` as many others as fit beside it."""
        taken: list[RpcRequest] = []
        calls = size = 0
        for request in self._waiting:
            calls += len(request.documents)
            size += sum(map(len, request.documents))
            if taken and (request.is_alone or calls > MAX_CALLS or size > MAX_BYTES):
                break
            taken.append(request)
            if request.is_alone or not together:
                break
        now = asyncio.get_running_loop().time()
        for request in taken:
            del self._waiting[request]
            request.since = now
            request.group = taken
        return taken

    def answered(self, requests: Iterable[RpcRequest] = ()) -> None:
        """Note that the server has answered; the next call of some requests begins now."""
        self._answered_at = asyncio.get_running_loop().time()
        for request in requests:
            request.since = self._answered_at

    async def wait(self, request: RpcRequest) -> list[Any]:
        """Wait for the answers of a request.

        While this program itself is stopped, the server cannot be late: there is time for an answer after it.

        Raises:
            TimeoutError: The server did not answer it in time; or none of the others, while it waited.
            XmlRpcError: It failed.
        """
        loop = asyncio.get_running_loop()
        while not request.answer.done():
            since = max(request.since, self._answered_at) if request.work is None else request.since
            left = since + request.timeout - loop.time()
            if left <= 0:
                raise TimeoutError
            end = loop.time() + left
            await asyncio.wait((request.answer,), timeout=left)
            if loop.time() - end > STOPPED_S:
                await asyncio.wait((request.answer,), timeout=AFTER_STOP_S)
        return request.answer.result()

    def drop(self, request: RpcRequest) -> None:
        """Forget a request whose caller does not wait any more; end its work if none of its group does."""
        self._waiting.pop(request, None)
        if request.answer.done():
            if not request.answer.cancelled():
                request.answer.exception()  # the caller may have been cancelled at the same time
            return
        request.answer.cancel()
        if request.work is not None and all(one.answer.done() for one in request.group):
            # Not at once: a task that is cancelled before its first step does not give its connection back.
            asyncio.get_running_loop().call_soon(request.work.cancel)

    def give_up(self) -> list[RpcRequest]:
        """Return all that wait for their turn, and let them wait no longer."""
        waiting, self._waiting = list(self._waiting), {}
        return waiting
