"""Subscribing, the program's side: handles that take messages in order, by callback or by iteration."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TYPE_CHECKING, Any, Protocol, cast

from rce.aio.queues import BoundedQueue
from rce.aio.tasks import TaskScope, pass_cancellation
from rce.ros.errors import NodeClosedError
from rce.ros.node.local import LocalMessage
from rce.ros.node.runtime import TypeName
from rce.ros.node.settings import MAX_QUEUED_BYTES
from rce.ros.tcpros.framing import LARGE

if TYPE_CHECKING:
    from rce.ros.types import Message, MessageType

_log = logging.getLogger(__name__)

MessageCallback = Callable[[Any], Awaitable[None] | None]
SerializedCallback = Callable[[bytes, bool], Awaitable[None] | None]

Item = bytes | LocalMessage
"""A message that arrived: over a connection, or from a publisher of this process."""

ItemCallback = Callable[[Any, bool], Awaitable[None] | None]
"""Takes items, or only bytes if the subscriber does not decode."""


class Sink(Protocol):
    """Receives the messages of a topic."""

    @property
    def dropped(self) -> int:
        """How many messages were dropped, the oldest first, because they were not taken in time."""

    def deliver(self, payload: Item, latched: bool, source: str) -> None:
        """Take a message of the publisher with this slave API; must neither wait nor raise."""

    def lose(self, source: str) -> None:
        """Take note that the connection to a publisher ended."""

    def end(self) -> None:
        """Take note that no more messages will come."""


class CallbackSink:
    """Calls a function that is not a coroutine, at once."""

    def __init__(self, callback: ItemCallback, topic: str) -> None:
        self._callback = callback
        self._topic = topic

    @property
    def dropped(self) -> int:
        """Return 0: nothing is dropped."""
        return 0

    def deliver(self, payload: Item, latched: bool, source: str) -> None:
        """Call."""
        del source
        try:
            result = self._callback(payload, latched)
            if inspect.iscoroutine(result):
                result.close()
                raise TypeError(  # noqa: TRY301 - logged below, as what the callback raises
                    "the callback is a plain function, but returned a coroutine, which is not awaited;"
                    " give the coroutine function itself, or a functools.partial of it"
                )
        except Exception:  # noqa: BLE001 - the program's own fault, which must not stop the next message
            _log.exception("the callback of %s failed", self._topic)

    def lose(self, source: str) -> None:
        """Do nothing: nothing is kept."""

    def end(self) -> None:
        """Do nothing: nothing is kept."""


class TopicListener(Protocol):
    """Takes a topic's messages as a bridge needs them: with the publishers of those that are latched."""

    def received(self, payload: bytes) -> None:
        """Take a message."""

    def received_latched(self, payload: bytes, source: str) -> None:
        """Take a latched message; it replaces the one that the same publisher latched before."""

    def source_ended(self, source: str) -> None:
        """Take note that a publisher ended: its latched messages are void."""


class ListenerSink:
    """Hands messages to a listener, at once."""

    def __init__(self, listener: TopicListener, topic: str) -> None:
        self._listener = listener
        self._topic = topic
        self._sources: set[str] = set()

    @property
    def dropped(self) -> int:
        """Return 0: nothing is dropped."""
        return 0

    def deliver(self, payload: Item, latched: bool, source: str) -> None:
        """Hand over."""
        data = payload.payload() if isinstance(payload, LocalMessage) else payload
        try:
            if latched:
                self._sources.add(source)
                self._listener.received_latched(data, source)
            else:
                self._listener.received(data)
        except Exception:  # noqa: BLE001 - the program's own fault, which must not stop the next message
            _log.exception("the listener of %s failed", self._topic)

    def lose(self, source: str) -> None:
        """Report the end of a publisher that had latched a message."""
        if source in self._sources:
            self._sources.remove(source)
            self._listener.source_ended(source)

    def end(self) -> None:
        """Do nothing: nothing is kept."""


class QueueSink:
    """Keeps messages until a task takes them; drops the oldest when they are too many."""

    def __init__(self, queue_size: int) -> None:
        self._queue: BoundedQueue[tuple[Item, bool]] = BoundedQueue(queue_size, MAX_QUEUED_BYTES)
        self._arrived = asyncio.Event()
        self._ended = False

    @property
    def dropped(self) -> int:
        """How many messages were dropped."""
        return self._queue.dropped

    @property
    def has_ended(self) -> bool:
        """Whether no more messages will come."""
        return self._ended

    def deliver(self, payload: Item, latched: bool, source: str) -> None:
        """Keep."""
        del source
        self._queue.put((payload, latched), len(payload))
        self._arrived.set()

    def lose(self, source: str) -> None:
        """Do nothing: kept messages stay, as the program may still want them."""

    def end(self) -> None:
        """Wake the waiting callers."""
        self._ended = True
        self._arrived.set()

    async def take(self) -> tuple[Item, bool]:
        """Wait for the next message.

        Raises:
            EOFError: The queue is empty and no more messages will come.
        """
        while not self._queue:
            if self._ended:
                raise EOFError
            self._arrived.clear()
            await self._arrived.wait()
        return self._queue.take()


