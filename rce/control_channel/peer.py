"""The master's view of one task set."""

from __future__ import annotations

import asyncio
import itertools
import logging
from typing import TYPE_CHECKING, Any, TypeVar

from rce.control import (
    Hello,
    LogChunk,
    LogQuery,
    PeerGoneError,
    PeerTimeoutError,
    ReadLog,
    SaveState,
    StateSaved,
    Sync,
    TaskSetKind,
    ToTaskSet,
    encode,
)
from rce.control_channel.timeouts import MAX_QUEUED, MAX_TEXT, ControlTimeouts
from rce.liveness.websocket import WatchedConnection

if TYPE_CHECKING:
    from collections.abc import Callable

    from websockets.asyncio.server import ServerConnection


_log = logging.getLogger(__name__)

A = TypeVar("A", LogChunk, StateSaved)


class Peer:
    """A task set that is connected."""

    def __init__(
        self,
        hello: Hello,
        socket: ServerConnection,
        timeouts: ControlTimeouts,
        is_fenced: Callable[[], bool] | None = None,
    ) -> None:
        self.hello = hello
        self._is_fenced = is_fenced
        self._socket = socket
        self._timeouts = timeouts
        self._outbox: asyncio.Queue[tuple[str, int]] = asyncio.Queue(MAX_QUEUED)
        """Messages, and how many characters of each count."""
        self._waiting = 0
        """Characters that count and wait."""
        self._numbers = itertools.count(1)
        self._asked: dict[int, asyncio.Future[Any]] = {}
        """Answers that are waited for, by the numbers of the requests."""
        self._left = False
        self.finished = asyncio.Event()
        """Set by the server when it is done with this peer."""

    def __repr__(self) -> str:
        return f"<Peer {self.kind.value} {self.process}>"

    @property
    def process(self) -> str:
        """The task set's name."""
        return self.hello.process

    @property
    def kind(self) -> TaskSetKind:
        """Which kind of task set it is."""
        return self.hello.kind

    @property
    def silence(self) -> float:
        """For how many seconds it gave no sign of life."""
        return self._socket.silence if isinstance(self._socket, WatchedConnection) else 0.0

    @property
    def features(self) -> frozenset[str]:
        """The features of this task set that one of an earlier release did not have."""
        return frozenset(self.hello.features)

    def send(self, message: ToTaskSet) -> None:
        """Send a message; never blocks. A peer that is too far behind is disconnected, and dials again."""
        if self._left:
            return
        if self._outbox.full() or self._waiting > MAX_TEXT:
            _log.warning("%r takes no messages; cut off", self)
            self.abort()
            self.leave()
            return
        text = encode(message)
        # A whole state longer than the limit would be cut off with what follows it, on each connection.
        count = 0 if isinstance(message, Sync) else len(text)
        self._waiting += count
        self._outbox.put_nowait((text, count))

    def abort(self) -> None:
        """Abort the connection."""
        self._socket.transport.abort()

    async def read_log(
        self,
        id: str,  # noqa: A002 - wire name
        node: str,
        offset: int = 0,
        limit: int = 65536,
        query: LogQuery = LogQuery(),  # noqa: B008 - it is frozen
    ) -> LogChunk:
        """Read a piece of a node's log.

        Args:
            id: Endpoint id of the container.
            node: Node tag; empty for the environment's own log.
            offset: Where to start, in bytes; negative: that many before the end.
            limit: At most so many bytes.
            query: Of which incarnation of the container, and what of it.

        Raises:
            PeerGoneError: The task set left.
            PeerTimeoutError: It did not answer in time.
        """
        number = next(self._numbers)
        question = ReadLog(request=number, id=id, node=node, offset=offset, limit=limit, query=query)
        return await self._ask(question, LogChunk, self._timeouts.log)

    async def save_state(self, id: str, node: str) -> str:  # noqa: A002 - wire name
        """Have the state of a node saved now.

        Args:
            id: Endpoint id of the container.
            node: Its tag.

        Returns:
            Why it is not saved; empty if the snapshot is acknowledged.

        Raises:
            PeerGoneError: The task set left.
            PeerTimeoutError: It did not answer in time.
        """
        question = SaveState(request=next(self._numbers), id=id, node=node)
        return (await self._ask(question, StateSaved, self._timeouts.state)).error

    async def _ask(self, question: ReadLog | SaveState, kind: type[A], timeout: float) -> A:
        if self._left:
            raise PeerGoneError(self.process)
        reply: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self._asked[question.request] = reply
        self.send(question)
        try:
            async with asyncio.timeout(timeout):
                answer = await reply
        except TimeoutError as error:
            raise PeerTimeoutError(self.process, timeout) from error
        finally:
            del self._asked[question.request]
        if not isinstance(answer, kind):
            raise PeerGoneError(self.process)
        return answer

    async def pump(self) -> None:
        """Send what waits, until the connection ends (for the server).

        Raises:
            ConnectionClosed: The connection ended.
        """
        while True:
            text, count = await self._outbox.get()
            if self._is_fenced is not None and self._is_fenced():
                self.abort()
                return
            self._waiting -= count
            await self._socket.send(text)

    def answer(self, message: LogChunk | StateSaved) -> None:
        """Take an answer to :meth:`read_log` or :meth:`save_state` (for the server)."""
        reply = self._asked.get(message.request)
        if reply is not None and not reply.done():
            reply.set_result(message)

    def leave(self) -> None:
        """Note that the peer is gone, and fail the calls that wait for it (for the server)."""
        self._left = True
        for reply in self._asked.values():
            if not reply.done():
                reply.set_exception(PeerGoneError(self.process))