async def call_in_order(
    sink: QueueSink, callback: Callable[[Any, bool], Awaitable[None]], topic: str
) -> None:
    """Give a sink's messages to a coroutine function, one after the other, until the sink ends."""
    while True:
        try:
            payload, latched = await sink.take()
        except EOFError:
            return
        try:
            await callback(payload, latched)
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - as above
            pass_cancellation(error)
            if sink.has_ended and isinstance(error, NodeClosedError):
                _log.debug("the callback of %s ended with its node: %s", topic, error)
            else:
                _log.exception("the callback of %s failed", topic)


def _is_async(callback: Callable[..., Any]) -> bool:
    """Return whether a callback is a coroutine function, or an object that is called like one."""
    return inspect.iscoroutinefunction(callback) or inspect.iscoroutinefunction(type(callback).__call__)


def sink_for(callback: ItemCallback, queue_size: int, topic: str, tasks: TaskScope) -> Sink:
    """Make a sink that gives messages to ``callback``, a function or coroutine function."""
    if not _is_async(callback):
        return CallbackSink(callback, topic)
    sink = QueueSink(queue_size)
    asynchronous = cast("Callable[[Any, bool], Awaitable[None]]", callback)
    tasks.spawn(call_in_order(sink, asynchronous, topic), name=f"callback of {topic}")
    return sink


def decode(message_type: MessageType, payload: Item) -> Message:
    """Read a message. Fields cut out of a view are copied once, out of bytes twice."""
    if isinstance(payload, LocalMessage):
        return payload.message(message_type)
    return message_type.deserialize(memoryview(payload) if len(payload) >= LARGE else payload)


def decoding(message_type: MessageType, callback: MessageCallback) -> ItemCallback:
    """Turn a callback that takes messages into one that takes their bytes."""
    if _is_async(callback):
        asynchronous = cast("Callable[[Any], Awaitable[None]]", callback)

        async def decode_and_wait(payload: Item, latched: bool) -> None:
            del latched
            await asynchronous(decode(message_type, payload))

        return decode_and_wait

    def decode_and_call(payload: Item, latched: bool) -> Awaitable[None] | None:
        del latched
        return callback(decode(message_type, payload))

    return decode_and_call


class Subscriber:
    """A subscription. Made by :meth:`rce.ros.node.Node.subscribe`.

    Without a callback it is an async iterator over the messages: it ends when the subscriber is closed or the
    node is told to stop.
    """

    def __init__(
        self,
        topic: str,
        message_type: MessageType | TypeName | None,
        sink: Sink,
        release: Callable[[Subscriber], Awaitable[None]],
        connected: Callable[[], int],
        changed: asyncio.Event,
        check_running: Callable[[], None],
        *,
        decodes: bool,
        hears_own: bool,
    ) -> None:
        self.topic = topic
        """The topic's global name."""
        self.sink = sink
        """Takes what arrives."""
        self.decodes = decodes
        """Whether the sink decodes its messages: it takes objects too."""
        self.hears_own = hears_own
        """Whether it takes the messages of its own node."""
        self._message_type = None if isinstance(message_type, TypeName) else message_type
        self._release = release
        self._connected = connected
        self._changed = changed
        self._check_running = check_running
        self._closed = False

    @property
    def dropped(self) -> int:
        """How many messages were dropped because the program was too slow."""
        return self.sink.dropped

    @property
    def connections(self) -> int:
        """How many publishers are connected."""
        return self._connected()

    async def wait_for_publishers(self, count: int = 1, *, timeout: float | None = None) -> None:
        """Wait until at least ``count`` publishers are connected.

        Raises:
            TimeoutError: They did not come within ``timeout`` seconds.
            NodeClosedError: The node was told to stop.
        """
        async with asyncio.timeout(timeout):
            while self._connected() < count:
                self._check_running()
                self._changed.clear()
                await self._changed.wait()

    def __aiter__(self) -> AsyncIterator[Message]:
        return self

    async def __anext__(self) -> Message:
        """Wait for the next message. What a publisher sends that is not one is logged and left out.

        Raises:
            NodeClosedError: The subscriber has a callback, which takes the messages.
        """
        if not isinstance(self.sink, QueueSink) or self._message_type is None:
            raise NodeClosedError(f"the messages of {self.topic} go to a callback")
        while True:
            try:
                payload, _ = await self.sink.take()
            except EOFError:
                raise StopAsyncIteration from None
            try:
                return decode(self._message_type, payload)
            except ValueError as error:  # a SerializationError; the types may not be imported yet
                _log.warning("a message of %s is left out: %s", self.topic, error)

    async def close(self) -> None:
        """Stop taking messages; the last subscriber of a topic unregisters it."""
        if not self._closed:
            self._closed = True
            self.sink.end()
            await self._release(self)
